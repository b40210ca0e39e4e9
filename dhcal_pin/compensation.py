"""Compensation: joint positions and corrected targets that bring a calibrated tool to its targets.

With the nominal kinematics f_0 of the controller and the calibrated kinematics f, each target T is solved for
q with f(q) = T within the joint limits. There are two ways to use the result: send q, or send the corrected
target f_0(q) to a controller that keeps its nominal model. Both are equivalent if the inverse solution of the
controller is q. A controller that chooses another configuration of the arm, or another elbow of a redundant
arm, has other errors.

The solver starts from the given joint positions and from the nearest of a fixed random set of configurations,
found by a k-d tree of their tool poses. Unsolved targets are tried again with more starts. Among several
solutions the one nearest to the given joint positions is chosen.

An arm with fewer than six joints cannot reach every orientation, and the errors of its links tilt its tool.
It reaches the position of a pose exactly, and the orientation as nearly as its joints allow: the rotation
vector has a small weight, and the position is corrected at the end.

Shapes: m targets, n joints, c starts of a target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from . import se3
from ._frozen import frozen
from ._typing import Array
from .exceptions import InvalidArgumentError
from .robot.chain import Chain
from .robot.conditions import Conditions
from .robot.inverse_kinematics import (
    REACHED_TOL,
    TaskError,
    characteristic_length,
    correct_for_conditions,
    pose_task,
    position_task,
    solve_ik,
    tool_pose_and_jacobian,
    without_rotary_limits,
    wrap_into_limits,
)
from .se3 import nearest_rotation

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Values of `Compensation.status`.
OK, SINGULAR, LIMITS, OUT = "ok", "near singular", "joint limits", "out of reach"
OTHER = "other configuration"

# A solution is another configuration of the arm if a joint is farther from the given position [rad].
_MAX_ROTATION = np.pi / 2

# A target is near a singularity if a joint rate of 1 rad moves the tool by less than this, as a fraction of
# the characteristic length per radian [1] or as an angle [rad/rad].
_NEAR_SINGULAR_TOL = 5e-3

# A target on the edge of the workspace counts as reached if it is missed by less than this, as a fraction of
# the characteristic length [1] or as an angle [rad]: a hundredth of the accuracy of calibrated arms.
_NEGLIGIBLE_MISS = 1e-5

# If an arm has fewer than six joints, a radian counts as this fraction of the characteristic length. The
# largest angle between the tool of such an arm and a target that counts as reached [rad].
_MINOR_WEIGHT, _MAX_TILT = 1e-2, np.deg2rad(10.0)

# Number of random configurations, and of the best solutions of a round that are starts of the next one.
_N_CONFIGURATIONS, _N_BEST = 8192, 4

# Rounds for targets that are not solved yet: number of starts, number of steps, and the largest position
# error so far, as a multiple of the characteristic length, with which a target takes part.
_ROUNDS = ((8, 60, np.inf), (64, 60, np.inf), (512, 300, 0.3))

# Number of targets that are solved together, which bounds the memory.
_CHUNK_SIZE = 512

# Maximum deviation of the elements of a target's rotation from those of the nearest rotation.
_ROTATION_TOL = 1e-6


@frozen(eq=False)
class Compensation:
    """Joint positions and corrected targets for m targets; NaN for targets that are not reached.

    Attributes:
        q: Joint positions within the limits that bring the calibrated tool to the targets, shape (m, n)
            [rad or m].
        poses: Corrected targets for a controller with the nominal model, shape (m, 4, 4) [m]: the poses of
            its tool, with its own base and tool frame, at `q`.
        status: "ok", "near singular" (reached, but small motions of the tool need large motions of the
            joints), "other configuration" (reached, but a joint is more than 90° from the position that was
            given for this target), "joint limits" (reached only beyond the limits) or "out of reach", for
            each target.
        residual_error: Distance and angle between the calibrated tool and the target, shape (m, 2) [m, rad];
            of the nearest solution if the target is not reached. The angle is 0 for position targets, and
            up to 10° at poses that an arm with fewer than six joints reaches.
    """

    q: Array
    poses: Array
    status: tuple[str, ...]
    residual_error: Array

    @property
    def reached(self) -> Array:
        """Whether each target is reached, in any configuration of the arm, shape (m,)."""
        return np.isin(self.status, (OK, SINGULAR, OTHER))


def compensate(
    nominal: Chain,
    calibrated: Chain,
    targets: ArrayLike,
    near: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
    conditions: Conditions | None = None,
) -> Compensation:
    """Solve targets on the calibrated robot and correct them for a controller with the nominal model.

    Each solution is checked by forward kinematics to 1e-9 m and 1e-9 rad. On the edge of the workspace it
    may miss the target by 1e-5 rad and 1e-5 of a length typical of the arm, some micrometres. An arm with
    fewer than six joints reaches the position, and the orientation as nearly as it can. A target is
    also "near singular" if the inverse solution of the nominal model, continued from the target to the
    corrected target, ends in another configuration. This check is omitted for redundant arms.

    Args:
        nominal: Model of the controller with its base and tool.
        calibrated: Calibrated model of the same robot with its base and tool.
        targets: Positions, shape (m, 3) [m], or poses, shape (m, 4, 4) [m], of the calibrated tool in the
            measuring frame of the calibrated model.
        near: Joint positions near which solutions are preferred, shape (n,) or (m, n) [rad or m]; by default
            the middle of the limits, or zero without limits.
        progress: Function that is called with the number of targets done.
        conditions: Directions of approach, temperatures and payloads at the m targets, whose joint positions
            are not used; without them joints have no direction, and links the lengths of the model.

    Returns:
        Joint positions, corrected targets and status of each target.

    Raises:
        InvalidArgumentError: The two models have different joints, or `near` has a wrong shape.
    """
    if nominal.joint_names != calibrated.joint_names:
        raise InvalidArgumentError(
            f"{calibrated.urdf.source}: the joints are {', '.join(calibrated.joint_names)}; expected those "
            f"of {nominal.urdf.source}: {', '.join(nominal.joint_names)}"
        )
    targets = _validated_targets(targets)
    is_near_each_target = near is not None and np.ndim(near) == 2
    near = calibrated.validated_q(np.atleast_2d(_mid_range(calibrated) if near is None else near))
    if len(near) not in (1, len(targets)):
        raise InvalidArgumentError(f"near has {len(near)} rows; expected 1 or {len(targets)}, one per target")
    near = np.broadcast_to(near, (len(targets), calibrated.n_joints))
    search = _Search.from_chain(calibrated, targets.ndim == 3)
    chunks = []
    for first in range(0, len(targets), _CHUNK_SIZE):
        chunk = slice(first, first + _CHUNK_SIZE)
        chunks.append(search.find(targets[chunk], near[chunk]))
        if progress is not None:
            progress(min(first + _CHUNK_SIZE, len(targets)))
    q, status, residual_error = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    if conditions is not None:
        q, status, residual_error = _with_conditions(search, targets, q, status, residual_error, conditions)
    reached = np.flatnonzero(status == OK)
    poses = np.full((len(q), 4, 4), np.nan)
    poses[reached] = nominal.poses(q[reached])
    is_singular = _is_near_singular(nominal, search, targets[reached], q[reached])
    status[reached[is_singular]] = SINGULAR
    if is_near_each_target:
        rotations = np.where(calibrated.is_prismatic, 0.0, np.abs(q - near))
        status[(status == OK) & np.any(rotations > _MAX_ROTATION, 1)] = OTHER
    return Compensation(q, poses, tuple(status.tolist()), residual_error)


def nominal_root_pose(nominal: Chain, calibrated: Chain) -> Array:
    """Return the pose (4, 4) of the root link of the nominal robot in that of the calibrated robot."""
    # They differ if the calibrated URDF has a world joint. The link that carries the first joint is fixed to
    # both roots; if the robots call it differently, the roots are the same.
    first = nominal.urdf.joint(nominal.moving_joints[0])
    carrier = first.child if nominal.is_reversed[0] else first.parent
    if carrier not in calibrated.urdf.links:
        return np.eye(4)
    own, other = (chain.fixed_pose(chain.root, carrier) for chain in (nominal, calibrated))
    return np.eye(4) if own is None or other is None else other @ se3.inverse(own)


def _with_conditions(
    search: _Search, targets: Array, q: Array, status: Array, residual_error: Array, conditions: Conditions
) -> tuple[Array, Array, Array]:
    """Correct the solved targets for their conditions; return q, status and errors of all targets."""
    solved, chain = np.flatnonzero(status == OK), search.chain
    goals = targets[solved]
    corrected, poses = q[solved], np.empty((0, 4, 4))
    for task in search.tasks(goals):
        corrected, poses = correct_for_conditions(chain, task, corrected, conditions[solved])
    q, status, residual_error = q.copy(), status.copy(), residual_error.copy()
    q[solved], residual_error[solved] = corrected, _pose_error(poses, goals)
    within_limits = np.all((corrected >= chain.lower) & (corrected <= chain.upper), 1)
    status[solved[~within_limits]] = LIMITS
    status[solved[~search.is_negligible(residual_error[solved])]] = OUT
    return q, status, residual_error


def _validated_targets(targets: ArrayLike) -> Array:
    """Return targets as floats, shape (m, 3) or (m, 4, 4), with exact rotations, after checking them."""
    out = np.array(targets, float)
    if out.shape[1:] not in ((3,), (4, 4)) or not len(out) or not np.isfinite(out).all():
        raise InvalidArgumentError(
            f"targets have shape {out.shape} or a value that is not finite; expected finite positions "
            "(m, 3) or poses (m, 4, 4)"
        )
    if out.ndim == 3:
        rotations = nearest_rotation(out[:, :3, :3])
        if np.abs(rotations - out[:, :3, :3]).max() > _ROTATION_TOL or np.any(out[:, 3] != (0, 0, 0, 1)):
            raise InvalidArgumentError(
                "targets: a pose is not a rigid motion; expected a rotation, a position and last row 0 0 0 1"
            )
        out[:, :3, :3] = rotations
    return out


def _mid_range(chain: Chain) -> Array:
    """Return the middle of the joint limits, or the value nearest to zero without both limits, shape (n,)."""
    has_both = np.isfinite(chain.lower) & np.isfinite(chain.upper)
    with np.errstate(invalid="ignore"):
        return np.where(has_both, (chain.lower + chain.upper) / 2, np.clip(0.0, chain.lower, chain.upper))


@frozen(eq=False)
class _Search:
    """Search for joint positions that bring the tool of a chain to targets."""

    chain: Chain  # Chain with base and tool
    q: Array  # Random configurations within the limits
    tree: cKDTree  # Nearest-neighbour search of their tool poses
    with_rotations: bool  # Whether targets are poses
    is_exact: bool  # Whether the arm can reach targets exactly

    @classmethod
    def from_chain(cls, chain: Chain, with_rotations: bool) -> _Search:
        """Create a search with a fixed random set of configurations."""
        span = np.where(chain.is_prismatic, characteristic_length(chain), np.pi)
        middle = _mid_range(chain)
        low, high = np.maximum(chain.lower, middle - span), np.minimum(chain.upper, middle + span)
        q = np.random.default_rng(0).uniform(low, high, (_N_CONFIGURATIONS, chain.n_joints))
        from scipy.spatial import cKDTree  # lazy import: scipy.spatial is slow to import

        points = _search_points(chain.poses(q), with_rotations, characteristic_length(chain))
        is_exact = not with_rotations or chain.n_joints >= 6
        return cls(chain, q, cKDTree(points), with_rotations, is_exact)

    def tasks(self, targets: Array) -> list[TaskError]:
        """Return the task errors of positions or poses that are minimized one after the other."""
        if not self.with_rotations:
            return [position_task(targets)]
        of_poses = pose_task(targets, self._rotation_length)
        return [of_poses] if self.is_exact else [of_poses, position_task(targets[:, :3, 3])]

    @property
    def _rotation_length(self) -> float:
        """Length that a radian counts as in the task error of a pose [m]."""
        return characteristic_length(self.chain) * (1.0 if self.is_exact else _MINOR_WEIGHT)

    @property
    def _max_norm(self) -> float:
        """Largest norm of the task error of a target that is reached [m]."""
        return REACHED_TOL if self.is_exact else self._rotation_length * _MAX_TILT

    def is_reached(self, errors: Array) -> Array:
        """Return whether targets with errors (m, 2) [m, rad] are reached, shape (m,)."""
        return np.all(errors <= (REACHED_TOL, REACHED_TOL if self.is_exact else _MAX_TILT), 1)

    def is_negligible(self, errors: Array) -> Array:
        """Return whether errors (m, 2) [m, rad] of targets are negligible, shape (m,)."""
        limits = _NEGLIGIBLE_MISS * np.array([characteristic_length(self.chain), 1.0])
        return np.all(errors <= limits, 1) if self.is_exact else self.is_reached(errors)

    def starts(self, targets: Array, count: int) -> Array:
        """Return configurations whose tools are nearest to the targets, shape (m, count, n)."""
        points = (
            _search_points(targets, True, characteristic_length(self.chain))
            if self.with_rotations
            else targets
        )
        return self.q[self.tree.query(points, range(1, count + 1))[1]]

    def solve(self, chain: Chain, targets: Array, starts: Array, steps: int) -> tuple[Array, Array]:
        """Solve targets from several starts; return q, shape (m, c, n), and error norms, shape (m, c)."""
        m, count, n = starts.shape
        samples = np.repeat(np.arange(m), count)
        first, *others = self.tasks(targets)
        q, norms = solve_ik(chain, first, starts.reshape(-1, n), steps, samples)
        for task in others:
            q, _ = solve_ik(chain, task, q, steps, samples)
        return q.reshape(m, count, n), norms.reshape(m, count)

    def find(self, targets: Array, near: Array) -> tuple[Array, Array, Array]:
        """Return q, shape (m, n), status, shape (m,), and residual errors, shape (m, 2), of targets."""
        m, n = near.shape
        length = characteristic_length(self.chain)
        q, status = np.full((m, n), np.nan), np.full(m, OUT, dtype=object)
        residual_error = np.full((m, 2), np.nan)
        scale = np.where(self.chain.is_prismatic, length, 1.0)
        best, best_norm = np.repeat(near[:, None], _N_BEST, 1), np.zeros(m)
        for count, steps, max_error in _ROUNDS:
            open_targets = np.flatnonzero((status == OUT) & (best_norm <= max_error * length))
            if not open_targets.size:
                continue
            goals = targets[open_targets]
            starts = np.concatenate([best[open_targets], self.starts(goals, count)], 1)
            tried, _ = self.solve(self.chain, goals, starts, steps)
            # A calibrated arm need not be periodic, so it is solved again after removing whole turns.
            tried, _ = wrap_into_limits(self.chain, tried, near[open_targets, None])
            tried, norms = self.solve(self.chain, goals, tried, steps)
            distance = np.linalg.norm((tried - near[open_targets, None]) / scale, axis=2)
            # Solutions come first, then those with a negligible miss, both ordered by distance; then the
            # others, ordered by error.
            is_missed = norms > max(_NEGLIGIBLE_MISS * length, self._max_norm)
            grade = is_missed.astype(int) + (norms > self._max_norm)
            order = np.lexsort([np.where(is_missed, norms, distance), grade])[:, :_N_BEST]
            best[open_targets] = np.take_along_axis(tried, order[..., None], 1)
            best_norm[open_targets] = norms.min(1)
            chosen = best[open_targets, 0]
            residual_error[open_targets] = _tool_error(self.chain, chosen, goals)
            within_limits = np.all((chosen >= self.chain.lower) & (chosen <= self.chain.upper), 1)
            accepted = self.is_reached(residual_error[open_targets]) & within_limits
            q[open_targets[accepted]], status[open_targets[accepted]] = chosen[accepted], OK
        on_edge = (status == OUT) & self.is_negligible(residual_error)
        q[on_edge], status[on_edge] = best[on_edge, 0], OK
        open_targets = np.flatnonzero(status == OUT)
        unlimited = without_rotary_limits(self.chain)
        _, norms = self.solve(unlimited, targets[open_targets], best[open_targets], _ROUNDS[-1][1])
        status[open_targets[np.any(norms <= self._max_norm, 1)]] = LIMITS
        return q, status, residual_error


def _search_points(poses: Array, with_rotations: bool, length: float) -> Array:
    """Return points whose distances approximate those of poses, shape (m, 3), or (m, 12) with rotations."""
    if not with_rotations:
        return poses[:, :3, 3]
    # A small rotation by an angle changes a rotation matrix by √2 times the angle (Frobenius norm).
    return np.concatenate([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9) * length / np.sqrt(2)], 1)


def _tool_error(chain: Chain, q: Array, targets: Array) -> Array:
    """Return distances [m] and angles [rad] between tool and targets, shape (m, 2)."""
    return _pose_error(chain.poses(q), targets)


def _pose_error(poses: Array, targets: Array) -> Array:
    """Return distances [m] and angles [rad] between poses and targets, shape (m, 2)."""
    if targets.ndim == 2:
        return np.stack([np.linalg.norm(poses[:, :3, 3] - targets, axis=1), np.zeros(len(poses))], 1)
    rotation = se3.log3(poses[:, :3, :3] @ np.swapaxes(targets[:, :3, :3], 1, 2))
    return np.stack(
        [np.linalg.norm(poses[:, :3, 3] - targets[:, :3, 3], axis=1), np.linalg.norm(rotation, axis=1)], 1
    )


def _is_near_singular(nominal: Chain, search: _Search, targets: Array, q: Array) -> Array:
    """Return whether solutions are at a singularity, or whether the correction crosses one, shape (m,)."""
    calibrated = search.chain
    # The corrected target of the controller is always a pose.
    components = slice(6 if targets.ndim == 3 else 3)
    out = (
        np.minimum(_min_singular_value(nominal, q, slice(6)), _min_singular_value(calibrated, q, components))
        < _NEAR_SINGULAR_TOL
    )
    if nominal.n_joints > 6:
        return out  # The controller of a redundant arm may choose other joint positions in any case.
    # A controller that moves from the uncorrected target must end in the same joint positions.
    base = calibrated.base @ nominal_root_pose(nominal, calibrated)
    uncorrected = replace(nominal, base=base, tool=calibrated.tool)
    before = search.solve(uncorrected, targets, q[:, None], _ROUNDS[-1][1])[0][:, 0]
    commanded, _ = solve_ik(nominal, pose_task(nominal.poses(q), characteristic_length(nominal)), before)
    reached = calibrated.poses(q) if targets.ndim == 3 else calibrated.poses(q)[:, :3, 3]
    return out | np.any(_tool_error(calibrated, commanded, reached) > REACHED_TOL, 1)


def _min_singular_value(chain: Chain, q: Array, components: slice) -> Array:
    """Return the smallest singular value (m,) of the Jacobian in units of the characteristic length."""
    jacobian = tool_pose_and_jacobian(chain, q)[1]
    jacobian[:, :3] /= characteristic_length(chain)
    jacobian[:, :, chain.is_prismatic] *= characteristic_length(chain)
    return np.linalg.svd(jacobian[:, components], compute_uv=False)[:, -1]
