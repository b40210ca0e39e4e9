"""Inverse kinematics within joint limits, vectorized over many samples.

For each sample the solver minimizes the norm of a task error e(q) with the Jacobian J = ∂e/∂q by damped
least-squares steps

    Δq = −Jᵀ (J Jᵀ + λ I)⁻¹ e,    λ = λ_min + μ |e|²

The damping shrinks with the error, so that the last steps are Newton steps (Sugihara, IEEE T-RO 27, 2011). μ
is decreased after a step that reduces the error and increased after a rejected one. A joint at a limit that
would leave it is held, and the other joints take its part. If no start reaches the target, the result is a
local minimum of the error.

Shapes: m samples, r active samples, n joints, k components of the task error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import ConvergenceError
from .chain import Chain
from .conditions import Conditions
from .sampling import joint_range

# Function from tool poses, shape (r, 4, 4), and sample numbers, shape (r,), to task errors, shape (r, k) [m],
# and their derivatives by the tool twist [v, ω] in axes of the measuring frame, shape (r, k, 6), or by v, (r,
# k, 3).
TaskError = Callable[[Array, Array], tuple[Array, Array]]

# Initial damping factor μ, and the minimum damping λ_min near singularities [m²].
_DAMPING, _MIN_DAMPING = 0.1, 1e-9

# Factors of μ after an accepted and after a rejected step.
_DAMPING_DECREASE, _DAMPING_INCREASE = 0.5, 8.0

# Maximum change of a joint position in one step [rad or m].
_MAX_STEP = 1.0

# A sample is finished when the norm of its task error is below this value [m].
_ERROR_TOL = 1e-14

# Minimum characteristic length, for chains without links such as a wrist [m].
_MIN_LENGTH = 0.05

# Steps of the correction for conditions: the changes are small, and their square is below rounding errors.
_N_CORRECTIONS = 6

# A sample is abandoned if its error has not shrunk to this ratio within this number of steps.
_MAX_STALLED_STEPS, _MIN_PROGRESS_RATIO = 10, 0.99

# A target counts as reached below this error [m and rad].
REACHED_TOL = 1e-9

# Number of random restarts before `reach_within_limits` gives up, and steps of each.
_MAX_RESTARTS, _STEPS_PER_START = 100, 60

# Largest difference from a pose that counts as reached [m]; rotations by the characteristic length.
MAX_POSE_DIFFERENCE = 5e-7

# Damping of the last steps towards poses [m²]; smaller values make the system singular in double precision.
_MIN_POSE_DAMPING = 1e-14

# Largest distance of the first start from the middle of the joint limits [rad and m].
_MAX_START = 0.5


def tool_pose_and_jacobian(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Compute tool poses and geometric Jacobians."""
    frames = chain.forward_kinematics(q)
    return frames.poses(), chain.joint_jacobian(frames).transpose(2, 1, 0)


def characteristic_length(chain: Chain) -> float:
    """Return a length by which a rotation of a joint by one radian typically moves the tool."""
    # It is a third of the total length of links and prismatic strokes (at most 1 m each).
    links = np.concatenate([chain.origins[1:-1], (chain.origins[-1] @ chain.tool)[None]])
    strokes = np.minimum(chain.upper - chain.lower, 1.0)[chain.is_prismatic]
    return max(float(np.linalg.norm(links[:, :3, 3], axis=1).sum() + strokes.sum()) / 3, _MIN_LENGTH)


def without_rotary_limits(chain: Chain) -> Chain:
    """Return a copy of a chain without limits of revolute joints; prismatic joints keep theirs."""
    is_revolute = ~chain.is_prismatic
    return replace(
        chain,
        lower=np.where(is_revolute, -np.inf, chain.lower),
        upper=np.where(is_revolute, np.inf, chain.upper),
    )


