"""Focal lengths and image centre from several views of a flat board (Zhang 2000).

Each homography H = λ·K·[r1 r2 t] of a view gives two linear equations in ω = K⁻ᵀ·K⁻¹, because the columns
r1 and r2 are orthonormal:

    h1ᵀ·ω·h2 = 0,    h1ᵀ·ω·h1 = h2ᵀ·ω·h2.

Without skew ω has five unknowns up to a factor, so three views determine it. If the result is not plausible,
the centre of the image is taken as image centre, and only the focal length is estimated.

Reference: Z. Zhang, A Flexible New Technique for Camera Calibration, IEEE PAMI 22, 2000.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._typing import Array
from ..exceptions import NotObservableError
from .pose_from_points import direct_linear_transform

# Smallest number of views.
MIN_VIEWS = 3
# Plausible focal lengths, as multiples of the larger side of the image, and largest ratio of fx and fy.
MIN_FOCAL, MAX_FOCAL, MAX_ASPECT = 0.2, 20.0, 1.5
# Largest plausible distance of the image centre from the middle, as a fraction of the side of the image.
MAX_SHIFT = 0.25


def estimate_intrinsics(
    views: Sequence[tuple[Array, Array]], width: int, height: int, camera: str
) -> tuple[float, float, float, float]:
    """Estimate the focal lengths and the image centre of a camera without distortion.

    Args:
        views: Flat points, shape (m, 2) [m], and their pixels, shape (m, 2), of each view.
        width: Width of the images [px].
        height: Height of the images [px].
        camera: Name of the camera, for messages.

    Returns:
        fx, fy, cx, cy [px].

    Raises:
        NotObservableError: There are too few views, or they do not determine the focal length.
    """
    homographies = [direct_linear_transform(points, pixels) for points, pixels in views if len(points) >= 4]
    if len(homographies) < MIN_VIEWS:
        raise NotObservableError(
            f"camera {camera!r}: {len(homographies)} images of a flat board; expected at least {MIN_VIEWS} "
            "for intrinsics that the rig file does not state"
        )
    # Pixels relative to the middle of the image, in units of its larger side.
    size = float(max(width, height))
    shift = np.array(
        [[1 / size, 0, -(width - 1) / 2 / size], [0, 1 / size, -(height - 1) / 2 / size], [0, 0, 1]]
    )
    scaled = [shift @ homography for homography in homographies]
    for estimate in (_with_centre, _without_centre):
        values = estimate(scaled)
        if values is not None and _is_plausible(values, width / size, height / size):
            fx, fy, cx, cy = values
            return size * fx, size * fy, size * cx + (width - 1) / 2, size * cy + (height - 1) / 2
    raise NotObservableError(
        f"camera {camera!r}: the images do not determine its focal length; expected images of the board "
        "tilted in different directions, or fx, fy, cx, cy in the rig file"
    )


def _products(homography: Array, i: int, j: int) -> Array:
    """Return the coefficients of hᵢᵀ·ω·hⱼ in ω11, ω22, ω13, ω23, ω33."""
    a, b = homography[:, i], homography[:, j]
    return np.array([a[0] * b[0], a[1] * b[1], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1],
                     a[2] * b[2]])  # fmt: skip


def _rows(homographies: Sequence[Array]) -> Array:
    """Return the equations of all views, (2·views, 5)."""
    rows = []
    for homography in homographies:
        homography = homography / np.linalg.norm(homography[:, :2])
        rows += [
            _products(homography, 0, 1),
            _products(homography, 0, 0) - _products(homography, 1, 1),
        ]
    return np.array(rows)


def _with_centre(homographies: Sequence[Array]) -> tuple[float, float, float, float] | None:
    """Solve for fx, fy, cx, cy; None if ω is not positive."""
    w11, w22, w13, w23, w33 = np.linalg.svd(_rows(homographies))[2][-1]
    if w11 == 0 or w22 == 0:
        return None
    cx, cy = -w13 / w11, -w23 / w22
    scale = w33 - w13**2 / w11 - w23**2 / w22
    if not (scale / w11 > 0 and scale / w22 > 0):
        return None
    return float(np.sqrt(scale / w11)), float(np.sqrt(scale / w22)), float(cx), float(cy)


def _without_centre(homographies: Sequence[Array]) -> tuple[float, float, float, float] | None:
    """Solve for one focal length with the centre in the middle of the image; None if it is not positive."""
    rows = _rows(homographies)
    # ω = diag(1, 1, f²)/f².
    square = -float(rows[:, 4] @ rows[:, 4]) / float(rows[:, 4] @ (rows[:, 0] + rows[:, 1]))
    if not (np.isfinite(square) and square > 0):
        return None
    focal = float(np.sqrt(square))
    return focal, focal, 0.0, 0.0


def _is_plausible(values: tuple[float, float, float, float], width: float, height: float) -> bool:
    """Check focal lengths and centre in units of the larger side of the image."""
    fx, fy, cx, cy = values
    return (
        all(MIN_FOCAL < focal < MAX_FOCAL for focal in (fx, fy))
        and 1 / MAX_ASPECT < fx / fy < MAX_ASPECT
        and abs(cx) < MAX_SHIFT * width
        and abs(cy) < MAX_SHIFT * height
    )
