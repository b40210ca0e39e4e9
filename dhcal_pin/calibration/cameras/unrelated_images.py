"""Images that do not belong to the joint values or to the robot.

A rotation between two poses of the camera or of the board has the same angle as the rotation of the tool, for
any pose of both on the robot: in T·B and T'·B the tool turns by T⁻¹·T', and what is on it by B⁻¹·(T⁻¹·T')·B.
The angles that images show, each from the image alone, are compared with those of the nominal arm. Zeros that
are wrong by 15° in every joint change half of them by less than 4°; joint values of other images, wrong signs
or another robot by 10° to 60°.
"""

from __future__ import annotations

import numpy as np

from ..._typing import Array
from ...estimation.robust import ZERO_WEIGHT
from ...exceptions import InvalidArgumentError
from ...measurements.camera import CameraCorners
from ...robot.chain import Chain
from ..reweighting import Fit
from .sets import describe_configurations
from .stages import fitted_error

# Median difference of the angles from which images are unrelated [rad], and smallest and largest number of
# images that are compared.
MIN_DIFFERENCE, MIN_IMAGES, MAX_IMAGES = np.deg2rad(10.0), 10, 200
# Shifts of the joint values by rows that are a mistake of their own, and are named as such.
SHIFTS = (-2, -1, 1, 2)
# Share of rejected corners above which a fit says nothing.
MAX_REJECTED_SHARE = 0.5


def require_related_images(fit: Fit, chain: Chain, max_error: float) -> None:
    """Raise an error if images that a fit does not explain are not those of its joint values or robot.

    A fit whose corners are within `max_error` [px] of the model, and not mostly rejected, is not questioned.
    """
    rejected = np.concatenate([weights <= ZERO_WEIGHT for weights in fit.weights])
    if fitted_error(fit).pixels <= max_error and rejected.mean() <= MAX_REJECTED_SHARE:
        return
    images = [item for item in fit.data if isinstance(item, CameraCorners)]
    if len(images) < len(fit.data):
        return
    differences = [_angle_difference(chain, item) for item in images]
    if min(differences) < MIN_DIFFERENCE:
        return
    stated = describe_configurations(fit.data)
    where = images[0].source or "images"
    raise InvalidArgumentError(
        f"{where}: the boards in the images do not move as the {stated} say: the rotations between images "
        f"differ by {np.degrees(min(differences)):.0f}° (median) from those of the robot, wherever camera "
        f"and board are; expected the {stated} of the same images with right units, signs and order, and "
        "the URDF of the robot in the images"
    )


def _angle_difference(chain: Chain, item: CameraCorners) -> float:
    """Return the median difference of angles between images and robot [rad], for the best shift of rows.

    It is zero if there are too few images.
    """
    shown = item.tool_poses()
    # Consecutive images, so that shifts can be seen.
    shown = shown.take(np.arange(min(len(shown.rows), MAX_IMAGES)))
    n = len(shown.rows)
    if n < MIN_IMAGES:
        return 0.0
    of_robot, of_images = _angles(chain.poses(shown.q)), _angles(shown.poses)
    places = np.arange(n)
    differences = []
    for shift in (0, *SHIFTS):
        inside = places[(places + shift >= 0) & (places + shift < n)]
        pairs = of_robot[np.ix_(inside + shift, inside + shift)] - of_images[np.ix_(inside, inside)]
        differences.append(np.median(np.abs(pairs[np.triu_indices(len(inside), 1)])))
    return float(min(differences))


def _angles(poses: Array) -> Array:
    """Return the angles of the rotations between poses (n, 4, 4), shape (n, n) [rad]."""
    rotations = poses[:, :3, :3]
    trace = np.einsum("aij,bij->ab", rotations, rotations)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))
