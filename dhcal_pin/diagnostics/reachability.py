"""Rows of a measurement file that are impossible for the robot's geometry, found before the fit.

For a robot whose base and tool are known, the joint positions of a row give the position p of the tool point.
A row is impossible if a measured or commanded position z is much farther from p than in typical rows:

    |z - p| > max(20·median|z - p|, share·R),     R: largest distance of the tool point from the shoulder

The reason that is reported says whether the position is out of reach, or with which joint positions the robot
would reach it.
"""

from __future__ import annotations

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..io.measurement_files import MeasurementFile
from ..robot.chain import Chain
from ..robot.inverse_kinematics import position_task, solve_ik, without_rotary_limits

# An impossible row is this many times as far off as the typical row.
MAX_TYPICAL_RATIO = 20.0
# It is also farther off than these shares of R: no controller deviates by 1 % from its command, and the
# geometry of no robot is wrong by 5 %.
MAX_COMMANDED_OFFSET, MAX_MEASURED_OFFSET = 0.01, 0.05
# Rounding of a position that equals the modelled one [m].
EXACT_POSITION_TOL = 1e-6
# Joint positions that agree to this many decimals [rad or m] are one pose, at which measurements were
# repeated.
POSE_DECIMALS = 3
# Two axes with a smaller sine between them, or a distance [m] smaller than this, are regarded as meeting.
AXIS_TOL = 1e-9
# Initial joint positions of a solution: the typical ones, and this many random ones within ±1.5 rad or m.
N_RANDOM_STARTS, START_RANGE = 63, 1.5
# Largest remaining position error of a solution [m].
SOLUTION_TOL = 1e-6


@frozen
class UnreachableRow:
    """Row of a file that is impossible."""

    row: int  #: Line in the file; for data from Python the number of the sample, from 1.
    error: float  #: Distance between the position and the one at the row's joint positions [m].
    reason: str  #: Explanation for users, without a full stop.


def reach_sphere(chain: Chain) -> tuple[Array, float]:
    """Return the centre and radius of a sphere that the tool point cannot leave."""
    # The centre moves up the chain as long as the next origin lies on the axis just passed; it is mostly the
    # shoulder. Prismatic joints add their longest stroke; one without limits makes the radius infinite.
    origins = np.concatenate([chain.origins[:-1], (chain.origins[-1] @ chain.tool)[None]])
    frame = chain.base @ origins[0]
    first = 1
    for j in range(1, len(chain.moving_joints)):
        step = origins[j][:3, 3]
        off_axis = step - (step @ chain.axes[j - 1]) * chain.axes[j - 1]
        if chain.prismatic[j - 1] or np.linalg.norm(off_axis) > AXIS_TOL:
            break
        # A rotation about the axis does not move points on the axis.
        frame = frame @ se3.translation(step)
        first = j + 1
        next_axis = chain.origins[j][:3, :3] @ chain.axes[j]
        if np.linalg.norm(np.cross(chain.axes[j - 1], next_axis)) > AXIS_TOL:
            break
    limits = np.max(np.abs(np.stack([chain.lower, chain.upper])), 0)
    # Large instead of infinite, as zeros of the mimic matrix times infinity would be NaN.
    strokes = np.abs(chain.mimic_matrix) @ np.where(np.isfinite(limits), limits, np.inf).clip(max=1e300)
    stroke = float(np.sum(strokes[chain.prismatic]))
    return frame[:3, 3], float(np.linalg.norm(origins[first:, :3, 3], axis=1).sum()) + stroke


def solve_position(chain: Chain, target: Array, near: Array) -> Array | None:
    """Find joint positions (n,) near given ones that move the tool point to (3,) [m], or None."""
    rng = np.random.default_rng(0)
    starts = rng.uniform(-START_RANGE, START_RANGE, (N_RANDOM_STARTS, chain.n_joints))
    targets = np.broadcast_to(target, (N_RANDOM_STARTS + 1, 3))
    starts = np.concatenate([near[None], starts])
    q, errors = solve_ik(without_rotary_limits(chain), position_task(targets), starts)
    q = np.where(chain.is_prismatic, q, (q + np.pi) % (2 * np.pi) - np.pi)
    good = np.flatnonzero(errors < SOLUTION_TOL)
    return q[good[np.argmin(np.abs(q[good] - near).sum(1))]] if good.size else None


def find_unreachable_rows(chain: Chain, file: MeasurementFile) -> list[UnreachableRow]:
    """Find the impossible rows of a file."""
    impossible: dict[int, UnreachableRow] = {}
    rows = file.data.rows.tolist()
    centre, radius = reach_sphere(chain)
    q = file.data.q
    modelled = chain.poses(q)[:, :3, 3]
    extent = np.linalg.norm(modelled - centre, axis=1).max(initial=0.0)
    # One row of each pose: measurements repeated at one pose are typical of that pose only.
    distinct = np.unique(np.round(q, POSE_DECIMALS), axis=0, return_index=True)[1]
    checks = [("measured", file.data.positions(), MAX_MEASURED_OFFSET)]
    if file.commanded is not None:
        checks.insert(0, ("commanded", file.commanded, MAX_COMMANDED_OFFSET))
    for what, positions, share in checks:
        if not len(positions):
            continue
        errors = np.linalg.norm(positions - modelled, axis=1)
        limit = max(MAX_TYPICAL_RATIO * float(np.median(errors[distinct])), share * extent)
        for i in np.flatnonzero(errors > limit):
            if rows[i] in impossible or errors[i] < EXACT_POSITION_TOL:
                continue
            reason = f"its joint positions lead {1e3 * errors[i]:.0f} mm away from the {what} position"
            distance = np.linalg.norm(positions[i] - centre)
            if distance > radius:
                reason += (
                    f", which is {1e3 * distance:.1f} mm from the shoulder although the robot reaches "
                    f"{1e3 * radius:.1f} mm"
                )
            elif (solution := solve_position(chain, positions[i], np.median(q, 0))) is not None:
                reason += f", which the robot reaches with ({_format_joints(chain, solution)})"
            impossible[rows[i]] = UnreachableRow(rows[i], float(errors[i]), reason)
    return [impossible[row] for row in sorted(impossible)]


def _format_joints(chain: Chain, q: Array) -> str:
    """Return joint positions (n,) as a text in degrees and millimetres."""
    return ", ".join(
        f"{1e3 * value:.2f} mm" if is_prismatic else f"{np.rad2deg(value):.2f}°"
        for value, is_prismatic in zip(q, chain.is_prismatic, strict=True)
    )
