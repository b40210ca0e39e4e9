"""Poses of boards from single images (perspective-n-point), without a guess.

1. Closed forms give first poses: the direct linear transformation of the homography of the plane nearest to
   the points, with both of the poses that explain a flat board about equally well, and that of a projection
   matrix for six or more points that are not in one plane (Hartley and Zisserman 2004, sections 4.1 and 7.1).
   The projection matrix of points near a plane, or far from the camera, is hardly determined. The scaled
   orthographic projection of four or more points that are not in one plane is (DeMenthon and Davis 1995).
   All forms that are possible are tried.
2. Gauss-Newton steps with damping minimize the distances in the image, for all images together. The best of
   these poses is taken.

All image coordinates are undistorted, X/Z and Y/Z.

References:
    R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision, 2nd ed., Cambridge 2004.
    D. DeMenthon and L. Davis, Model-Based Object Pose in 25 Lines of Code, International Journal of Computer
    Vision 15, 1995.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .. import se3
from .._typing import Array
from .lens import MIN_DEPTH

# Ratio of the smallest to the largest extent below which points count as flat, and as nearly flat: the
# homography of the nearest plane then describes their image to about this part of its size.
FLATNESS, NEAR_FLATNESS = 1e-3, 0.1
# Smallest number of points for a pose, and for a projection matrix.
MIN_POINTS, MIN_PROJECTION_POINTS = 4, 6
# Steps of the refinement, the first damping, and the smallest one, for poses that are hardly determined.
_N_STEPS, _DAMPING, _MIN_DAMPING = 30, 1e-3, 1e-12
# Number of random subsets, distance relative to the size of the image of the board that is never too large,
# and distance of a wrong point as a multiple of the largest distance in a majority.
_N_SUBSETS, _GOOD_RATIO, _OUTLIER_RATIO = 60, 0.01, 5.0
# Relative change of the cost that ends the refinement.
_COST_RTOL = 1e-4


def normalizing_transform(points: Array) -> Array:
    """Compute the similarity that moves points to the origin and scales them to unit size."""
    d = points.shape[-1]
    centre = points.mean(-2)
    size = np.sqrt(np.mean(np.sum((points - centre[..., None, :]) ** 2, -1), -1) / d)
    size = np.where(size == 0, 1.0, size)
    out = np.eye(d + 1) / size[..., None, None]
    out[..., :d, d], out[..., d, d] = -centre / size[..., None], 1.0
    return out


def direct_linear_transform(source: Array, target: Array) -> Array:
    """Compute maps (..., 3, d+1) of points (..., m, d) onto image points (..., m, 2), up to a factor."""
    normalize_source, normalize_target = normalizing_transform(source), normalizing_transform(target)
    one = np.ones((*source.shape[:-1], 1))
    points = np.concatenate([source, one], -1) @ normalize_source.swapaxes(-1, -2)
    image = np.concatenate([target, one], -1) @ normalize_target.swapaxes(-1, -2)
    zero = np.zeros_like(points)
    rows = np.concatenate(
        [
            np.concatenate([points, zero, -image[..., :1] * points], -1),
            np.concatenate([zero, points, -image[..., 1:2] * points], -1),
        ],
        -2,
    )
    solution = np.linalg.svd(rows, full_matrices=rows.shape[-2] < rows.shape[-1])[2][..., -1, :]
    matrix = solution.reshape(*rows.shape[:-2], 3, -1)
    return np.linalg.solve(normalize_target, matrix @ normalize_source)


def determines_homography(points: Array) -> bool:
    """Check that points of a plane determine its homography: no line contains all of them but one."""
    if len(points) < MIN_POINTS:
        return False
    centred = points - points.mean(0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    low, high = int(np.argmin(along)), int(np.argmax(along))
    limit = FLATNESS * (along[high] - along[low])
    far = int(np.argmax(_line_distances(points, low, high)))
    lines = ((low, high), (low, far), (far, high))
    return all(np.sum(_line_distances(points, *line) > limit) > 1 for line in lines)


def _line_distances(points: Array, first: int, second: int) -> Array:
    """Return the distances (m,) of points (m, 2) from the line through two of them."""
    x, y = (points[second] - points[first]) / np.linalg.norm(points[second] - points[first])
    return np.abs((points - points[first]) @ [-y, x])


def agreeing_points(points: Array, image: Array) -> Array:
    """Find the image points that agree with a projective map of most points (least quantile of squares)."""
    # All agree if one map fits them all, or if the points that determine a map are half of them or more.
    everything = np.ones(len(points), bool)
    if len(points) <= 2 * MIN_POINTS:
        return everything
    _, extent, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    is_flat = extent[2] <= NEAR_FLATNESS * extent[0]
    least = MIN_POINTS if is_flat else MIN_PROJECTION_POINTS
    if extent[1] <= FLATNESS * extent[0] or len(points) <= 2 * least:
        return everything
    source = (points @ axes.T)[:, : 2 if is_flat else 3]
    ratio = _GOOD_RATIO + (extent[2] / extent[0] if is_flat else 0.0)
    limit = ratio * float(np.median(np.linalg.norm(image - np.median(image, 0), axis=1)))
    if np.sqrt(np.mean(_transfer_distances(source, image, np.arange(len(points))) ** 2)) <= limit:
        return everything
    chosen = np.argsort(np.random.default_rng(0).random((_N_SUBSETS, len(points))), 1)[:, :least]
    fits = _transfer_distances(source, image, chosen)
    # The map passes through the points that it is computed from: they do not count as a majority.
    majority = (len(points) + least + 1) // 2
    distances = np.sort(fits, 1)[:, majority - 1]
    best = fits[np.argmin(distances)]
    return best <= max(_OUTLIER_RATIO * float(distances.min()), limit)


def _transfer_distances(source: Array, image: Array, chosen: Array) -> Array:
    """Return the distances (..., m) of image points from projective maps that fit chosen points (..., n)."""
    matrices = direct_linear_transform(source[chosen], image[chosen])
    mapped = np.column_stack([source, np.ones(len(source))]) @ matrices.swapaxes(-1, -2)
    with np.errstate(all="ignore"):
        distances = np.linalg.norm(mapped[..., :2] / mapped[..., 2:] - image, axis=-1)
    return np.where(np.isfinite(distances), distances, np.inf)


def estimate_pose(points: Array, image: Array) -> tuple[Array, float] | None:
    """Estimate the pose (4, 4) [m] of points in the camera from one image; None with too few points."""
    # The image coordinates are undistorted, X/Z and Y/Z. The RMS distance in the image follows.
    found = estimate_poses([(points, image)])[0]
    return found[0] if found else None


def estimate_poses(
    views: Sequence[tuple[Array, Array]], known: Sequence[Array | None] | None = None
) -> list[list[tuple[Array, float]]]:
    """Estimate poses that explain each of several images, points and X/Z, Y/Z, the best first."""
    # A known pose near that of the image is tried with its mirror image instead of closed forms.
    candidates = [
        _first_poses(*view) if pose is None else [pose, *_mirror(pose, view[0])]
        for view, pose in zip(views, known or [None] * len(views), strict=True)
    ]
    view_of = [i for i, poses in enumerate(candidates) for _ in poses]
    out: list[list[tuple[Array, float]]] = [[] for _ in views]
    if view_of:
        first = np.array([pose for poses in candidates for pose in poses])
        poses, rms = _refine(first, [views[i] for i in view_of])
        for i in np.argsort(rms, kind="stable").tolist():
            out[view_of[i]].append((poses[i], float(rms[i])))
    return out


def _first_poses(points: Array, image: Array) -> list[Array]:
    """Return the closed-form poses of points (m, 3) in an image (m, 2); none if they are too few."""
    if len(points) < MIN_POINTS:
        return []
    centre = points.mean(0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=False)
    if extent[1] <= FLATNESS * extent[0]:
        return []
    axes[2] *= np.linalg.det(axes)
    flat = (points - centre) @ axes.T
    is_flat = extent[2] <= FLATNESS * extent[0]
    if is_flat and not determines_homography(flat[:, :2]):
        return []
    frame = se3.inverse(se3.transform(axes.T, centre))
    out = [pose @ frame for pose in _flat_poses(flat[:, :2], image)]
    if is_flat:
        return out
    out.append(_orthographic_pose(points, image))
    if len(points) >= MIN_PROJECTION_POINTS:
        out += _projection_poses(points, image)
    return out


def _flat_poses(points: Array, image: Array) -> list[Array]:
    """Return two poses of flat points (m, 2): that of the homography, and its mirror image in depth."""
    homography = direct_linear_transform(points, image)
    homography /= np.mean(np.linalg.norm(homography[:, :2], axis=0))
    if homography[2, 2] < 0:
        homography = -homography
    x, y = homography[:, 0], homography[:, 1]
    rotation = se3.nearest_rotation(np.column_stack([x, y, np.cross(x, y)]))
    first = se3.transform(rotation, homography[:, 2])
    return [first, *_mirror_plane(first)]


def _mirror_plane(pose: Array) -> list[Array]:
    """Return the pose of a plane tilted the other way, which looks nearly the same; none without tilt."""
    position = pose[:3, 3]
    sight, normal = position / np.linalg.norm(position), pose[:3, 2]
    mirrored = 2 * (normal @ sight) * sight - normal
    if np.linalg.norm(mirrored - normal) < 1e-9:
        return []
    return [se3.transform(se3.turn_between(normal, mirrored) @ pose[:3, :3], position)]


def _mirror(pose: Array, points: Array) -> list[Array]:
    """Return the poses of points (m, 3) that mirror a pose (4, 4) in depth about their nearest plane."""
    centre = points.mean(0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    axes[2] *= np.linalg.det(axes)
    plane = se3.transform(axes.T, centre)
    return [mirrored @ se3.inverse(plane) for mirrored in _mirror_plane(pose @ plane)]


def _orthographic_pose(points: Array, image: Array) -> Array:
    """Return the pose of points (m, 3) that are not flat from their scaled orthographic projection."""
    sights = np.column_stack([image, np.ones(len(image))])
    sights /= np.linalg.norm(sights, axis=1)[:, None]
    axis = sights.mean(0) / np.linalg.norm(sights.mean(0))
    turn = se3.turn_between(axis, np.eye(3)[2])
    turned = sights @ turn.T
    plane = turned[:, :2] / turned[:, 2:]
    centre, middle = points.mean(0), plane.mean(0)
    affine = np.linalg.lstsq(points - centre, plane, rcond=None)[0].T
    left, scale, right = np.linalg.svd(affine, full_matrices=False)
    rows = left @ right
    depth = 1 / max(float(scale.mean()), 1e-300)
    rotation = np.vstack([rows, np.cross(rows[0], rows[1])])
    position = depth * np.append(middle, 1.0) - rotation @ centre
    return se3.transform(turn.T @ rotation, turn.T @ position)


def _projection_poses(points: Array, image: Array) -> list[Array]:
    """Return the pose of points (m, 3) from their projection matrix; none if that is singular."""
    projection = direct_linear_transform(points, image)
    scale = np.cbrt(np.linalg.det(projection[:, :3]))
    with np.errstate(all="ignore"):
        projection = projection / scale
    if not np.isfinite(projection).all():
        return []
    return [se3.transform(se3.nearest_rotation(projection[:, :3]), projection[:, 3])]


def _residuals(poses: Array, points: Array, image: Array) -> tuple[Array, Array]:
    """Return residuals (c, m, 2) and points in the camera frame (c, m, 3) of poses (c, 4, 4)."""
    local = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    depth = np.maximum(local[..., 2:], MIN_DEPTH)
    return image - local[..., :2] / depth, local


def _refine(poses: Array, views: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Minimize the distances in the image of each pose (c, 4, 4) in its view."""
    counts = np.array([len(points) for points, _ in views])
    # Views are filled up with copies of their first points, which do not count.
    index = [np.pad(np.arange(count), (0, counts.max() - count)) for count in counts]
    points = np.array([view[0][i] for view, i in zip(views, index, strict=True)])
    image = np.array([view[1][i] for view, i in zip(views, index, strict=True)])
    presence = (np.arange(counts.max()) < counts[:, None])[..., None].astype(float)
    poses = poses.copy()
    residuals, local = _residuals(poses, points, image)
    cost = np.sum(presence * residuals**2, (1, 2))
    damping = np.full(len(poses), _DAMPING)
    active = np.arange(len(poses))
    for _ in range(_N_STEPS):
        jacobian = _jacobian(local[active]) * presence[active][..., None]
        rows = jacobian.reshape(len(active), -1, 6).swapaxes(1, 2)
        normal = rows @ rows.swapaxes(1, 2)
        gradient = (rows @ residuals[active].reshape(len(active), -1, 1))[..., 0]
        scale = np.sqrt(np.maximum(np.einsum("cii->ci", normal), 1e-300))
        normal = normal / (scale[:, :, None] * scale[:, None]) + damping[active, None, None] * np.eye(6)
        step = np.linalg.solve(normal, (gradient / scale)[..., None])[..., 0] / scale
        with np.errstate(all="ignore"):
            trial = se3.exp6(step) @ poses[active]
            trial_residuals, trial_local = _residuals(trial, points[active], image[active])
            trial_cost = np.sum(presence[active] * trial_residuals**2, (1, 2))
        is_better = trial_cost < cost[active]
        better = active[is_better]
        # A Gauss-Newton step without damping reduces the cost by its product with the gradient.
        is_done = np.einsum("ci,ci->c", step, gradient) < _COST_RTOL * cost[active]
        poses[better], residuals[better] = trial[is_better], trial_residuals[is_better]
        local[better], cost[better] = trial_local[is_better], trial_cost[is_better]
        damping[active] = np.maximum(damping[active] * np.where(is_better, 0.1, 10.0), _MIN_DAMPING)
        active = active[~is_done]
        if not len(active):
            break
    is_behind = np.any(local[..., 2] <= 0, 1)
    return poses, np.where(is_behind, np.inf, np.sqrt(cost / counts))


def _jacobian(local: Array) -> Array:
    """Return the derivatives (..., m, 2, 6) of points (..., m, 3) by twists [v, ω] in camera axes."""
    depth = np.maximum(local[..., 2], MIN_DEPTH)
    by_point = np.zeros((*local.shape[:-1], 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / depth
    by_point[..., 2] = -local[..., :2] / depth[..., None] ** 2
    return np.concatenate([by_point, np.cross(local[..., None, :], by_point)], -1)


def pose_information(pose: Array, points: Array) -> Array:
    """Return the information (6, 6) about the twist of a pose in camera axes, for unit noise of X/Z, Y/Z."""
    rows = _jacobian(se3.transform_points(pose, points)).reshape(-1, 6)
    return rows.T @ rows
