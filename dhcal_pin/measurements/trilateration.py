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

# Anchors of the paper's device closer to one line than this are collinear, relative to its largest dimension.
MIN_RELATIVE_DIMENSION = 1e-9
# Relative singular values below this are cut when a point is located.
POINT_RCOND = 1e-9


def device_anchors(a: float, b: float, c: float) -> Array:
    """Return the anchors P1 (0, 0, a), P2 (0, b, c) and P3 (0, -b, c) of the paper's device (40) [m]."""
    return np.array([[0, 0, a], [0, b, c], [0, -b, c]], float)


def trilaterate_three_wires(lengths: ArrayLike, a: float, b: float, c: float, side: int = 1) -> Array:
    """Compute positions (m, 3) [m] from the lengths L1, L2, L3 of the paper's device in closed form (41).

    The anchors are those of `device_anchors`. Their plane is a mirror; `side` is the sign of x. Collinear
    anchors (a = c or b = 0) and lengths that do not meet raise `InvalidArgumentError`.
    """
    l1, l2, l3 = np.asarray(lengths, float).T
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
    """Locate the point (3,) with distances (m,) to known points (m, 3) [m], by linear least squares."""
    points, distances = np.asarray(points, float), np.asarray(distances, float)
    centre = points.mean(0)
    arms = points - centre
    right = 0.5 * (np.sum(arms**2, 1) - distances**2)
    return centre + np.linalg.lstsq(arms, right - right.mean(), rcond=POINT_RCOND)[0]
