"""Where to send a robot so that its tool, by its calibrated model, lands on what was asked for.

Two ways to use it: send the joint values, or, to a controller that keeps its nominal model, the corrected
target, which is where that model puts the tool at those joint values. The second is as good as the first
where the controller's own inverse solution is the same: a controller that folds the arm another way, or a
redundant one that picks another elbow, meets other errors there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from scipy.spatial import cKDTree
from . import se3
from ._typing import Array
from .exceptions import DhcalError
from .robot.chain import Chain
from .robot.inverse_kinematics import (
    REACHED_TOL,
    TaskError,
    characteristic_length,
    pose_task,
    position_task,
    solve_ik,
    tool_pose_and_jacobian,
    without_rotary_limits,
    wrap_into_limits,
)
from .se3 import nearest_rotation

OK, SINGULAR, LIMITS, OUT = "ok", "near singular", "joint limits", "out of reach"


# A motion of the tool, by a thousandth of the arm's size or of a radian, that takes the joints 0.2 rad.
_NEAR_SINGULAR_TOL = 5e-3


# Configurations known beforehand, and how many of the best are taken along from round to round.
_N_CONFIGURATIONS, _N_BEST = 8192, 4


# Round after round for targets that are not reached: from how many of the known ones with how many steps, if
# the tool came within this share of the arm's size.
_ROUNDS = ((8, 60, np.inf), (64, 60, np.inf), (512, 300, 0.3))


# Targets at a time, so that memory does not grow with them.
_CHUNK = 512


_ROTATION_TOL = 1e-6


@dataclass(frozen=True, eq=False)
class Compensation:
    """Joint values and corrected targets for m targets; NaN in rows that are not reached.

    Attributes:
        q: (m, n) joint values, rad or m, that put the calibrated tool on the targets, within the limits.
        poses: (m, 4, 4) corrected targets for a controller with the nominal model: where that model,
            with its own base and tool, has the tool at `q`.
        status: (m,) "ok", "near singular" (reached, but little of the tool takes much of the joints),
            "joint limits" (reached only beyond them) or "out of reach".
        residual_error: (m, 2) how far the calibrated tool stays from the targets, m and rad; the nearest that was
            found where they are not reached. The second is 0 for targets without a rotation.
    """

    q: Array
    poses: Array
    status: tuple[str, ...]
    residual_error: Array

    @property
    def reached(self) -> Array:
        """Which targets (m,) have joint values: those that are "ok" or "near singular"."""
        return np.isin(self.status, (OK, SINGULAR))


def compensate(
    nominal: Chain,
    calibrated: Chain,
    targets: ArrayLike,
    near: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
) -> Compensation:
    """Joint values that put the calibrated arm on targets, and the corrected targets for the nominal one.

    Every target is solved on the calibrated arm from many starts; what is kept is checked by forward
    kinematics to 1e-9 m and 1e-9 rad. Where the nominal inverse solution, followed from the target to the
    corrected one, ends elsewhere, the row is "near singular"; that is not asked of redundant arms.

    Args:
        nominal: what the controller believes, with its base and tool.
        calibrated: the same robot's true geometry, with its base and tool.
        targets: (m, 3) positions in m or (m, 4, 4) poses of the calibrated arm's tool, in its measuring
            frame.
        near: (n,) or (m, n) joint values; of several solutions the nearest is taken. Without it, the middle
            of the limits, or zero where there are none.
        progress: called with the number of targets done.

    Raises:
        DhcalError: the chains are of different joints, or the targets are neither positions nor poses.
    """
    if nominal.joint_names != calibrated.joint_names:
        raise DhcalError(
            f"{calibrated.urdf.source}: its joints are {', '.join(calibrated.joint_names)}; "
            f"they must be those of {nominal.urdf.source}: {', '.join(nominal.joint_names)}"
        )
    targets = _checked(targets)
    near = calibrated.validated_q(np.atleast_2d(_mid_range(calibrated) if near is None else near))
    if len(near) not in (1, len(targets)):
        raise DhcalError(f"near has {len(near)} rows; give one, or one a target ({len(targets)})")
    near = np.broadcast_to(near, (len(targets), calibrated.n_joints))
    search = _Search.from_chain(calibrated, targets.ndim == 3)
    parts = []
    for first in range(0, len(targets), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        parts.append(search.find(targets[chunk], near[chunk]))
        if progress is not None:
            progress(min(first + _CHUNK, len(targets)))
    q, status, miss = (np.concatenate(part) for part in zip(*parts, strict=True))
    reached = np.flatnonzero(status == OK)
    poses = np.full((len(q), 4, 4), np.nan)
    poses[reached] = nominal.poses(q[reached])
    delicate = _is_near_singular(nominal, calibrated, targets[reached], q[reached])
    status[reached[delicate]] = SINGULAR
    return Compensation(q, poses, tuple(status.tolist()), miss)


def _checked(targets: ArrayLike) -> Array:
    """Targets as finite (m, 3) or (m, 4, 4), rotations exact, or DhcalError."""
    out = np.array(targets, float)
    if out.shape[1:] not in ((3,), (4, 4)) or not len(out) or not np.isfinite(out).all():
        raise DhcalError(
            f"targets: finite positions (m, 3) or poses (m, 4, 4) are wanted, not shape {out.shape}"
        )
    if out.ndim == 3:
        turns = nearest_rotation(out[:, :3, :3])
        if np.abs(turns - out[:, :3, :3]).max() > _ROTATION_TOL or np.any(out[:, 3] != (0, 0, 0, 1)):
            raise DhcalError("targets: a pose is a rotation and a position over a last row 0 0 0 1")
        out[:, :3, :3] = turns
    return out


def _mid_range(chain: Chain) -> Array:
    """The middle (n,) of each joint's limits, or what is nearest to zero where there is one or none."""
    both = np.isfinite(chain.lower) & np.isfinite(chain.upper)
    with np.errstate(invalid="ignore"):
        return np.where(both, (chain.lower + chain.upper) / 2, np.clip(0.0, chain.lower, chain.upper))


