"""Whether a lens that images show is far from the stated one, and whether another resolution explains it.

Images of another resolution than stated scale focal lengths and image centre by one factor. A wrong lens
changes the focal lengths, but hardly the image centre.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from .rig import PIXEL_PRIORS, Camera

# Factors between usual resolutions of one camera.
FACTORS = np.array([1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4])
# Largest relative difference of a focal length or image centre from the stated value times such a factor.
MAX_DIFFERENCE = 0.1
# Change of a focal length or image centre that is far, in prior standard deviations.
MIN_FAR = 5.0


def find_resolution(camera: Camera, found: Array, corners: Array) -> float | None:
    """Find the factor of the resolution of a lens (s,) with corners (m, 2) to the stated one, if any."""
    stated = camera.values[:4]
    if not camera.has_intrinsics or min(stated.min(), found[:4].min()) <= 0:
        return None
    ratios = found[:4] / stated
    factor = float(FACTORS[np.argmin(np.abs(np.log(FACTORS) - np.mean(np.log(ratios))))])
    is_scaled = np.all(np.abs(ratios / factor - 1) <= MAX_DIFFERENCE)
    size = factor * np.array([camera.width, camera.height])
    return factor if is_scaled and np.all(corners < size) else None


def is_far(camera: Camera, found: Array) -> bool:
    """Return whether focal lengths or image centre (s,) are far from what a rig states with a prior."""
    is_stated = camera.has_intrinsics and camera.intrinsics == "prior"
    return is_stated and bool(np.max(np.abs((found - camera.values)[:4])) > MIN_FAR * PIXEL_PRIORS["prior"])


def describe_resolution(camera: Camera, factor: float) -> str:
    """Say which resolution the images have, a factor times the stated one."""
    width, height = round(factor * camera.width), round(factor * camera.height)
    return f"the images are {width} x {height} px, not {camera.width} x {camera.height} px"