def solve_ik(
    chain: Chain,
    task_error: TaskError,
    start: Array,
    steps: int = 200,
    samples: Array | None = None,
    min_damping: float = _MIN_DAMPING,
) -> tuple[Array, Array]:
    """Minimize task errors within the joint limits from joint positions (m, n); return norms [m], too."""
    # `samples` are the numbers by which `task_error` identifies the rows of `start`, by default 0 to m-1.
    # `min_damping` is the damping λ_min near singularities [m²].
    samples = np.arange(len(start)) if samples is None else samples
    q = np.clip(chain.validated_q(start), chain.lower, chain.upper)
    errors, jacobians = _errors_and_jacobians(chain, task_error, q, samples)
    norms = np.linalg.norm(errors, axis=1)
    damping, earlier_norms = np.full(len(q), _DAMPING), np.full(len(q), np.inf)
    active = np.arange(len(q))
    for count in range(steps):
        unfinished = norms[active] > _ERROR_TOL
        if count % _MAX_STALLED_STEPS == 0:
            unfinished &= norms[active] < _MIN_PROGRESS_RATIO * earlier_norms[active]
            earlier_norms[active] = norms[active]
        active = active[unfinished]
        if not active.size:
            break
        trial, jacobian = q[active], jacobians[active]
        total_damping = min_damping + damping[active] * norms[active] ** 2
        step = _damped_step(jacobian, errors[active], total_damping)
        at_limit = ((trial <= chain.lower) & (step < 0)) | ((trial >= chain.upper) & (step > 0))
        if at_limit.any():
            step = _damped_step(np.where(at_limit[:, None], 0.0, jacobian), errors[active], total_damping)
        step /= np.maximum(1.0, np.abs(step).max(1, keepdims=True) / _MAX_STEP)
        trial = np.clip(trial + step, chain.lower, chain.upper)
        trial_errors, trial_jacobians = _errors_and_jacobians(chain, task_error, trial, samples[active])
        trial_norms = np.linalg.norm(trial_errors, axis=1)
        improved = trial_norms < norms[active]
        damping[active] *= np.where(improved, _DAMPING_DECREASE, _DAMPING_INCREASE)
        accepted = active[improved]
        q[accepted], norms[accepted] = trial[improved], trial_norms[improved]
        errors[accepted], jacobians[accepted] = trial_errors[improved], trial_jacobians[improved]
    return q, norms


def _errors_and_jacobians(
    chain: Chain, task_error: TaskError, q: Array, samples: Array
) -> tuple[Array, Array]:
    """Compute task errors, shape (r, k), and their Jacobians, shape (r, k, n), at q, shape (r, n)."""
    poses, tool_jacobians = tool_pose_and_jacobian(chain, q)
    errors, by_twist = task_error(poses, samples)
    return errors, by_twist @ tool_jacobians[:, : by_twist.shape[-1]]


def correct_for_conditions(
    chain: Chain, task_error: TaskError, q: Array, conditions: Conditions
) -> tuple[Array, Array]:
    """Correct solutions without conditions for those of each sample, by Newton's method; see `solve_ik`."""
    q, samples = q.copy(), np.arange(len(q))
    for _ in range(_N_CORRECTIONS):
        frames = chain.forward_kinematics(replace(conditions, q=q))
        errors, by_twist = task_error(frames.poses(), samples)
        jacobians = by_twist @ chain.joint_jacobian(frames).transpose(2, 1, 0)[:, : by_twist.shape[-1]]
        q += _damped_step(jacobians, errors, np.full(len(q), _MIN_DAMPING))
    poses = chain.forward_kinematics(replace(conditions, q=q)).poses()
    return q, poses


def _damped_step(jacobians: Array, errors: Array, damping: Array) -> Array:
    """Solve the damped least-squares problem of the module docstring; steps of shape (r, n)."""
    transposed = np.swapaxes(jacobians, 1, 2)
    damped = jacobians @ transposed + damping[:, None, None] * np.eye(errors.shape[1])
    return -(transposed @ np.linalg.solve(damped, errors[..., None]))[..., 0]


def position_task(targets: Array) -> TaskError:
    """Create the task error of target positions."""
    return lambda poses, samples: (
        poses[:, :3, 3] - targets[samples],
        np.broadcast_to(np.eye(3), (len(poses), 3, 3)),
    )


