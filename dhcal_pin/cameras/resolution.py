"""Whether a lens that images show is far from the stated one, and whether another resolution explains it.

Images of another resolution than stated scale focal lengths and image centre by one factor. A wrong lens
changes the focal lengths, but hardly the image centre. The lens of another resolution has the same effect;
then all corners are within the stated size of the images.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .._typing import Array
from .rig import PIXEL_PRIORS, Camera

# Factors between usual resolutions of one camera.
FACTORS = np.array([1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4])
# Largest relative difference of a focal length or image centre from the stated value times such a factor.
MAX_DIFFERENCE = 0.1
# Change of a focal length or image centre that is far, in prior standard deviations.
MIN_FAR = 5.0


class Resolution(NamedTuple):
    """Resolution of the images or of the lens, in place of the stated one."""

    factor: float  # Focal length that the images show, as a multiple of the stated one
    is_of_lens: bool  # Whether the images have the stated size, and the lens that of another one

    @property
    def remedy(self) -> str:
        """What has to be corrected in the rig."""
        size = "" if self.is_of_lens else "width, height, "
        return f"Correct {size}fx, fy, cx and cy of the camera."


def find_resolution(camera: Camera, found: Array, corners: Array) -> Resolution | None:
    """Find the resolution of images or lens from lens (s,) and corners (m, 2), if it is not stated so."""
    stated = camera.values[:4]
    if not camera.has_intrinsics or min(stated.min(), found[:4].min()) <= 0:
        return None
    ratios = found[:4] / stated
    factor = float(FACTORS[np.argmin(np.abs(np.log(FACTORS) - np.mean(np.log(ratios))))])
    is_scaled = np.all(np.abs(ratios / factor - 1) <= MAX_DIFFERENCE)
    size = np.array([camera.width, camera.height])
    # Corners of larger images are not all in one corner of them.
    is_of_lens = bool(np.all(corners < size)) and (factor > 1 or bool(np.any(corners >= factor * size)))
    is_possible = is_of_lens or np.all(corners < factor * size)
    return Resolution(factor, is_of_lens) if is_scaled and is_possible else None


def is_far(camera: Camera, found: Array) -> bool:
    """Return whether focal lengths or image centre (s,) are far from what a rig states with a prior."""
    is_stated = camera.has_intrinsics and camera.intrinsics == "prior"
    return is_stated and bool(np.max(np.abs((found - camera.values)[:4])) > MIN_FAR * PIXEL_PRIORS["prior"])


def describe_resolution(camera: Camera, resolution: Resolution) -> str:
    """Say which resolution the images or the lens have, in place of the stated one."""
    factor = 1 / resolution.factor if resolution.is_of_lens else resolution.factor
    width, height = round(factor * camera.width), round(factor * camera.height)
    if resolution.is_of_lens:
        return (
            f"fx, fy, cx and cy are those of images of {width} x {height} px, not of {camera.width} x "
            f"{camera.height} px"
        )
    return f"the images are {width} x {height} px, not {camera.width} x {camera.height} px"
