"""Batches: many small calibration problems solved in lockstep.

Typical uses are Monte Carlo studies, bootstrap, and fleets of robots of one type. All problems of a batch
have the same joints, the same p error parameters and the same kinds of measurements. Nominal chains, joint
positions and measured values may differ.

The solvers are those of module `solver`, with the same rules (`solver_rules`). All arrays have the problem as
their first axis; each pass of the iteration works on the problems that have not ended. For small problems
this is about ten times as fast as one by one, as the overhead of Python and NumPy is shared. Problems that
need more than `MAX_LOCKSTEP` iterations of Levenberg-Marquardt go on one by one, with extrapolated steps.

Shapes: b problems, p unknowns, m samples per problem and measurement, c configurations per sample, n joints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property

import numpy as np

from ..._frozen import frozen
from ..._kernels import append_diagonal, factor_jacobian, r_factors
from ..._kernels.types import twists_before
from ..._typing import Array
from ...exceptions import InvalidArgumentError, UnknownNameError
from ...measurements.base import Measurement, concatenate
from ...parallel import SERIAL, TaskExecutor
from .. import solver_rules as rules
from ..error_model import ErrorModel
from ..problem import Problem
from ..qr import RANK_RTOL
from ..solver import levenberg_marquardt
from ..solver_rules import step_is_negligible
from ..uncertainty import UNBOUNDED_TOL
from .chains import ChainBatch
from .qr import TriangularSystemBatch

# Number of problems that are solved together; their arrays fit into the cache of a core.
BLOCK_SIZE = 250
# Largest number of iterations in lockstep. Problems that converge take 3 to 10, or many.
MAX_LOCKSTEP = 15
# Weight of a padding sample: lost in rounding, and not zero so that one can divide by it.
_PADDING_WEIGHT = 1e-40


@frozen(eq=False)
class BatchProblem:
    """b least-squares problems in p unknown errors of the robot.

    Attributes:
        chains: Nominal chains of the b problems.
        data: Measurements of any kinds, each with b·m samples, problem after problem. All instrument
            parameters must be known.
        weights: Reciprocal prior standard deviations of shape (p,); zero without a prior.
        known: Values of the instrument parameters by name, the same for all problems [m or rad].
        n_padding: Number of padding samples of each measurement and problem, shape (d, b) or broadcastable.
    """

    chains: ChainBatch
    data: tuple[Measurement, ...]
    weights: Array
    known: Mapping[str, float] = field(default_factory=dict)
    n_padding: Array = field(default_factory=lambda: np.array(0))

    def __post_init__(self) -> None:
        """Check that instruments are known and samples can be divided among the problems."""
        for item in self.data:
            if missing := [u.name for u in item.instrument_parameters if u.name not in self.known]:
                raise InvalidArgumentError(
                    f"{item.kind}: {missing[0]} is unknown; a batch needs known instrument parameters, "
                    "so give it as known or calibrate one by one"
                )
            if len(item.rows) % max(len(self), 1):
                raise InvalidArgumentError(
                    f"{item.kind}: {len(item.rows)} samples cannot be divided among {len(self)} problems; "
                    "expected the same number for each"
                )

    @classmethod
    def from_models(
        cls,
        models: Sequence[ErrorModel],
        data: Sequence[Sequence[Measurement]],
        weights: Array,
        known: Mapping[str, float] | None = None,
    ) -> BatchProblem:
        """Build a batch from single problems.

        Problems may have different numbers of samples; shorter ones are padded with samples of no weight.

        Args:
            models: Error models of b problems.
            data: Measurements of each problem, the same kinds in the same order.
            weights: Reciprocal prior standard deviations of shape (p,); zero without a prior.
            known: Values of the instrument parameters by name [m or rad].

        Returns:
            Batch of b problems.
        """
        counts = np.array([[len(item.rows) for item in items] for items in data]).T
        max_counts = counts.max(1)
        padded = tuple(
            concatenate([_padded(item, int(count)) for item in items])
            for items, count in zip(zip(*data, strict=True), max_counts, strict=True)
        )
        chains = ChainBatch.from_models(models)
        return cls(chains, padded, weights, known or {}, max_counts[:, None] - counts)

    def __len__(self) -> int:
        """Number of problems."""
        return len(self.chains)

    def take(self, members: Array) -> BatchProblem:
        """Select problems by their indices."""
        return replace(
            self,
            chains=self.chains.take(members),
            data=tuple(self._samples_of(item, members) for item in self.data),
            n_padding=self._padding()[:, members],
        )

    def _problem(self, number: int) -> Problem:
        """Build one of the problems."""
        samples = tuple(self._samples_of(item, np.array([number])) for item in self.data)
        return Problem(self.chains.error_model(number), samples, self.weights, self.known)

    def _samples_of(self, item: Measurement, members: Array) -> Measurement:
        """Select the samples of some problems."""
        m = len(item.rows) // max(len(self), 1)
        return item.take((members[:, None] * m + np.arange(m)).reshape(-1))

    def _instrument_values(self, item: Measurement) -> Array:
        """Return the instrument parameters of a measurement."""
        return np.array([self.known[parameter.name] for parameter in item.instrument_parameters])

    def _configurations(self, item: Measurement) -> Array:
        """Return the joint positions of a measurement, shape (c, b, m, n)."""
        q = item.configurations()
        m = len(item.rows) // max(len(self), 1)
        return q.reshape(-1, len(self), m, q.shape[-1])

    def count_rows(self) -> Array:
        """Count the rows of each problem without padding, shape (b,)."""
        first = self.take(np.array([0]))
        total = np.zeros(len(self), int)
        for item, n_padding in zip(first.data, self._padding(), strict=True):
            frames = first.chains.forward_kinematics(first._configurations(item))
            residual = item.residual(frames, self._instrument_values(item))
            total += len(residual) * (len(item.rows) - n_padding)
        return total

    def _padding(self) -> Array:
        """Return the number of padding samples, shape (d, b)."""
        return np.broadcast_to(self.n_padding, (len(self.data), len(self)))

    def cost(self, x: Array) -> Array:
        """Compute the sums of squared whitened residuals and priors at x of shape (b, p), shape (b,)."""
        chains = self.chains.at(x)
        total = np.sum((self.weights * x) ** 2, -1)
        for item in self.data:
            frames = chains.forward_kinematics(self._configurations(item))
            residual = item.residual(frames, self._instrument_values(item))
            total += np.sum(residual.reshape(len(residual), len(self), -1) ** 2, (0, 2))
        return total

    def linearize_and_factor(self, x: Array, weights: Array, small_angle: bool) -> TriangularSystemBatch:
        """Compute the triangular systems of data and priors.

        Args:
            x: Unknowns of shape (b, p).
            weights: Reciprocal prior standard deviations of shape (p,); zero without a prior.
            small_angle: Whether to use the paper's residuals and Jacobian instead of the exact ones.

        Returns:
            Systems at x.
        """
        chains, bodies, twists = self.chains.derivative(x)
        factors = []
        for item in self.data:
            frames = chains.forward_kinematics(self._configurations(item))
            u = self._instrument_values(item)
            if small_angle:
                residual, observation = item.small_angle(frames, u)
            else:
                residual = item.residual(frames, u)
                observation = item.observation_matrix(frames, u, residual)
            moving = twists_before(observation.body, bodies, twists)
            factors.append(
                factor_jacobian(frames.columns, frames.tool[3], bodies, moving, observation, residual[None])
            )
        rows = factors[0]
        if len(factors) > 1:
            rows = r_factors(np.ascontiguousarray(np.concatenate(factors, 1).swapaxes(1, 2))[:, :, None])
        if weights.any():
            rows = append_diagonal(rows, np.tile(weights, (len(x), 1)), -weights * x)
        return TriangularSystemBatch(rows)


def _padded(item: Measurement, count: int) -> Measurement:
    """Append copies of the first sample without weight, up to `count` samples."""
    n_padding = count - len(item.rows)
    if not n_padding:
        return item
    weights = np.concatenate([np.ones(len(item.rows)), np.full(n_padding, _PADDING_WEIGHT)])
    indices = np.concatenate([np.arange(len(item.rows)), np.zeros(n_padding, int)])
    return item.take(indices).with_weights(weights)


@frozen(eq=False)
class BatchResult:
    """Result of `solve_batch`."""

    batch: BatchProblem  #: Problems that were solved
    x: Array  #: Solutions of shape (b, p) [m and rad]
    iterations: Array  #: Number of iterations of each problem, shape (b,)
    converged: Array  #: Whether the last step was negligible, shape (b,)

    @cached_property
    def systems(self) -> TriangularSystemBatch:
        """Triangular systems of the data at x, without priors."""
        return self.batch.linearize_and_factor(self.x, np.zeros(self.x.shape[1]), small_angle=False)

    @property
    def cost(self) -> Array:
        """Sums of squared whitened residuals, without priors, shape (b,)."""
        return self.systems.cost

    @cached_property
    def rank(self) -> Array:
        """Numbers of observable directions, shape (b,)."""
        s = np.linalg.svd(self.systems.r, compute_uv=False)
        return np.sum(s > RANK_RTOL * s[:, :1], -1)

    @property
    def std(self) -> Array:
        """Standard deviations of x, shape (b, p) [m and rad]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @cached_property
    def covariance(self) -> Array:
        """Covariances of x by the stated standard deviations, (b, p, p); infinite if not determined."""
        b, p = self.x.shape
        priors = np.tile(np.diag(self.batch.weights), (b, 1, 1))
        _, s, vt = np.linalg.svd(np.linalg.qr(np.concatenate([self.systems.r, priors], 1), mode="r"))
        is_nonzero = s > RANK_RTOL * s[:, :1]
        root = np.where(is_nonzero, 1 / np.where(is_nonzero, s, 1.0), 0.0)[..., None] * vt
        out = root.swapaxes(1, 2) @ root
        is_unbounded = 1 - np.sum(np.where(is_nonzero[..., None], vt, 0.0) ** 2, 1) > UNBOUNDED_TOL
        out[is_unbounded[:, :, None] & np.eye(p, dtype=bool)] = np.inf
        return out


