"""Joint values that put the tool point where it is asked for, many samples at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .chain import Chain
from .errors import DhcalError
from .se3 import Array

Gap = Callable[[Array], tuple[Array, Array]]

# Squared metres added to J·Jᵀ: harmless a step away from a singularity, kind at one.
_DAMPING = 1e-6
REACHED = 1e-9  # m


def joint_velocities(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Tool points (m, 3) and their Jacobians (m, 3, n) by the independent joints at q (m, n)."""
    sweep = chain.sweep(q)
    return sweep.tool[3].T, chain.joint_velocities(sweep)[:, :3].transpose(2, 1, 0)


def solve(chain: Chain, gap: Gap, start: Array, steps: int = 200) -> tuple[Array, Array]:
    """Joint values (m, n) that close gaps of the tool points, and how wide they stay (m,); damped steps.

    Args:
        chain: base and tool included.
        gap: from tool points (m, 3) to gaps (m, k) and their derivatives (m, k, 3) by the points.
        start: (m, n) joint values.
        steps: most of them.
    """
    q = np.array(chain.checked(start))
    for _ in range(steps):
        points, jacobian = joint_velocities(chain, q)
        wide, by_point = gap(points)
        if np.abs(wide).max(initial=0.0) < 1e-14:
            break
        rows = by_point @ jacobian
        across = np.swapaxes(rows, 1, 2)
        damped = rows @ across + _DAMPING * np.eye(wide.shape[1])
        q -= (across @ np.linalg.solve(damped, wide[..., None]))[..., 0]
    return q, np.linalg.norm(gap(chain.poses(q)[:, :3, 3])[0], axis=1)


def to_positions(targets: Array) -> Gap:
    """The gap to positions (m, 3)."""
    return lambda points: (points - targets, np.broadcast_to(np.eye(3), (len(points), 3, 3)))


def within(chain: Chain, q: Array) -> tuple[Array, Array]:
    """The same configurations (m, n) less whole turns, and which of them (m,) keep the joints' limits."""
    turning = ~np.any(chain.mixing[chain.prismatic] != 0, 0) & np.all(chain.mixing % 1 == 0, 0)
    home = (q + np.pi) % (2 * np.pi) - np.pi
    home = home + 2 * np.pi * ((home < chain.lower).astype(float) - (home > chain.upper))
    q = np.where(turning, home, q)
    return q, np.all((q >= chain.lower) & (q <= chain.upper), 1)


def land(chain: Chain, gap: Callable[[Array], Gap], start: Array, rng: np.random.Generator) -> Array:
    """Joint values (m, n) that close every gap, within the joints' limits where such are found.

    Args:
        chain: base and tool included.
        gap: from sample numbers to their gap.
        start: (m, n) joint values.
        rng: draws the other starts, for gaps that stay open and joints beyond their limits.

    Raises:
        DhcalError: a gap stays open.
    """
    out, closed, kept = start.copy(), np.zeros(len(start), bool), np.zeros(len(start), bool)
    again, left = start, np.arange(len(start))
    for _ in range(100):
        q, wide = solve(chain, gap(left), again, 60)
        q, allowed = within(chain, q)
        good = (wide <= REACHED) & (allowed | ~closed[left])
        out[left[good]] = q[good]
        closed[left] |= good
        kept[left] |= good & allowed
        left = np.flatnonzero(~kept)
        if not left.size:
            break
        again = start[rng.integers(0, len(start), len(left))] + rng.uniform(-1, 1, (len(left), chain.size))
    if not closed.all():
        raise DhcalError("the simulated instrument is out of this arm's reach; try other joint values")
    return out
