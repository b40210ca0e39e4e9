"""Poses of boards from single images (perspective-n-point), without a guess.

1. Closed forms give first poses: the direct linear transformation of the homography of the plane nearest to
   the points, with both of the poses that explain a flat board about equally well, and that of a projection
   matrix for six or more points that are not in one plane (Hartley and Zisserman 2004, sections 4.1 and 7.1).
   The projection matrix of points near a plane is hardly determined, so both forms are tried for them.
2. Gauss-Newton steps with damping minimize the distances in the image. The best of these poses is taken.

All image coordinates are undistorted, X/Z and Y/Z.

Reference:
    R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision, 2nd ed., Cambridge 2004.
"""

from __future__ import annotations

import numpy as np

from .. import se3
from .._typing import Array

# Ratio of the smallest to the largest extent below which points count as flat, and as nearly flat: the
# homography of the nearest plane then describes their image to about this part of its size.
FLATNESS, NEAR_FLATNESS = 1e-3, 0.1
# Smallest number of points of a flat and of another set.
MIN_FLAT_POINTS, MIN_POINTS = 4, 6
# Steps of the refinement, and the first damping.
_N_STEPS, _DAMPING = 30, 1e-3
# Number of random subsets, distance relative to the size of the image of the board that is never too large,
# and distance of a wrong point as a multiple of the median.
_N_SUBSETS, _GOOD_RATIO, _OUTLIER_RATIO = 60, 0.01, 5.0
# Relative change of the cost that ends the refinement.
_COST_RTOL = 1e-10


def normalizing_transform(points: Array) -> Array:
    """Compute the similarity that moves points to the origin and scales them to unit size.

    Args:
        points: Points, shape (m, d).

    Returns:
        Homogeneous matrix, shape (d+1, d+1).
    """
    d = points.shape[1]
    centre = points.mean(0)
    size = np.sqrt(np.mean(np.sum((points - centre) ** 2, 1)) / d) or 1.0
    out = np.eye(d + 1) / size
    out[:d, d], out[d, d] = -centre / size, 1.0
    return out


def direct_linear_transform(source: Array, target: Array) -> Array:
    """Compute the projective map of points onto image points by the direct linear transformation.

    Args:
        source: Points, shape (m, d).
        target: Image points, shape (m, 2).

    Returns:
        Matrix, shape (3, d+1), up to a factor.
    """
    normalize_source, normalize_target = normalizing_transform(source), normalizing_transform(target)
    points = np.column_stack([source, np.ones(len(source))]) @ normalize_source.T
    image = np.column_stack([target, np.ones(len(target))]) @ normalize_target.T
    zero = np.zeros_like(points)
    rows = np.concatenate(
        [
            np.column_stack([points, zero, -image[:, :1] * points]),
            np.column_stack([zero, points, -image[:, 1:2] * points]),
        ]
    )
    solution = np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])[2][-1].reshape(3, -1)
    return np.linalg.solve(normalize_target, solution @ normalize_source)


def agreeing_points(points: Array, image: Array) -> Array:
    """Find the image points that agree with a projective map of most points (least median of squares).

    Args:
        points: Points in their own frame, shape (m, 3) [m].
        image: Image points in any unit, shape (m, 2).

    Returns:
        Whether each point agrees, shape (m,); all of them if one map fits them all or they are too few.
    """
    everything = np.ones(len(points), bool)
    if len(points) <= MIN_FLAT_POINTS:
        return everything
    centre = points.mean(0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=False)
    is_flat = extent[2] <= NEAR_FLATNESS * extent[0]
    least = MIN_FLAT_POINTS if is_flat else MIN_POINTS
    if extent[1] <= FLATNESS * extent[0] or len(points) <= least:
        return everything
    source = ((points - centre) @ axes.T)[:, : 2 if is_flat else 3]
    ratio = _GOOD_RATIO + (extent[2] / extent[0] if is_flat else 0.0)
    limit = ratio * float(np.median(np.linalg.norm(image - np.median(image, 0), axis=1)))
    if np.sqrt(np.mean(_transfer_distances(source, image, everything) ** 2)) <= limit:
        return everything
    rng = np.random.default_rng(0)
    fits = [
        _transfer_distances(source, image, rng.permutation(len(points))[:least]) for _ in range(_N_SUBSETS)
    ]
    best = min(fits, key=lambda distances: float(np.median(distances)))
    is_agreeing = best <= max(_OUTLIER_RATIO * float(np.median(best)), limit)
    return is_agreeing if is_agreeing.sum() > least else everything


