"""Positions from wire lengths: the paper's three-wire device (40) to (42), and any number of anchors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array
from ..exceptions import DhcalError


def device_anchors(a: float, b: float, c: float) -> Array:
    """The paper's anchors P1 (0, 0, a), P2 (0, b, c), P3 (0, -b, c) as (3, 3), in m (40)."""
    return np.array([[0, 0, a], [0, b, c], [0, -b, c]], float)


def three_wires(lengths: ArrayLike, a: float, b: float, c: float, side: int = 1) -> Array:
    """Positions (m, 3) in the device's frame from L1, L2, L3 (m, 3): the closed form (41), m.

    Errata: y is (L3² - L2²)/4b; z is (L2² + L3² - 2(L1² - a² + b² + c²))/4(a - c); bars under the
    root of x would hide a negative radicand.

    Args:
        lengths: L1, L2, L3 of each sample.
        a: anchor P1 is (0, 0, a), m.
        b: anchors P2 and P3 are (0, ±b, c), m.
        c: see b.
        side: the sign of x. The anchors' plane is a mirror: lengths cannot tell.

    Raises:
        DhcalError: anchors on one line (a = c or b = 0), or lengths that do not meet.
    """
    l1, l2, l3 = np.asarray(lengths, float).T
    scale = max(abs(a), abs(b), abs(c))
    if abs(a - c) <= 1e-9 * scale or abs(b) <= 1e-9 * scale:
        raise DhcalError(f"three wires: anchors a={a:g}, b={b:g}, c={c:g} lie on one line; move one off it")
    y = (l3**2 - l2**2) / (4 * b)
    z = (l2**2 + l3**2 - 2 * (l1**2 - a**2 + b**2 + c**2)) / (4 * (a - c))
    square = l1**2 - y**2 - (z - a) ** 2
    bad = np.flatnonzero(square < 0)
    if bad.size:
        raise DhcalError(
            f"three wires: sample {bad[0] + 1} has lengths that do not meet (x² = {square[bad[0]]:.3g} m²); "
            "check its readings and the anchors, or leave it out"
        )
    return np.stack([np.sign(side) * np.sqrt(square), y, z], -1)


def trilaterate(lengths: ArrayLike, anchors: ArrayLike, side: int = 1) -> Array:
    """Positions (m, 3) from lengths (m, w) to w ≥ 3 anchors (w, 3), all in m.

    Linear differences give a start; where the anchors lie in a plane, `side` is the sign along its
    normal (n = (P2 - P1) × (P3 - P1)); then Gauss-Newton on the lengths.

    Raises:
        DhcalError: fewer than three anchors, anchors on one line, or lengths that do not meet.
    """
    lengths, anchors = np.asarray(lengths, float), np.asarray(anchors, float)
    centre = anchors.mean(0)
    arms = anchors - centre
    if len(anchors) < 3 or (s := np.linalg.svd(arms, compute_uv=False))[1] < 1e-6 * s[0]:
        raise DhcalError("trilateration needs three anchors that do not lie on one line")
    # |p-Pi|² = Li² minus its mean over the anchors is linear in p.
    right = 0.5 * (np.sum(arms**2, 1) - lengths**2)
    right -= right.mean(1, keepdims=True)
    offset = np.linalg.lstsq(arms, right.T, rcond=1e-6)[0].T
    if s[2] < 1e-6 * s[0]:
        normal = np.cross(anchors[1] - anchors[0], anchors[2] - anchors[0])
        normal /= np.linalg.norm(normal)
        height = np.mean(lengths**2 - np.sum((offset[:, None] - arms) ** 2, 2), 1)
        bad = np.flatnonzero(height < 0)
        if bad.size:
            raise DhcalError(
                f"trilateration: sample {bad[0] + 1} has lengths that do not meet "
                f"(height² = {height[bad[0]]:.3g} m²); check its readings and the anchors, or leave it out"
            )
        offset = offset + (np.sign(side) * np.sqrt(height))[:, None] * normal
    points = centre + offset
    for _ in range(20 if len(anchors) > 3 else 0):
        reach = points[:, None] - anchors
        modelled = np.linalg.norm(reach, axis=2)
        rows = reach / modelled[..., None]
        step = np.linalg.pinv(rows) @ (lengths - modelled)[..., None]
        points = points + step[..., 0]
    return points


def dilution(points: ArrayLike, anchors: ArrayLike) -> Array:
    """How much a wire's noise grows along x, y, z, (m, 3): roots of the diagonal of (UᵀU)⁻¹.

    U has rows (p - P_i)/L_i, as dL = U·dp.
    """
    reach = np.asarray(points, float)[:, None] - np.asarray(anchors, float)
    rows = reach / np.linalg.norm(reach, axis=2, keepdims=True)
    return np.sqrt(np.diagonal(np.linalg.pinv(rows.swapaxes(1, 2) @ rows), axis1=1, axis2=2))


def anchors_of(points: ArrayLike, lengths: ArrayLike) -> Array:
    """The point (3,) whose distances to points (m, 3) are nearest to lengths (m,): a start for an anchor."""
    points, lengths = np.asarray(points, float), np.asarray(lengths, float)
    centre = points.mean(0)
    arms = points - centre
    right = 0.5 * (np.sum(arms**2, 1) - lengths**2)
    return centre + np.linalg.lstsq(arms, right - right.mean(), rcond=1e-9)[0]