def _gauss_newton(batch: BatchProblem, x: Array, max_iterations: int) -> tuple[Array, Array, Array]:
    """Run `solver.gauss_newton` on all problems in lockstep; a diverging problem ends, not converged."""
    b, active_batch, active = len(batch), batch, np.arange(len(batch))
    x, iterations, converged = x.copy(), np.zeros(b, int), np.zeros(b, bool)
    for iteration in range(1, max_iterations + 1):
        systems = active_batch.linearize_and_factor(x[active], batch.weights, small_angle=True)
        step = systems.solve()
        change = np.linalg.norm(systems.residual_change(step), axis=1)
        is_negligible = step_is_negligible(change, np.sqrt(systems.cost), np.zeros(1), systems.roundoff)
        x[active] += step
        iterations[active], converged[active] = iteration, is_negligible
        has_ended = is_negligible | rules.has_diverged(x[active])
        active, active_batch = active[~has_ended], active_batch.take(np.flatnonzero(~has_ended))
        if not active.size:
            break
    return x, iterations, converged


def _undamped_steps(batch: BatchProblem, x: Array, cost: Array) -> tuple[Array, Array]:
    """Try a series of undamped steps; return their ends and the costs there where those are lower."""
    end, end_cost = x.copy(), np.full(len(x), np.inf)
    active, active_batch = np.arange(len(x)), batch
    for _ in range(rules.N_UNDAMPED_STEPS):
        systems = active_batch.linearize_and_factor(end[active], batch.weights, small_angle=False)
        trial = end[active] + systems.solve()
        bounded = np.flatnonzero(~rules.has_diverged(trial))
        if not bounded.size:
            break
        active, active_batch = active[bounded], active_batch.take(bounded)
        end[active], end_cost[active] = trial[bounded], active_batch.cost(trial[bounded])
    is_lower = end_cost < cost
    return np.where(is_lower[:, None], end, x), np.where(is_lower, end_cost, cost)