@dataclass(frozen=True, eq=False)
class _Search:
    """An arm, and configurations of it found by where they bring the tool.

    Attributes:
        chain: base and tool included.
        q: (c, n) joint values within the limits.
        tree: of their tools.
        with_rotations: whether rotations matter.
    """

    chain: Chain
    q: Array
    tree: cKDTree
    with_rotations: bool

    @classmethod
    def from_chain(cls, chain: Chain, turned: bool) -> _Search:
        """Always the same configurations."""
        span = np.where(chain.is_prismatic, characteristic_length(chain), np.pi)
        middle = _mid_range(chain)
        low, high = np.maximum(chain.lower, middle - span), np.minimum(chain.upper, middle + span)
        q = np.random.default_rng(0).uniform(low, high, (_N_CONFIGURATIONS, chain.n_joints))
        # A heavy import that no other command needs.
        from scipy.spatial import cKDTree

        return cls(
            chain, q, cKDTree(_search_points(chain.poses(q), turned, characteristic_length(chain))), turned
        )

    def starts(self, targets: Array, count: int) -> Array:
        """Joint values (m, count, n) that bring the tool near targets."""
        places = (
            _search_points(targets, True, characteristic_length(self.chain))
            if self.with_rotations
            else targets
        )
        return self.q[self.tree.query(places, range(1, count + 1))[1]]

    def solve(self, chain: Chain, targets: Array, starts: Array, steps: int) -> tuple[Array, Array]:
        """Joint values (m, c, n) of a chain from starts, and how far (m, c) they miss the targets, m."""
        m, count, n = starts.shape
        q, wide = solve_ik(
            chain, _task_error(chain, targets), starts.reshape(-1, n), steps, np.repeat(np.arange(m), count)
        )
        return q.reshape(m, count, n), wide.reshape(m, count)

    def find(self, targets: Array, near: Array) -> tuple[Array, Array, Array]:
        """Joint values (m, n), status (m,) and miss (m, 2) of targets, nearest to `near` (m, n)."""
        m, n = near.shape
        q, status, miss = np.full((m, n), np.nan), np.full(m, OUT, dtype=object), np.full((m, 2), np.nan)
        scale = np.where(self.chain.is_prismatic, characteristic_length(self.chain), 1.0)
        best, missed = np.repeat(near[:, None], _N_BEST, 1), np.zeros(m)
        for count, steps, share in _ROUNDS:
            left = np.flatnonzero((status == OUT) & (missed <= share * characteristic_length(self.chain)))
            if not left.size:
                continue
            starts = np.concatenate([best[left], self.starts(targets[left], count)], 1)
            tried, _ = self.solve(self.chain, targets[left], starts, steps)
            # Whole turns less; an arm's errors need not repeat with them.
            tried, _ = wrap_into_limits(self.chain, tried, near[left, None])
            tried, wide = self.solve(self.chain, targets[left], tried, steps)
            away = np.linalg.norm((tried - near[left, None]) / scale, axis=2)
            # Those that are there first, the nearest before others; then those that miss least.
            order = np.lexsort([np.where(wide <= REACHED_TOL, away, wide), wide > REACHED_TOL])[:, :_N_BEST]
            best[left] = np.take_along_axis(tried, order[..., None], 1)
            missed[left] = wide.min(1)
            chosen = best[left, 0]
            miss[left] = _tool_error(self.chain, chosen, targets[left])
            inside = np.all((chosen >= self.chain.lower) & (chosen <= self.chain.upper), 1)
            good = np.all(miss[left] <= REACHED_TOL, 1) & inside
            q[left[good]], status[left[good]] = chosen[good], OK
        left = np.flatnonzero(status == OUT)
        _, wide = self.solve(without_rotary_limits(self.chain), targets[left], best[left], _ROUNDS[-1][1])
        status[left[np.any(wide <= REACHED_TOL, 1)]] = LIMITS
        return q, status, miss


