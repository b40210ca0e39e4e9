"""Limits by which a calibration from images judges the errors of an arm, one row for each type of arm.

The zeros of a low-cost arm are wrong by degrees, and its play and sag displace all corners of an image by far
more than their noise. The limits of other arms would make outliers of such images, and keep the nominal arm.
"""

from __future__ import annotations

from collections.abc import Iterable

from ..._frozen import frozen
from ...estimation.parameters import LOW_COST

# Models of errors of images that the errors of the arm do not explain: corners are displaced independently of
# each other (`corner_noise`), or all corners of an image together (`jitter`).
CORNERS, IMAGES = "corners", "images"


@frozen
class ArmType:
    """Limits of one type of arm."""

    # Largest ratio of the errors of left-out images for which the arm is demonstrably wrong: if its errors
    # explain the images up to the noise of the corners, and if the model lacks other errors, which errors of
    # the links then imitate.
    max_complete_ratio: float
    max_incomplete_ratio: float
    # Errors of images above this are those of wrong joint values rather than of arm, board or lens [px].
    max_error: float
    # Models that are compared by left-out images; with the first one outliers are found.
    noise_models: tuple[str, ...]
    # Number of different images below which the arm is not written, and number that is advised.
    min_images: int = 0
    advised_images: int = 0
    # Whether images show a change of joint zeros or links: play and sag imitate it.
    shows_joint_changes: bool = True


INDUSTRIAL = ArmType(0.5, 0.25, 10.0, (CORNERS, IMAGES))
# Types of arms by the parameter set that is estimated. 40 px are 2° for a lens of 1150 px.
ARM_TYPES = {LOW_COST: ArmType(0.8, 0.8, 40.0, (IMAGES,), 10, 20, shows_joint_changes=False)}


def arm_type(sets: Iterable[str]) -> ArmType:
    """Return the type of arm whose parameter sets are estimated."""
    return next((ARM_TYPES[name] for name in sets if name in ARM_TYPES), INDUSTRIAL)