def _levenberg_marquardt(batch: BatchProblem, x: Array, max_iterations: int) -> tuple[Array, Array, Array]:
    """Run `solver.levenberg_marquardt` in lockstep, then on the remaining problems one by one."""
    x, iterations, converged = _lockstep(batch, x, min(max_iterations, MAX_LOCKSTEP))
    for i in np.flatnonzero(~converged & (iterations < max_iterations)).tolist():
        found = levenberg_marquardt(batch._problem(i), x[i], max_iterations - int(iterations[i]))
        x[i], converged[i] = found.x, found.converged
        iterations[i] += found.iterations
    return x, iterations, converged


def _lockstep(batch: BatchProblem, x: Array, max_iterations: int) -> tuple[Array, Array, Array]:
    """Run Levenberg-Marquardt on all problems in lockstep, without extrapolated steps."""
    # In each pass every active problem tries one step. Problems whose step was accepted are linearized again;
    # the others retry with more damping. State that outlives a pass has one element per problem of the batch;
    # quantities of one pass have one element per active problem.
    b, p, active_batch, active = len(batch), len(batch.weights), batch, np.arange(len(batch))
    x, iterations, converged = x.copy(), np.zeros(b, int), np.zeros(b, bool)
    systems, scale = batch.linearize_and_factor(x, batch.weights, small_angle=False), np.zeros((b, p))
    cost, damping, growth = (
        systems.cost,
        np.full(b, rules.INITIAL_DAMPING),
        np.full(b, rules.INITIAL_GROWTH),
    )
    # Whether the next trial is the first one of an iteration.
    is_new, last_change, last_undamped = np.ones(b, bool), np.zeros(b), np.zeros(b, int)
    while active.size and max_iterations:
        # Step of each active problem.
        undamped, start_cost = systems.take(active), cost[active]
        new = active[is_new[active]]
        iterations[new] += 1
        scale[new] = np.maximum(scale[new], systems.take(new).column_norms)
        damping_scale = np.where(scale[active] > 0, scale[active], 1.0)
        damping_rows = np.sqrt(damping[active])[:, None] * damping_scale
        step = undamped.with_damping(damping_rows).solve(damping_rows.min(1))
        row_change = undamped.residual_change(step)
        change = np.linalg.norm(row_change, axis=1)
        roundoff, residual_norm = undamped.roundoff, np.sqrt(start_cost)
        previous_change = last_change[active]
        is_negligible = step_is_negligible(change, residual_norm, previous_change, roundoff)
        predicted = undamped.predicted_reduction(row_change)

        # Cost after the step: from the linearization at a first trial, and by prediction within rounding.
        trial, trial_cost, trial_systems = x[active] + step, start_cost - predicted, None
        is_first_trial = ~is_negligible & is_new[active]
        is_predicted = is_negligible & (predicted <= rules.cost_roundoff(residual_norm, roundoff))
        first, retried = np.flatnonzero(is_first_trial), np.flatnonzero(~is_first_trial & ~is_predicted)
        if first.size:
            trial_systems = active_batch.take(first).linearize_and_factor(
                trial[first], batch.weights, small_angle=False
            )
            trial_cost[first] = trial_systems.cost
        if retried.size:
            trial_cost[retried] = active_batch.take(retried).cost(trial[retried])

        # Acceptance, damping and termination.
        gain = rules.gain_ratio(start_cost, trial_cost, predicted)
        within_roundoff = rules.is_within_roundoff(predicted, trial_cost, residual_norm, roundoff)
        is_accepted = rules.is_acceptable(start_cost, trial_cost, gain, within_roundoff)
        is_stuck = ~is_accepted & (is_negligible | (damping[active] > rules.MAX_DAMPING))
        accepted, rejected = active[is_accepted], active[~is_accepted]
        x[accepted], last_change[accepted] = trial[is_accepted], change[is_accepted]
        cost[accepted], growth[accepted] = trial_cost[is_accepted], rules.INITIAL_GROWTH
        is_new[active] = is_accepted
        damping[accepted] = rules.damping_after_acceptance(
            damping[accepted], gain[is_accepted], within_roundoff[is_accepted]
        )
        converged[accepted] = is_negligible[is_accepted] & (damping[accepted] < rules.MAX_CONVERGED_DAMPING)
        converged[active[is_stuck]] = is_negligible[is_stuck]
        damping[rejected], growth[rejected] = rules.damping_after_rejection(
            damping[rejected], growth[rejected]
        )

        # Undamped steps, at once where only the damped step is negligible.
        is_stalled = converged[active] & (last_undamped[active] == 0)
        is_stalled[is_stalled] = ~undamped.take(is_stalled).is_stationary(
            start_cost[is_stalled], previous_change[is_stalled]
        )
        converged[active[is_stalled]], is_new[active[is_stalled]] = False, True
        is_due = is_stalled | rules.undamped_steps_are_due(iterations[active], last_undamped[active])
        tries_undamped = (is_accepted | is_stuck) & ~converged[active] & is_due
        if tries_undamped.any():
            chosen = active[tries_undamped]
            last_undamped[chosen] = iterations[chosen]
            x[chosen], cost[chosen] = _undamped_steps(
                active_batch.take(np.flatnonzero(tries_undamped)), x[chosen], cost[chosen]
            )
        has_ended = (
            (is_stuck & ~is_stalled)
            | converged[active]
            | (is_new[active] & (iterations[active] >= max_iterations))
        )

        # Linearization at the new points that have none yet.
        if trial_systems is not None:
            systems.assign(active[first][is_accepted[first]], trial_systems.take(is_accepted[first]))
        missing = np.flatnonzero(((is_accepted & ~is_first_trial) | tries_undamped) & ~has_ended)
        if missing.size:
            systems.assign(
                active[missing],
                active_batch.take(missing).linearize_and_factor(
                    x[active[missing]], batch.weights, small_angle=False
                ),
            )
        active, active_batch = active[~has_ended], active_batch.take(np.flatnonzero(~has_ended))
    return x, iterations, converged


