"""Joint values that put the tool where it is asked for, within the joints' limits, many samples at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError
from .chain import Chain

# From tool poses (r, 4, 4) of the samples numbered (r,) to gaps (r, k) in m, and their derivatives (r, k, 6)
# by the tool's twist [v, ω] in axes of the measuring frame, or (r, k, 3) where v alone matters.
TaskError = Callable[[Array, Array], tuple[Array, Array]]


# Damping is this share of the squared gap at first, and never less than what a singularity needs (m²).
_DAMPING, _MIN_DAMPING = 0.1, 1e-9


# It eases where a step closed the gap by something, and brakes where it did not and is taken back.
_DAMPING_DECREASE, _DAMPING_INCREASE = 0.5, 8.0


# No joint moves further at once, rad or m.
_MAX_STEP = 1.0


_GAP_TOL = 1e-14


# A wrist alone has no size to speak of, m.
_MIN_LENGTH = 0.05


# A gap that has not shrunk to this share within so many steps stays as it is.
_MAX_STALLED_STEPS, _MIN_PROGRESS_RATIO = 10, 0.99


REACHED_TOL = 1e-9  # m, and rad


def tool_pose_and_jacobian(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Tool poses (m, 4, 4), and the tool's twists (m, 6, n) per unit of the independent joints, at q (m, n).

    A twist is [v, ω] of the tool point, in axes of the measuring frame.
    """
    frames = chain.forward_kinematics(q)
    return frames.poses(), chain.joint_jacobian(frames).transpose(2, 1, 0)


def characteristic_length(chain: Chain) -> float:
    """A length typical of the arm, m: a radian about a joint moves the tool by about that much."""
    links = np.concatenate([chain.origins[1:-1], (chain.origins[-1] @ chain.tool)[None]])
    strokes = np.minimum(chain.upper - chain.lower, 1.0)[chain.is_prismatic]
    return max(float(np.linalg.norm(links[:, :3, 3], axis=1).sum() + strokes.sum()) / 3, _MIN_LENGTH)


def without_rotary_limits(chain: Chain) -> Chain:
    """The same arm with joints that turn without end; those that slide keep their limits."""
    turning = ~chain.is_prismatic
    return replace(
        chain,
        lower=np.where(turning, -np.inf, chain.lower),
        upper=np.where(turning, np.inf, chain.upper),
    )


def solve_ik(
    chain: Chain, task_error: TaskError, start: Array, steps: int = 200, samples: Array | None = None
) -> tuple[Array, Array]:
    """Joint values (m, n) within limits that close gaps, and how wide they stay (m,), m; damped steps.

    The damping shrinks with the gap (Sugihara, T-RO 2011), so that the end is Newton's; a step that widens
    the gap is taken back. A joint that would leave its limits is held there while the others take its part.
    Where no start closes a gap, the end is where it is narrowest nearby.

    Args:
        chain: base and tool included.
        task_error: of the samples.
        start: (m, n) joint values.
        steps: most of them.
        samples: (m,) the numbers by which `gap` knows the rows of `start`; 0 to m-1 without.
    """
    samples = np.arange(len(start)) if samples is None else samples
    q = np.clip(chain.validated_q(start), chain.lower, chain.upper)
    wide, rows = _gaps(chain, task_error, q, samples)
    width = np.linalg.norm(wide, axis=1)
    damping, marked = np.full(len(q), _DAMPING), np.full(len(q), np.inf)
    left = np.arange(len(q))
    for count in range(steps):
        go = width[left] > _GAP_TOL
        if count % _MAX_STALLED_STEPS == 0:
            go &= width[left] < _MIN_PROGRESS_RATIO * marked[left]
            marked[left] = width[left]
        left = left[go]
        if not left.size:
            break
        at, slope = q[left], rows[left]
        amount = _MIN_DAMPING + damping[left] * width[left] ** 2
        step = _damped(slope, wide[left], amount)
        held = ((at <= chain.lower) & (step < 0)) | ((at >= chain.upper) & (step > 0))
        if held.any():
            step = _damped(np.where(held[:, None], 0.0, slope), wide[left], amount)
        step /= np.maximum(1.0, np.abs(step).max(1, keepdims=True) / _MAX_STEP)
        at = np.clip(at + step, chain.lower, chain.upper)
        new_wide, new_rows = _gaps(chain, task_error, at, samples[left])
        new_width = np.linalg.norm(new_wide, axis=1)
        closer = new_width < width[left]
        damping[left] *= np.where(closer, _DAMPING_DECREASE, _DAMPING_INCREASE)
        taken = left[closer]
        q[taken], width[taken] = at[closer], new_width[closer]
        wide[taken], rows[taken] = new_wide[closer], new_rows[closer]
    return q, width


