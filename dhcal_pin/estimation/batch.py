"""Many small calibrations at once: Monte Carlo, bootstrap, cross-validation folds, a fleet of one make.

The members share what is unknown and how it is measured; nominal arm, joint values and readings are each
one's own. The loops of `solver` run on all of them in step, with stacked QR and stacked triangles, and a
member that has ended takes no further part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from .._kernels import factor_jacobian
from .._typing import Array
from ..exceptions import DhcalError
from ..measurements.base import Measurement, concatenate
from ..parallel import SERIAL, TaskExecutor
from . import qr
from . import solver_rules as rules
from .batch_chains import ChainBatch
from .batch_qr import TriangularSystemBatch
from .error_model import ErrorModel
from .solver_rules import step_is_negligible

# Members whose arrays together stay in a core's cache.
BLOCK_SIZE = 250


# The weight of a sample that is there to fill up: lost in rounding, and still a number.
_PADDING_WEIGHT = 1e-40


@dataclass(frozen=True, eq=False)
class BatchProblem:
    """b problems in p unknown errors of the robot.

    Attributes:
        chains: the nominal arms, b.
        data: measurements of any kinds without unknowns of their own, each with b·m samples, member after
            member.
        weights: (p,) one over the prior's sigma; zero where there is none.
        known: values of instruments' unknowns by name, the same for all members.
        n_padding: (d, b) how many samples of each measurement and member are there to fill up, without weight.
    """

    chains: ChainBatch
    data: tuple[Measurement, ...]
    weights: Array
    known: Mapping[str, float] = field(default_factory=dict)
    n_padding: Array = field(default_factory=lambda: np.array(0))

    def __post_init__(self) -> None:
        for item in self.data:
            if missing := [u.name for u in item.instrument_parameters if u.name not in self.known]:
                raise DhcalError(
                    f"{item.kind}: {missing[0]} is unknown; a batch needs surveyed instruments, "
                    "so give it as known or calibrate one by one"
                )
            if len(item.rows) % max(len(self), 1):
                raise DhcalError(
                    f"{item.kind}: {len(item.rows)} samples do not share out among {len(self.chains)} members"
                )

    @classmethod
    def from_models(
        cls,
        models: Sequence[ErrorModel],
        data: Sequence[Sequence[Measurement]],
        weights: Array,
        known: Mapping[str, float] | None = None,
    ) -> BatchProblem:
        """The problems of b error models with b lists of measurements, the same kinds in each.

        Members may have different numbers of samples: shorter ones are filled up with rows of no weight.
        """
        counts = np.array([[len(item.rows) for item in items] for items in data]).T
        filled = tuple(
            concatenate([_padded(item, int(most)) for item in items])
            for items, most in zip(zip(*data, strict=True), counts.max(1), strict=True)
        )
        return cls(
            ChainBatch.from_models(models), filled, weights, known or {}, counts.max(1)[:, None] - counts
        )

    def __len__(self) -> int:
        return len(self.chains)

    def take(self, members: Array) -> BatchProblem:
        """The members of an index (j,)."""
        return replace(
            self,
            chains=self.chains.take(members),
            data=tuple(self._rows(item, members) for item in self.data),
            n_padding=self._padding()[:, members],
        )

    def _rows(self, item: Measurement, members: Array) -> Measurement:
        m = len(item.rows) // max(len(self), 1)
        return item.take((members[:, None] * m + np.arange(m)).reshape(-1))

    def _values(self, item: Measurement) -> Array:
        return np.array([self.known[unknown.name] for unknown in item.instrument_parameters])

    def _joints(self, item: Measurement) -> Array:
        """Joint values (c, b, m, n)."""
        q = item.configurations()
        m = len(item.rows) // max(len(self), 1)
        return q.reshape(-1, len(self), m, q.shape[-1])

    def count_rows(self) -> Array:
        """How many rows have a say in each member, (b,)."""
        one = self.take(np.array([0]))
        total = np.zeros(len(self), int)
        for item, spare in zip(one.data, self._padding(), strict=True):
            residual = item.residual(one.chains.forward_kinematics(one._joints(item)), self._values(item))
            total += len(residual) * (len(item.rows) - spare)
        return total

    def _padding(self) -> Array:
        return np.broadcast_to(self.n_padding, (len(self.data), len(self)))

    def cost(self, x: Array) -> Array:
        """Sums (b,) of squared whitened residuals and priors at x (b, p)."""
        arms = self.chains.at(x)
        total = np.sum((self.weights * x) ** 2, -1)
        for item in self.data:
            residual = item.residual(arms.forward_kinematics(self._joints(item)), self._values(item))
            total += np.sum(residual.reshape(len(residual), len(self), -1) ** 2, (0, 2))
        return total

    def linearize_and_factor(self, x: Array, weights: Array, small_angle: bool) -> TriangularSystemBatch:
        """The triangles at x (b, p) of the data and of priors of these weights (p,)."""
        arms, bodies, twists = self.chains.derivative(x)
        b, p = x.shape
        twists, found = np.ascontiguousarray(twists.swapaxes(0, 1)), []
        for item in self.data:
            frames, u = arms.forward_kinematics(self._joints(item)), self._values(item)
            if small_angle:
                residual, mixture = item.small_angle(frames, u)
            else:
                residual = item.residual(frames, u)
                mixture = item.observation_matrix(frames, u, residual)
            found.append(
                factor_jacobian(frames.columns, frames.tool[3], bodies, twists, mixture, residual[None])
            )
        if (held := np.flatnonzero(weights)).size:
            block = np.zeros((b, len(held), p + 1))
            block[:, np.arange(len(held)), held] = weights[held]
            block[:, :, p] = -(weights * x)[:, held]
            found.append(block)
        if len(found) == 1:
            return TriangularSystemBatch.from_r_factors(found[0])
        return TriangularSystemBatch.from_columns(np.concatenate(found, 1).swapaxes(1, 2))


def _padded(item: Measurement, count: int) -> Measurement:
    """The measurement with `count` rows, those too many without weight."""
    spare = count - len(item.rows)
    if not spare:
        return item
    weights = np.concatenate([np.ones(len(item.rows)), np.full(spare, _PADDING_WEIGHT)])
    return item.take(np.concatenate([np.arange(len(item.rows)), np.zeros(spare, int)])).with_weights(weights)


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Where b loops ended.

    Attributes:
        batch: the problems.
        x: (b, p) errors in m and rad.
        iterations: (b,) steps taken.
        converged: (b,) whether the last step was too small to matter.
    """

    batch: BatchProblem
    x: Array
    iterations: Array
    converged: Array

    @cached_property
    def systems(self) -> TriangularSystemBatch:
        """Those of the data alone, at x."""
        return self.batch.linearize_and_factor(self.x, np.zeros(self.x.shape[1]), small_angle=False)

    @property
    def cost(self) -> Array:
        """Sums (b,) of squared whitened residuals, without priors."""
        return self.systems.cost

    @cached_property
    def rank(self) -> Array:
        """Numbers (b,) of directions that the data see."""
        s = np.linalg.svd(self.systems.r, compute_uv=False)
        return np.sum(s > qr.RANK_RTOL * s[:, :1], -1)

    @property
    def std(self) -> Array:
        """Standard deviations (b, p) of x, m and rad."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @cached_property
    def covariance(self) -> Array:
        """Covariances (b, p, p) of x, sigmas believed; infinite on the diagonal where nothing tells."""
        b, p = self.x.shape
        priors = np.tile(np.diag(self.batch.weights), (b, 1, 1))
        _, s, vt = np.linalg.svd(np.linalg.qr(np.concatenate([self.systems.r, priors], 1), mode="r"))
        kept = s > qr.RANK_RTOL * s[:, :1]
        half = np.where(kept, 1 / np.where(kept, s, 1.0), 0.0)[..., None] * vt
        out = half.swapaxes(1, 2) @ half
        lost = 1 - np.sum(np.where(kept[..., None], vt, 0.0) ** 2, 1) > 1e-6
        out[lost[:, :, None] & np.eye(p, dtype=bool)] = np.inf
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
    """Run `solver.levenberg_marquardt` on all problems in lockstep.

    In each pass every active problem tries one step. Problems whose step was accepted are linearized again;
    the others retry with more damping. Arrays without index have one element per problem of the batch, or per
    active problem where they are computed from `active`.
    """
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
        scale[new] = np.maximum(scale[new], np.linalg.norm(systems.r[new], axis=1))
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
    """Solves all members; the answers are those of `solver`, one by one.

    Args:
        batch: b problems.
        method: "lm" or "gn".
        max_iterations: most steps of a member.
        start: x (b, p) to start from; the nominal arms without it.
        executor: what blocks of members are shared out to.

    Raises:
        DhcalError: unknown method.
    """
    if method not in _METHODS:
        raise DhcalError(f"method {method!r}: choose from {', '.join(_METHODS)}")
    x = np.zeros((len(batch), len(batch.weights))) if start is None else start
    blocks = [
        np.arange(first, min(first + BLOCK_SIZE, len(batch))) for first in range(0, len(batch), BLOCK_SIZE)
    ]
    tasks = ((batch.take(block), method, x[block], max_iterations) for block in blocks)
    found = zip(*executor.map(_solve_block, tasks), strict=True)
    return BatchResult(batch, *(np.concatenate(part) for part in found))