_METHODS: dict[str, Callable[[BatchProblem, Array, int], tuple[Array, Array, Array]]] = {
    "lm": _levenberg_marquardt,
    "gn": _gauss_newton,
}


def _solve_block(task: tuple[BatchProblem, str, Array, int]) -> tuple[Array, Array, Array]:
    """Solve one block of problems; return x, iterations and convergence flags."""
    batch, method, start, max_iterations = task
    return _METHODS[method](batch, start, max_iterations)


def solve_batch(
    batch: BatchProblem,
    method: str = "lm",
    max_iterations: int = 100,
    *,
    start: Array | None = None,
    executor: TaskExecutor = SERIAL,
) -> BatchResult:
    """Solve all problems of a batch; the solutions are those of `solver.minimize`, one by one.

    Args:
        batch: b problems in p unknowns.
        method: "lm" for Levenberg-Marquardt or "gn" for Gauss-Newton.
        max_iterations: Largest number of iterations of each problem.
        start: Starting points of shape (b, p) [m and rad]; zero, the nominal robots, by default.
        executor: Executes the work on blocks of problems.

    Returns:
        Solutions of all problems.

    Raises:
        UnknownNameError: If the method is unknown.
    """
    if method not in _METHODS:
        raise UnknownNameError(f"unknown method {method!r}; choose from {', '.join(_METHODS)}")
    x = np.zeros((len(batch), len(batch.weights))) if start is None else start
    blocks = [
        np.arange(first, min(first + BLOCK_SIZE, len(batch))) for first in range(0, len(batch), BLOCK_SIZE)
    ]
    tasks = ((batch.take(block), method, x[block], max_iterations) for block in blocks)
    results = zip(*executor.map(_solve_block, tasks), strict=True)
    return BatchResult(batch, *(np.concatenate(parts) for parts in results))