def _transfer_distances(source: Array, image: Array, chosen: Array) -> Array:
    """Return the distances (m,) of image points from the projective map that fits the chosen points."""
    matrix = direct_linear_transform(source[chosen], image[chosen])
    mapped = np.column_stack([source, np.ones(len(source))]) @ matrix.T
    with np.errstate(all="ignore"):
        distances = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - image, axis=1)
    return np.where(np.isfinite(distances), distances, np.inf)


def estimate_pose(points: Array, image: Array) -> tuple[Array, float] | None:
    """Estimate the pose of points from one image.

    Args:
        points: Points in their own frame, shape (m, 3) [m].
        image: Undistorted image coordinates X/Z, Y/Z, shape (m, 2).

    Returns:
        Pose of their frame in the camera, shape (4, 4) [m], and the RMS distance in the image; None if there
        are too few points.
    """
    if len(points) < MIN_FLAT_POINTS:
        return None
    centre = points.mean(0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=False)
    if extent[1] <= FLATNESS * extent[0]:
        return None
    is_flat = extent[2] <= FLATNESS * extent[0]
    if not is_flat and len(points) < MIN_POINTS:
        return None
    axes[2] *= np.linalg.det(axes)
    flat = (points - centre) @ axes.T
    frame = se3.inverse(se3.transform(axes.T, centre))
    candidates = [pose @ frame for pose in _flat_poses(flat[:, :2], image)]
    if not is_flat:
        candidates.append(_projection_pose(points, image))
    refined = [_refine(pose, points, image) for pose in candidates]
    return min(refined, key=lambda each: each[1])


def _flat_poses(points: Array, image: Array) -> list[Array]:
    """Return two poses of flat points (m, 2): that of the homography, and its mirror image in depth."""
    homography = direct_linear_transform(points, image)
    homography /= np.mean(np.linalg.norm(homography[:, :2], axis=0))
    if homography[2, 2] < 0:
        homography = -homography
    x, y = homography[:, 0], homography[:, 1]
    rotation = se3.nearest_rotation(np.column_stack([x, y, np.cross(x, y)]))
    first = se3.transform(rotation, homography[:, 2])
    # The line of sight to the board: a board tilted the other way about it looks nearly the same.
    sight = homography[:, 2] / np.linalg.norm(homography[:, 2])
    normal = rotation[:, 2]
    mirrored = 2 * (normal @ sight) * sight - normal
    axis = np.cross(normal, mirrored)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return [first]
    turn = se3.exp3(axis / sine * np.arctan2(sine, normal @ mirrored))
    return [first, se3.transform(turn @ rotation, homography[:, 2])]


def _projection_pose(points: Array, image: Array) -> Array:
    """Return the pose of points (m, 3) that are not flat from their projection matrix."""
    projection = direct_linear_transform(points, image)
    projection /= np.cbrt(np.linalg.det(projection[:, :3]))
    return se3.transform(se3.nearest_rotation(projection[:, :3]), projection[:, 3])


def _residual(pose: Array, points: Array, image: Array) -> tuple[Array, Array]:
    """Return residuals (2m,) and points in the camera frame (m, 3)."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.maximum(local[:, 2], 1e-6)
    return (image - local[:, :2] / depth[:, None]).ravel(), local


def _refine(pose: Array, points: Array, image: Array) -> tuple[Array, float]:
    """Minimize the distances in the image; return the pose and the RMS distance."""
    damping = _DAMPING
    residual, local = _residual(pose, points, image)
    cost = float(residual @ residual)
    for _ in range(_N_STEPS):
        depth = np.maximum(local[:, 2], 1e-6)
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / depth
        by_point[:, :, 2] = -local[:, :2] / depth[:, None] ** 2
        # The pose moves by the twist [v, ω] in camera axes at the origin.
        jacobian = np.concatenate([by_point, -by_point @ se3.skew(local)], 2).reshape(-1, 6)
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0] = 1.0
        rows = np.concatenate([jacobian / scale, np.sqrt(damping) * np.eye(6)])
        step = np.linalg.lstsq(rows, np.concatenate([residual, np.zeros(6)]), rcond=None)[0] / scale
        trial = se3.exp6(step) @ pose
        trial_residual, trial_local = _residual(trial, points, image)
        trial_cost = float(trial_residual @ trial_residual)
        if trial_cost < cost:
            is_done = cost - trial_cost < _COST_RTOL * cost
            pose, residual, local, cost = trial, trial_residual, trial_local, trial_cost
            damping *= 0.1
            if is_done:
                break
        else:
            damping *= 10
    is_behind = bool(np.any(local[:, 2] <= 0))
    return pose, np.inf if is_behind else float(np.sqrt(cost / len(points)))
