"""Positions from the wire lengths of the paper's three-wire device, and points from distances.

A point p at distance L_i from the anchor P_i satisfies |p - P_i|² = L_i². Differences of these equations are
linear in p. For three anchors the remaining equation is quadratic, (41) of the paper; its two solutions are
mirror images in the plane of the anchors, which lengths cannot distinguish. As dL = U·dp, where U has the
rows (p - P_i)/L_i, noise σ of the lengths gives the positions the covariance σ²·(UᵀU)⁻¹.

Two equations of the paper are misprinted: y must be (L3² - L2²)/4b, and z must be
(L2² + L3² - 2(L1² - a² + b² + c²))/4(a - c). The absolute value under the root of x would hide lengths that
do not meet.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..subsampling import evenly_spaced_indices
from .validation import validated_array

# Anchors of the paper's device closer to one line than this are collinear, relative to its largest dimension.
MIN_RELATIVE_DIMENSION = 1e-9
# Extents of known points below this fraction of the largest are zero when a point is located.
POINT_RCOND = 1e-9
# Damping of the first step of a located point, largest number of steps, and step relative to the largest
# distance that ends them.
_INITIAL_DAMPING, _MAX_REFINEMENTS, _NEGLIGIBLE_STEP = 1e-6, 30, 1e-9
# Largest number of known points that a point is located from.
_MAX_POINTS = 300
# Largest RMS change of the distances to a mirror image, relative to their mean, that a fit could explain, and
# smallest distance of the image from the located point.
_MAX_MIRROR_CHANGE = 0.02
# Smallest length by which a direction is divided [m]: a wire of length zero has no direction.
MIN_DIVISOR = 1e-12


def norm_and_direction(vectors: Array, axis: int) -> tuple[Array, Array]:
    """Return the norms of vectors and the unit vectors along them."""
    norm = np.linalg.norm(vectors, axis=axis)
    return norm, vectors / np.expand_dims(np.maximum(norm, MIN_DIVISOR), axis)


def device_anchors(a: float, b: float, c: float) -> Array:
    """Return the anchors P1 (0, 0, a), P2 (0, b, c) and P3 (0, -b, c) of the paper's device (40) [m]."""
    return np.array([[0, 0, a], [0, b, c], [0, -b, c]], float)


def trilaterate_three_wires(lengths: ArrayLike, a: float, b: float, c: float, side: int = 1) -> Array:
    """Compute positions (m, 3) [m] from the lengths L1, L2, L3 of the paper's device in closed form (41).

    The anchors are those of `device_anchors`. Their plane is a mirror; `side` is the sign of x. Collinear
    anchors (a = c or b = 0) and lengths that are negative or do not meet raise `InvalidArgumentError`.
    """
    rows = validated_array(lengths, (None, 3), "three wires: lengths")
    if (negative := np.flatnonzero((rows < 0).any(1))).size:
        raise InvalidArgumentError(
            f"three wires: a length of sample {negative[0] + 1} is negative; expected lengths in m"
        )
    l1, l2, l3 = rows.T
    scale = max(abs(a), abs(b), abs(c))
    if min(abs(a - c), abs(b)) <= MIN_RELATIVE_DIMENSION * scale:
        raise InvalidArgumentError(
            f"three wires: the anchors a={a:g}, b={b:g}, c={c:g} lie on one line; expected a triangle"
        )
    y = (l3**2 - l2**2) / (4 * b)
    z = (l2**2 + l3**2 - 2 * (l1**2 - a**2 + b**2 + c**2)) / (4 * (a - c))
    x_squared = l1**2 - y**2 - (z - a) ** 2
    if (bad := np.flatnonzero(x_squared < 0)).size:
        raise InvalidArgumentError(
            f"three wires: the lengths of sample {bad[0] + 1} do not meet (x² = {x_squared[bad[0]]:.3g} m²); "
            "check its lengths and the anchors, or remove the sample"
        )
    return np.stack([np.sign(side) * np.sqrt(x_squared), y, z], -1)


def position_dilution(points: ArrayLike, anchors: ArrayLike) -> Array:
    """Compute how much the noise of the lengths is amplified along x, y and z, shape (m, 3)."""
    vectors = np.asarray(points, float)[:, None] - np.asarray(anchors, float)
    rows = vectors / np.linalg.norm(vectors, axis=2, keepdims=True)
    return np.sqrt(np.diagonal(np.linalg.pinv(rows.swapaxes(1, 2) @ rows), axis1=1, axis2=2))


