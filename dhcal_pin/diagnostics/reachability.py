"""Rows that cannot be: found from the robot's own geometry before anything is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..io.measurement_csv import MeasurementFile
from ..robot.chain import Chain
from ..robot.inverse_kinematics import position_task, solve_ik, without_rotary_limits

# A row is impossible only if it is this many times as far off as the typical row, and by more than a share
# of the tool's distance from the shoulder: so far no controller strays, and no arm is wrong.
MAX_TYPICAL_RATIO, MAX_COMMANDED_OFFSET, MAX_MEASURED_OFFSET = 20.0, 0.01, 0.05


@dataclass(frozen=True)
class UnreachableRow:
    """A row that cannot be: its number (from 1), by how much (m), and why in words."""

    row: int
    size: float
    reason: str


def reach_sphere(chain: Chain) -> tuple[Array, float]:
    """A fixed point (3,) in the measuring frame and how far from it the tool can get, m.

    The point moves up the chain as long as the next origin lies on the axis just passed: for most arms
    it is the shoulder. Sliding joints add their longest stroke, and an endless one an infinite reach.
    """
    origins = np.concatenate([chain.origins[:-1], (chain.origins[-1] @ chain.tool)[None]])
    frame = chain.base @ origins[0]
    first = 1
    for j in range(1, len(chain.moving_joints)):
        step = origins[j][:3, 3]
        off_axis = step - (step @ chain.axes[j - 1]) * chain.axes[j - 1]
        if chain.prismatic[j - 1] or np.linalg.norm(off_axis) > 1e-9:
            break
        # Turning about the axis leaves points on it where they are.
        frame = frame @ se3.translation(step)
        first = j + 1
        if np.linalg.norm(np.cross(chain.axes[j - 1], _next_axis(chain, j))) > 1e-9:
            break
    stroke = np.max(np.abs(np.stack([chain.lower, chain.upper])), 0)
    # Not infinite, as other joints' zeros in the mixing would make it NaN.
    moving = np.abs(chain.mimic_matrix) @ np.where(np.isfinite(stroke), stroke, np.inf).clip(max=1e300)
    slides = float(np.sum(moving[chain.prismatic]))
    return frame[:3, 3], float(np.linalg.norm(origins[first:, :3, 3], axis=1).sum()) + slides


def _next_axis(chain: Chain, j: int) -> Array:
    return chain.origins[j][:3, :3] @ chain.axes[j]


def solve_position(chain: Chain, target: Array, near: Array) -> Array | None:
    """Joint values (n,) that put the tool point at target (3,), nearest to `near` (n,), or None."""
    rng = np.random.default_rng(0)
    start = np.concatenate([near[None], rng.uniform(-1.5, 1.5, (63, chain.n_joints))])
    q, left = solve_ik(without_rotary_limits(chain), position_task(np.broadcast_to(target, (64, 3))), start)
    q = np.where(chain.is_prismatic, q, (q + np.pi) % (2 * np.pi) - np.pi)
    good = np.flatnonzero(left < 1e-6)
    return q[good[np.argmin(np.abs(q[good] - near).sum(1))]] if good.size else None


def find_unreachable_rows(chain: Chain, readings: MeasurementFile) -> list[UnreachableRow]:
    """Impossible rows of a file, for a chain whose base and tool are known, in row order."""
    found: dict[int, UnreachableRow] = {}
    centre, radius = reach_sphere(chain)
    typical = np.median(readings.data.q, 0)
    modelled = chain.poses(readings.data.q)[:, :3, 3]
    size = np.linalg.norm(modelled - centre, axis=1).max(initial=0.0)
    # Readings repeated at one pose are typical of that pose only.
    distinct = np.unique(np.round(readings.data.q, 3), axis=0, return_index=True)[1]
    places = [("measured", readings.data.positions(), MAX_MEASURED_OFFSET)]
    if readings.commanded is not None:
        places.insert(0, ("commanded", readings.commanded, MAX_COMMANDED_OFFSET))
    for what, position, share in places:
        if not len(position):
            continue
        off = np.linalg.norm(position - modelled, axis=1)
        far = np.linalg.norm(position - centre, axis=1)
        for i in np.flatnonzero(off > max(MAX_TYPICAL_RATIO * float(np.median(off[distinct])), share * size)):
            if i + 1 in found or off[i] < 1e-6:
                continue
            reason = f"its joint values lead {1e3 * off[i]:.0f} mm away from the {what} position"
            if far[i] > radius:
                reason += (
                    f", which lies {1e3 * far[i]:.1f} mm from the shoulder of an arm that reaches "
                    f"{1e3 * radius:.1f} mm"
                )
            elif (solved := solve_position(chain, position[i], typical)) is not None:
                values = ", ".join(
                    f"{1e3 * v:.2f} mm" if slides else f"{np.rad2deg(v):.2f}°"
                    for v, slides in zip(solved, chain.is_prismatic, strict=True)
                )
                reason += f", which the arm reaches with ({values})"
            found[int(i) + 1] = UnreachableRow(int(i) + 1, float(off[i]), reason)
    return [found[row] for row in sorted(found)]
