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
from .batch_chains import ChainBatch
from .batch_qr import TriangularSystems, factor_columns
from .error_model import ErrorModel
from .solver import DIVERGENCE_LIMIT, N_UNDAMPED_STEPS, UNDAMPED_INTERVAL

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

    def linearize_and_factor(self, x: Array, weights: Array, small_angle: bool) -> TriangularSystems:
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
            return TriangularSystems.from_r_factors(found[0])
        return factor_columns(np.concatenate(found, 1).swapaxes(1, 2))


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
    def systems(self) -> TriangularSystems:
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
    """`solver.gauss_newton` in step; a member that runs away stops there, not converged."""
    b, part, live = len(batch), batch, np.arange(len(batch))
    x, iterations, converged = x.copy(), np.zeros(b, int), np.zeros(b, bool)
    for done in range(1, max_iterations + 1):
        full = part.linearize_and_factor(x[live], batch.weights, small_angle=True)
        step = full.solve()
        settled = full.is_step_negligible(np.linalg.norm(full.residual_change(step), axis=1), full.cost)
        x[live] += step
        iterations[live], converged[live] = done, settled
        over = settled | ~(np.abs(x[live]).max(1) < DIVERGENCE_LIMIT)
        live, part = live[~over], part.take(np.flatnonzero(~over))
        if not live.size:
            break
    return x, iterations, converged


def _undamped_steps(batch: BatchProblem, x: Array, cost: Array) -> tuple[Array, Array]:
    """`solver`'s leap in step: where plain Gauss-Newton ends, for those whom that takes lower."""
    far, ends = x.copy(), np.full(len(x), np.inf)
    live, part = np.arange(len(x)), batch
    for _ in range(N_UNDAMPED_STEPS):
        there = far[live] + part.linearize_and_factor(far[live], batch.weights, small_angle=False).solve()
        near = np.flatnonzero(np.abs(there).max(1) < DIVERGENCE_LIMIT)
        if not near.size:
            break
        live, part = live[near], part.take(near)
        far[live], ends[live] = there[near], part.cost(there[near])
    lower = ends < cost
    return np.where(lower[:, None], far, x), np.where(lower, ends, cost)


def _levenberg_marquardt(batch: BatchProblem, x: Array, max_iterations: int) -> tuple[Array, Array, Array]:
    """`solver.levenberg_marquardt` in step: who has moved gets a new triangle, all others try again."""
    b, p, part, live = len(batch), len(batch.weights), batch, np.arange(len(batch))
    x, iterations, converged = x.copy(), np.zeros(b, int), np.zeros(b, bool)
    every, scale = batch.linearize_and_factor(x, batch.weights, small_angle=False), np.zeros((b, p))
    cost, damping, growth = every.cost, np.full(b, 1e-8), np.full(b, 2.0)
    fresh, last, leapt = np.ones(b, bool), np.zeros(b), np.zeros(b, int)
    while live.size and max_iterations:
        free, before = every.take(live), cost[live]
        new = live[fresh[live]]
        iterations[new] += 1
        scale[new] = np.maximum(scale[new], np.linalg.norm(every.r[new], axis=1))
        floor = np.where(scale[live] > 0, scale[live], 1.0)
        least = np.sqrt(damping[live])[:, None] * floor
        step = free.with_damping(least).solve(least.min(1))
        moved = free.residual_change(step)
        change = np.linalg.norm(moved, axis=1)
        settled = free.is_step_negligible(change, before, last[live])
        expected = np.sum(free.z**2, -1) - np.sum((moved - free.z) ** 2, -1)
        rounding, root = free.roundoff(), np.sqrt(before)
        blur = (10 * rounding) ** 2 + 2 * rounding * root
        there, trial, ahead = x[live] + step, before - expected, None
        # A first try mostly holds, and its triangle, which the next step needs, tells its cost too.
        first = ~settled & fresh[live]
        tried, others = np.flatnonzero(first), np.flatnonzero(~first & ~(settled & (expected <= blur)))
        if tried.size:
            ahead = part.take(tried).linearize_and_factor(there[tried], batch.weights, small_angle=False)
            trial[tried] = ahead.cost
        if others.size:
            trial[others] = part.take(others).cost(there[others])
        gain = np.where(expected > 0, (before - trial) / np.where(expected > 0, expected, 1.0), 0.0)
        trusted = (expected <= blur) & (trial <= (root + 10 * rounding) ** 2)
        accepted = trusted | ((trial <= before) & (gain > 1e-3))
        stuck = ~accepted & (settled | (damping[live] > 1e16))
        easier = np.where(trusted | (gain > 0.9), 1e-2, np.maximum(1e-3, 1 - (2 * gain - 1) ** 3))
        went, retry = live[accepted], live[~accepted]
        was, x[went], last[went] = last[live], there[accepted], change[accepted]
        cost[went], growth[went] = trial[accepted], 2.0
        fresh[live] = accepted
        damping[went] = np.maximum(damping[went] * easier[accepted], 1e-16)
        converged[went] = settled[accepted] & (damping[went] < 1e-3)
        converged[live[stuck]] = settled[stuck]
        damping[retry], growth[retry] = damping[retry] * growth[retry], growth[retry] * 2
        # A damped step that is too small to matter is no end where a plain one, not tried yet, is not.
        creeping = converged[live] & (leapt[live] == 0)
        creeping[creeping] = ~free.take(creeping).is_converged(before[creeping], was[creeping])
        converged[live[creeping]], fresh[live[creeping]] = False, True
        due = creeping | (iterations[live] >= np.maximum(UNDAMPED_INTERVAL, 2 * leapt[live]))
        leaping = (accepted | stuck) & ~converged[live] & due
        if leaping.any():
            who = live[leaping]
            leapt[who] = iterations[who]
            x[who], cost[who] = _undamped_steps(part.take(np.flatnonzero(leaping)), x[who], cost[who])
        over = (stuck & ~creeping) | converged[live] | (fresh[live] & (iterations[live] >= max_iterations))
        if ahead is not None:
            every.assign(live[tried][accepted[tried]], ahead.take(accepted[tried]))
        # Whose step held without a triangle, or who leapt, needs one.
        lacking = np.flatnonzero(((accepted & ~first) | leaping) & ~over)
        if lacking.size:
            every.assign(
                live[lacking], part.take(lacking).linearize_and_factor(x[live[lacking]], batch.weights, False)
            )
        live, part = live[~over], part.take(np.flatnonzero(~over))
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
