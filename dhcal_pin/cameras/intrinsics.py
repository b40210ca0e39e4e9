"""Focal lengths and image centre from several views of a board.

Two methods give estimates. Each of them starts a fit of the whole lens with the images (`lens_fit`); the
better fit is taken.

1. Views of a flat board (Zhang 2000). Each homography H = λ·K·[r1 r2 t] of a view gives two linear equations
   in ω = K⁻ᵀ·K⁻¹, because the columns r1 and r2 are orthonormal:

       h1ᵀ·ω·h2 = 0,    h1ᵀ·ω·h1 = h2ᵀ·ω·h2.

   Without skew ω has five unknowns up to a factor, so three views determine it. If the result is not
   plausible, the centre of the image is taken as image centre, and only the focal length is estimated.
2. Views of any board. The pose of the board in each view is estimated for many focal lengths, with the centre
   of the image as image centre. The focal length with the smallest error in the images is taken if half of it
   and twice of it explain the images significantly worse.

Reference: Z. Zhang, A Flexible New Technique for Camera Calibration, IEEE PAMI 22, 2000.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._typing import Array
from ..exceptions import NotObservableError
from .pose_from_points import (
    FLATNESS,
    MIN_POINTS,
    determines_homography,
    direct_linear_transform,
    estimate_poses,
)
from .rig import Camera

# Smallest number of views.
MIN_VIEWS = 3
# Plausible focal lengths, as multiples of the larger side of the image, and largest ratio of fx and fy.
MIN_FOCAL, MAX_FOCAL, MAX_ASPECT = 0.2, 20.0, 1.5
# Largest plausible distance of the image centre from the middle, as a fraction of the side of the image.
MAX_SHIFT = 0.25
# Focal lengths that are tried first, as multiples of the larger side of the image; twice or half of each is
# among them. Each refinement halves their distance.
_FOCAL_LENGTHS = MIN_FOCAL * 2 ** np.arange(0, 6.5, 0.5)
_N_REFINEMENTS = 4
# Largest number of views for which poses are estimated.
_MAX_VIEWS = 12
# Smallest increase of the sum of squares at half and at twice the focal length, in variances of the noise.
_MIN_INCREASE = 25.0


def intrinsics_candidates(
    views: Sequence[tuple[Array, Array]], camera: Camera
) -> list[tuple[float, float, float, float]]:
    """Estimate the focal lengths and the image centre of a camera by each method that determines them."""
    views = [view for view in views if len(view[0]) >= MIN_POINTS]
    if len(views) < MIN_VIEWS:
        raise NotObservableError(
            f"camera {camera.name!r}: {len(views)} images of a board with at least 4 corners; expected at "
            f"least {MIN_VIEWS} for intrinsics that the rig file does not state"
        )
    found = _from_homographies(views, camera), _search(_drawn(views), camera)
    return [each for each in found if each is not None]


def undetermined_focal_length(camera: Camera) -> NotObservableError:
    """Return the error of images that do not determine the focal length of a camera."""
    return NotObservableError(
        f"camera {camera.name!r}: the images do not determine its focal length; expected images of the "
        "board tilted in different directions, or fx, fy, cx, cy in the rig file"
    )


def _drawn(views: Sequence[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
    """Return at most as many views as poses are estimated for."""
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, _MAX_VIEWS).astype(int))]


def _square_sum(
    views: Sequence[tuple[Array, Array]], camera: Camera, values: tuple[float, float, float, float]
) -> float:
    """Return the sum of squares of the errors in the images [px²] of the poses of the board in all views."""
    lens = np.pad(values, (0, len(camera.values) - 4))
    plane = [camera.lens.normalize(pixels.T, lens).T for _, pixels in views]
    poses = estimate_poses([(points, image) for (points, _), image in zip(views, plane, strict=True)])
    total = 0.0
    for (points, pixels), found in zip(views, poses, strict=True):
        if found:
            pose = found[0][0]
            local = pose[:3, :3] @ points.T + pose[:3, 3:4]
            error = float(np.sum((camera.lens.project(local, lens)[0].T - pixels) ** 2))
            # A board behind the camera explains its image no better than a single point does.
            total += min(error, float(np.sum((pixels - pixels.mean(0)) ** 2)))
    return total


def _search(views: Sequence[tuple[Array, Array]], camera: Camera) -> tuple[float, float, float, float] | None:
    """Search the focal length with the smallest error in the images; None if others explain them as well."""
    size = max(camera.width, camera.height)

    def values(focal: float) -> tuple[float, float, float, float]:
        return size * focal, size * focal, *camera.image_centre.tolist()

    sums = np.array([_square_sum(views, camera, values(focal)) for focal in _FOCAL_LENGTHS])
    best = int(np.argmin(sums))
    if not 2 <= best < len(sums) - 2:
        return None
    n_rows = sum(2 * len(points) for points, _ in views)
    variance = sums[best] / (n_rows - 6 * len(views))
    if min(sums[best - 2], sums[best + 2]) - sums[best] < _MIN_INCREASE * variance:
        return None
    focal, least, ratio = float(_FOCAL_LENGTHS[best]), float(sums[best]), 2**0.5
    for _ in range(_N_REFINEMENTS):
        ratio **= 0.5
        for trial in (focal / ratio, focal * ratio):
            square_sum = _square_sum(views, camera, values(trial))
            if square_sum < least:
                focal, least = trial, square_sum
    return values(focal)


def _from_homographies(
    views: Sequence[tuple[Array, Array]], camera: Camera
) -> tuple[float, float, float, float] | None:
    """Solve for the intrinsics from views of flat boards; None if they do not determine them."""
    flat = [(plane, pixels) for points, pixels in views if (plane := _in_plane(points)) is not None]
    if len(flat) < MIN_VIEWS:
        return None
    width, height = camera.width, camera.height
    # Pixels relative to the middle of the image, in units of its larger side.
    size = float(max(width, height))
    shift = np.array(
        [[1 / size, 0, -(width - 1) / 2 / size], [0, 1 / size, -(height - 1) / 2 / size], [0, 0, 1]]
    )
    scaled = [shift @ direct_linear_transform(points, pixels) for points, pixels in flat]
    for estimate in (_with_centre, _without_centre):
        values = estimate(scaled)
        if _is_plausible(values, width / size, height / size):
            fx, fy, cx, cy = values
            return size * fx, size * fy, size * cx + (width - 1) / 2, size * cy + (height - 1) / 2
    return None


def _in_plane(points: Array) -> Array | None:
    """Return points (m, 3) in their plane, (m, 2); None if they determine no homography."""
    centred = points - points.mean(0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    if extent[2] > FLATNESS * extent[0] or extent[1] <= FLATNESS * extent[0]:
        return None
    plane = centred @ axes[:2].T
    return plane if determines_homography(plane) else None


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


def _with_centre(homographies: Sequence[Array]) -> tuple[float, float, float, float]:
    """Solve for fx, fy, cx, cy; focal lengths that are not numbers if ω is not positive."""
    w11, w22, w13, w23, w33 = np.linalg.svd(_rows(homographies))[2][-1]
    with np.errstate(all="ignore"):
        cx, cy = -w13 / w11, -w23 / w22
        scale = w33 + w13 * cx + w23 * cy
        return float(np.sqrt(scale / w11)), float(np.sqrt(scale / w22)), float(cx), float(cy)


def _without_centre(homographies: Sequence[Array]) -> tuple[float, float, float, float]:
    """Solve for one focal length with the centre in the middle of the image; not a number without one."""
    rows = _rows(homographies)
    # ω = diag(1, 1, f²)/f².
    with np.errstate(all="ignore"):
        focal = float(np.sqrt(-(rows[:, 4] @ (rows[:, 0] + rows[:, 1])) / (rows[:, 4] @ rows[:, 4])))
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