def _gaps(chain: Chain, gap: TaskError, q: Array, samples: Array) -> tuple[Array, Array]:
    """Gaps (r, k) at q (r, n), and their derivatives (r, k, n) by the joints."""
    poses, twists = tool_pose_and_jacobian(chain, q)
    wide, by_twist = gap(poses, samples)
    return wide, by_twist @ twists[:, : by_twist.shape[-1]]


def _damped(rows: Array, wide: Array, damping: Array) -> Array:
    """Steps (r, n) that close gaps (r, k) to first order, their derivatives by the joints being (r, k, n)."""
    across = np.swapaxes(rows, 1, 2)
    damped = rows @ across + damping[:, None, None] * np.eye(wide.shape[1])
    return -(across @ np.linalg.solve(damped, wide[..., None]))[..., 0]


def position_task(targets: Array) -> TaskError:
    """The gap to positions (m, 3)."""
    return lambda poses, which: (
        poses[:, :3, 3] - targets[which],
        np.broadcast_to(np.eye(3), (len(poses), 3, 3)),
    )


def pose_task(targets: Array, length: float) -> TaskError:
    """The gap to poses (m, 4, 4), a radian of rotation counting for `length` metres."""
    scale = np.diag([1.0, 1.0, 1.0, length, length, length])

    def gap(poses: Array, which: Array) -> tuple[Array, Array]:
        wanted = targets[which]
        turn = se3.log3(poses[:, :3, :3] @ np.swapaxes(wanted[:, :3, :3], 1, 2))
        wide = np.concatenate([poses[:, :3, 3] - wanted[:, :3, 3], length * turn], 1)
        # The rotation's own derivative is the identity at the target, and has no bound half a turn away.
        return wide, np.broadcast_to(scale, (len(poses), 6, 6))

    return gap


def wrap_into_limits(chain: Chain, q: Array, near: Array | float = 0.0) -> tuple[Array, Array]:
    """The same configurations (..., n) less whole turns, and which of them (...) keep the joints' limits.

    Args:
        chain: the arm.
        q: (..., n) joint values.
        near: (..., n) what turning joints come within half a turn of, where their limits let them.
    """
    turning = ~chain.is_prismatic & np.all(chain.mimic_matrix % 1 == 0, 0)
    home = near + (q - near + np.pi) % (2 * np.pi) - np.pi
    home = home + 2 * np.pi * ((home < chain.lower).astype(float) - (home > chain.upper))
    q = np.where(turning, home, q)
    return q, np.all((q >= chain.lower) & (q <= chain.upper), -1)


def solve_within_limits(chain: Chain, task_error: TaskError, start: Array, rng: np.random.Generator) -> Array:
    """Joint values (m, n) that close every gap, within the joints' limits where such are found.

    Args:
        chain: base and tool included.
        task_error: of the samples, which are the rows of `start`.
        start: (m, n) joint values.
        rng: draws the other starts, for gaps that stay open and joints beyond their limits.

    Raises:
        DhcalError: a gap stays open.
    """
    free = without_rotary_limits(chain)
    out, closed, kept = start.copy(), np.zeros(len(start), bool), np.zeros(len(start), bool)
    again, left = start, np.arange(len(start))
    for _ in range(100):
        q, wide = solve_ik(free, task_error, again, 60, left)
        q, allowed = wrap_into_limits(chain, q)
        good = (wide <= REACHED_TOL) & (allowed | ~closed[left])
        out[left[good]] = q[good]
        closed[left] |= good
        kept[left] |= good & allowed
        left = np.flatnonzero(~kept)
        if not left.size:
            break
        again = start[rng.integers(0, len(start), len(left))] + rng.uniform(
            -1, 1, (len(left), chain.n_joints)
        )
    if not closed.all():
        raise DhcalError("the simulated instrument is out of this arm's reach; try other joint values")
    return out