def _task_error(chain: Chain, targets: Array) -> TaskError:
    return position_task(targets) if targets.ndim == 2 else pose_task(targets, characteristic_length(chain))


def _search_points(poses: Array, turned: bool, length: float) -> Array:
    """Points (m, 3), or (m, 12) with rotations in them, that are near to each other where poses are."""
    if not turned:
        return poses[:, :3, 3]
    # A small turn by an angle changes a rotation matrix by √2 of it.
    return np.concatenate([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9) * length / np.sqrt(2)], 1)


def _tool_error(chain: Chain, q: Array, targets: Array) -> Array:
    """Distance in m and angle in rad (m, 2) of the tool from targets; no angle where they have none."""
    poses = chain.poses(q)
    if targets.ndim == 2:
        return np.stack([np.linalg.norm(poses[:, :3, 3] - targets, axis=1), np.zeros(len(q))], 1)
    turn = se3.log3(poses[:, :3, :3] @ np.swapaxes(targets[:, :3, :3], 1, 2))
    return np.stack(
        [np.linalg.norm(poses[:, :3, 3] - targets[:, :3, 3], axis=1), np.linalg.norm(turn, axis=1)], 1
    )


def _is_near_singular(nominal: Chain, calibrated: Chain, targets: Array, q: Array) -> Array:
    """Which solutions (m,) stand at a singularity, or so near that the correction leads across it."""
    # A controller is told a pose in any case.
    asked = slice(6 if targets.ndim == 3 else 3)
    out = (
        np.minimum(_min_singular_value(nominal, q, slice(6)), _min_singular_value(calibrated, q, asked))
        < _NEAR_SINGULAR_TOL
    )
    if nominal.n_joints > 6:
        return out  # A redundant arm's controller is free in any case.
    # A controller that comes from the uncorrected target must end in the same joint values.
    told = replace(nominal, base=calibrated.base, tool=calibrated.tool)
    before, _ = solve_ik(told, _task_error(told, targets), q)
    commanded, _ = solve_ik(nominal, pose_task(nominal.poses(q), characteristic_length(nominal)), before)
    return out | np.any(_tool_error(calibrated, commanded, targets) > REACHED_TOL, 1)


def _min_singular_value(chain: Chain, q: Array, rows: slice) -> Array:
    """The smallest motion (m,) of the tool, lengths in sizes of the arm, that a unit of the joints makes."""
    twists = tool_pose_and_jacobian(chain, q)[1]
    twists[:, :3] /= characteristic_length(chain)
    twists[:, :, chain.is_prismatic] *= characteristic_length(chain)
    return np.linalg.svd(twists[:, rows], compute_uv=False)[:, -1]