def pose_task(targets: Array, length: float) -> TaskError:
    """Create the task error, 6 components [m], of poses (m, 4, 4); a radian counts as `length` [m]."""
    scale = np.diag([1.0, 1.0, 1.0, length, length, length])

    def task_error(poses: Array, samples: Array) -> tuple[Array, Array]:
        goals = targets[samples]
        rotation = se3.log3(poses[:, :3, :3] @ np.swapaxes(goals[:, :3, :3], 1, 2))
        errors = np.concatenate([poses[:, :3, 3] - goals[:, :3, 3], length * rotation], 1)
        # The exact derivative of the logarithm is the identity at the target and unbounded at half a turn.
        return errors, np.broadcast_to(scale, (len(poses), 6, 6))

    return task_error


def wrap_into_limits(chain: Chain, q: Array, near: Array | float = 0.0) -> tuple[Array, Array]:
    """Remove whole turns to get joint positions, near others, within the limits; return whether they are."""
    # A whole turn of an independent joint must be whole turns of its mimics.
    is_periodic = ~chain.is_prismatic & np.all(chain.mimic_matrix % 1 == 0, 0)
    wrapped = near + (q - near + np.pi) % (2 * np.pi) - np.pi
    wrapped = wrapped + 2 * np.pi * ((wrapped < chain.lower).astype(float) - (wrapped > chain.upper))
    q = np.where(is_periodic, wrapped, q)
    return q, np.all((q >= chain.lower) & (q <= chain.upper), -1)


def reach_within_limits(
    chain: Chain, task_error: TaskError, start: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Find joint positions with task errors as small as the arm allows, from several starts."""
    unlimited = without_rotary_limits(chain)
    out, least, within_limits = start.copy(), np.full(len(start), np.inf), np.zeros(len(start), bool)
    starts, remaining = start, np.arange(len(start))
    for _ in range(_MAX_RESTARTS):
        q, norms = solve_ik(unlimited, task_error, starts, _STEPS_PER_START, remaining)
        q, is_allowed = wrap_into_limits(chain, q)
        is_reached, was_reached = norms <= REACHED_TOL, least[remaining] <= REACHED_TOL
        # A solution beyond the limits is replaced by a later one within the limits.
        improved = np.where(was_reached, is_reached & is_allowed, norms < least[remaining])
        out[remaining[improved]], least[remaining[improved]] = q[improved], norms[improved]
        within_limits[remaining] |= is_reached & is_allowed
        remaining = np.flatnonzero(~within_limits)
        if not remaining.size:
            break
        starts = start[rng.integers(0, len(start), len(remaining))] + rng.uniform(
            -1, 1, (len(remaining), chain.n_joints)
        )
    return out, least


def solve_within_limits(chain: Chain, task_error: TaskError, start: Array, rng: np.random.Generator) -> Array:
    """Find joint positions that bring every task error to zero, within the joint limits if possible."""
    q, errors = reach_within_limits(chain, task_error, start, rng)
    n_missed = np.sum(errors > REACHED_TOL)
    if n_missed:
        raise ConvergenceError(
            f"{n_missed} of {len(start)} targets are out of reach of this arm; choose other joint positions"
        )
    return q


def reach_poses(chain: Chain, poses: Array) -> tuple[Array, Array]:
    """Find joint positions that bring the tool to poses (m, 4, 4); return the differences [m], too."""
    rng = np.random.default_rng(0)
    # In the middle of the limits many arms are singular.
    start = np.mean(joint_range(chain), 0) + rng.uniform(-_MAX_START, _MAX_START, chain.n_joints)
    task = pose_task(poses, characteristic_length(chain))
    q, differences = reach_within_limits(chain, task, np.tile(start, (len(poses), 1)), rng)
    # Near a singularity, stronger damping leaves a small error.
    q, differences = solve_ik(without_rotary_limits(chain), task, q, min_damping=_MIN_POSE_DAMPING)
    return wrap_into_limits(chain, q)[0], differences