def locate_point(points: ArrayLike, distances: ArrayLike) -> Array:
    """Locate the point (3,) with distances (m,) to known points (m, 3) [m], by nonlinear least squares."""
    drawn = evenly_spaced_indices(len(np.asarray(points)), _MAX_POINTS)
    points, distances = np.asarray(points, float)[drawn], np.asarray(distances, float)[drawn]
    located, costs = _refine(points, distances, _point_starts(points, distances))
    return located[np.argmin(costs)]


def mirror_images(points: ArrayLike, located: ArrayLike) -> Array:
    """Return other points (k, 3) with nearly the distances of a located one (3,) from known points (m, 3)."""
    # Points near a plane have one, its mirror image, and points near a line three at right angles.
    points, located = np.asarray(points, float), np.asarray(located, float)
    centre = points.mean(0)
    axes = _principal_axes(points - centre)[2]
    reflections = (np.array([[1, 1, -1], [1, -1, 1], [1, -1, -1]]) * (axes @ (located - centre))) @ axes
    distances = np.linalg.norm(points - located, axis=1)
    changes = np.linalg.norm(points - (centre + reflections)[:, None], axis=2) - distances
    is_near = np.sqrt(np.mean(changes**2, 1)) <= _MAX_MIRROR_CHANGE * distances.mean()
    is_other = np.linalg.norm(centre + reflections - located, axis=1) > _MAX_MIRROR_CHANGE * distances.mean()
    return (centre + reflections)[is_near & is_other]


def _principal_axes(arms: Array) -> tuple[Array, Array, Array]:
    """Return the singular value decomposition of vectors (m, 3), with three values also of fewer vectors."""
    padded = np.concatenate([arms, np.zeros((max(0, 3 - len(arms)), 3))])
    left, extents, axes = np.linalg.svd(padded, full_matrices=False)
    return left[: len(arms)], extents, axes


def _point_starts(points: Array, distances: Array) -> Array:
    """Return points (7, 3) that have about the given distances, from linear equations."""
    # Directions in which the known points hardly extend are badly determined. Without the last one or two,
    # the mean square of the distances says how far the point is from the others, but not on which side.
    centre = points.mean(0)
    arms = points - centre
    squares = distances**2 - np.sum(arms**2, 1)
    left, extents, axes = _principal_axes(arms)
    inverse = np.divide(1, extents, out=np.zeros(3), where=extents > POINT_RCOND * extents[0])
    linear = -0.5 * inverse * (left.T @ (squares - squares.mean()))
    starts = [linear]
    for n_known in (2, 1):
        known = np.where(np.arange(3) < n_known, linear, 0.0)
        height = np.sqrt(max(squares.mean() - known @ known, 0.0))
        starts += [known + sign * height * axis for axis in np.eye(3)[n_known:] for sign in (1, -1)]
    return centre + np.array(starts) @ axes


def _refine(points: Array, distances: Array, starts: Array) -> tuple[Array, Array]:
    """Fit points (k, 3) to their distances by damped steps from starts; return them with their costs (k,)."""
    located, damping = starts, np.full(len(starts), _INITIAL_DAMPING)
    directions, errors = _directions_and_errors(points, distances, located)
    costs = np.sum(errors**2, 1)
    for _ in range(_MAX_REFINEMENTS):
        information = directions.swapaxes(1, 2) @ directions
        information += (damping * len(points))[:, None, None] * np.eye(3)
        right = directions.swapaxes(1, 2) @ errors[..., None]
        steps = np.linalg.solve(information, right)[..., 0]
        trial_directions, trial_errors = _directions_and_errors(points, distances, located + steps)
        trial_costs = np.sum(trial_errors**2, 1)
        is_better = trial_costs < costs
        damping = np.where(is_better, 0.1, 10.0) * damping
        located = np.where(is_better[:, None], located + steps, located)
        errors = np.where(is_better[:, None], trial_errors, errors)
        directions = np.where(is_better[:, None, None], trial_directions, directions)
        costs = np.minimum(costs, trial_costs)
        if np.linalg.norm(steps[np.argmin(costs)]) <= _NEGLIGIBLE_STEP * distances.max():
            break
    return located, costs


def _directions_and_errors(points: Array, distances: Array, located: Array) -> tuple[Array, Array]:
    """Return unit vectors (k, m, 3) from known points to located ones, and errors (k, m) of the distances."""
    arms = located[:, None] - points
    norms, directions = norm_and_direction(arms, 2)
    return directions, distances - norms
