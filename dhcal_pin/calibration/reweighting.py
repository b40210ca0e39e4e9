"""Iterative reweighting: noise scales, prior widths and robust weights that the fit itself determines.

The least-squares problem depends on three sets of numbers that are not known beforehand:

- the standard deviation of each group of residuals whose instrument does not state it (variance components),
- the width of the default priors (evidence procedure, MacKay 1992),
- the weight of each sample under a robust loss (iteratively reweighted least squares).

Each round estimates all three from the current solution, and solves the problem again. The rounds end when
none of the numbers changes by more than 1 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._typing import Array
from ..estimation import qr, robust
from ..estimation.priors import PriorGroups, update_prior_scales
from ..estimation.problem import Problem
from ..estimation.robust import studentized_residuals
from ..estimation.solver import Progress, SolverResult, minimize
from ..measurements.base import Measurement

# Smallest scale of a standard deviation: a nanometre or a nanoradian for a placeholder of 1 mm or 1 mrad.
MIN_SIGMA_SCALE = 1e-6
# Largest number of rounds.
MAX_ROUNDS = 30
# Rounds end when no scale, prior or weight changes by more than this fraction.
CHANGE_TOL = 0.01


@dataclass(frozen=True, eq=False)
class Fit:
    """Solved least-squares problem with the sample weights that it was solved with.

    Attributes:
        data: Measurements with their own standard deviations, without robust weights.
        problem: Problem as it was solved, with scaled standard deviations and robust weights.
        solution: Solution of `problem`.
        weights: Robust weight of each sample, one array of shape (m,) per measurement.
        previous_iterations: Number of iterations of the solutions before this one.
    """

    data: tuple[Measurement, ...]
    problem: Problem
    solution: SolverResult
    weights: tuple[Array, ...]
    previous_iterations: int = 0

    @property
    def iterations(self) -> int:
        """Number of iterations of all solutions."""
        return self.previous_iterations + self.solution.iterations


@dataclass(frozen=True, eq=False)
class ReweightState:
    """State between two rounds of `reweight`.

    Attributes:
        fit: Current fit.
        scales: Scale of the standard deviation of each residual group, shape (g,).
        stages: Robust stages that are left, the current one first; see `robust.LOSSES`.
        weight_change: Largest change of a robust weight in the last round.
        is_final: Whether the last solution was iterated to full convergence.
        is_done: Whether all numbers have settled.
    """

    fit: Fit
    scales: Array
    stages: tuple[str, ...]
    weight_change: float = np.inf
    is_final: bool = False
    is_done: bool = False


def reweight(fit: Fit, loss: str, groups: PriorGroups, max_iterations: int, progress: Progress | None) -> Fit:
    """Solve a problem again until noise scales, prior widths and robust weights have settled.

    Args:
        fit: Fit with unit scales, unit weights and the expected prior widths.
        loss: Key of `robust.LOSSES`.
        groups: Parameters whose default priors share one scale.
        max_iterations: Largest number of iterations of one solution.
        progress: Called with the iteration and the cost.

    Returns:
        The fit of the last round.
    """
    expected = fit.problem.weights
    state = ReweightState(
        fit, np.ones(sum(len(item.residual_groups) for item in fit.data)), robust.LOSSES[loss].stages
    )
    for rounds_left in reversed(range(MAX_ROUNDS)):
        state = _next_round(state, groups, expected, rounds_left, max_iterations, progress)
        if state.is_done:
            break
    return state.fit


def _next_round(
    state: ReweightState,
    groups: PriorGroups,
    expected: Array,
    rounds_left: int,
    max_iterations: int,
    progress: Progress | None,
) -> ReweightState:
    """Estimate scales, priors and weights from the current solution, and solve again if they changed."""
    fit, stage = state.fit, state.stages[0]
    problem, solution, weights, change = fit.problem, fit.solution, fit.weights, 0.0
    scales = estimate_variance_components(problem, solution, fit.data, weights)
    weighted = with_sigma_scales(fit.data, scales)
    if stage != "uniform":
        residuals = studentized_residuals(problem, solution, weighted, weights)
        weights, change = robust.update_weights(weights, residuals, stage, state.weight_change)
        weighted = tuple(item.with_weights(w) for item, w in zip(weighted, weights, strict=True))
    priors = update_prior_scales(problem, solution, groups)
    relative = np.log(scales / state.scales), (priors - problem.weights) / np.fmax(expected, 1e-300)
    has_settled = max(change, *(np.abs(each).max(initial=0.0) for each in relative)) < CHANGE_TOL
    state = replace(state, fit=replace(fit, weights=tuple(weights)), weight_change=change)
    if has_settled and len(state.stages) > 1:
        if stage != "uniform" or any(
            map(robust.has_possible_outliers, studentized_residuals(problem, solution, weighted, weights))
        ):
            return replace(state, stages=state.stages[1:], weight_change=np.inf)
        state = replace(state, stages=state.stages[:1])
    if has_settled and state.is_final:
        return replace(state, is_done=True)
    is_final = has_settled or rounds_left < 2
    if has_settled or all(new is old for new, old in zip(weighted, problem.data, strict=True)):
        # Same rows: continue the previous iteration with the new priors.
        problem, before, earlier = problem.with_prior_weights(priors), solution, fit.previous_iterations
    else:
        problem, before, earlier = (
            problem.with_data(weighted).with_prior_weights(priors),
            None,
            fit.iterations,
        )
        state = replace(state, scales=scales)
    solution = minimize(
        problem, "lm", solution.x, max_iterations, progress, warm_start=before, loose=not is_final
    )
    fit = replace(state.fit, problem=problem, solution=solution, previous_iterations=earlier)
    return replace(state, fit=fit, is_final=is_final)


def estimate_variance_components(
    problem: Problem, solution: SolverResult, data: tuple[Measurement, ...], weights: Sequence[Array]
) -> Array:
    """How many of its sigmas each group of rows scatters in the fit, all items' groups in a row (g,).

    One where the instrument states its sigmas, or where there are not more rows than directions seen. A
    group of no more rows than that could be met exactly, whatever it reads, and tells no scatter of its
    own: it takes the one of all rows of its unit, and where the others are stated that of a placeholder.
    """
    if all(item.has_stated_sigma for item in data):
        return np.ones(sum(len(item.residual_groups) for item in data))
    chain = problem.errors.at(solution.x[: len(problem.errors.parameters)])
    residuals = [
        item.residual(
            chain.forward_kinematics(item.configurations()), problem.instrument_values_of(item, solution.x)
        )
        for item in data
    ]
    counts = [w.sum() for w in weights]
    seen = qr.rank(solution.system.r)
    share = 1 - seen / sum(len(r) * count for r, count in zip(residuals, counts, strict=True))
    # Of each group: whether it is of angles, whether it is stated, its rows, and the sum of their squares.
    groups = [
        (name == "orientation", item.has_stated_sigma, len(r[rows]) * count, np.sum(r[rows] ** 2 * w))
        for item, r, w, count in zip(data, residuals, weights, counts, strict=True)
        for name, rows in item.residual_groups.items()
    ]
    out = np.ones(len(groups))
    for i, (angle, stated, rows, squares) in enumerate(groups if share > 0 else ()):
        alike = [group for group in groups if group[0] == angle]
        pooled = [group for group in alike if not group[1]]
        if rows <= seen and len(alike) > 1:
            rows, squares = (sum(group[k] for group in pooled) for k in (2, 3))
            stated = stated or len(pooled) == 1
        if not stated:
            out[i] = max(float(np.sqrt(squares / (rows * share))), MIN_SIGMA_SCALE)
    return out


def with_sigma_scales(data: tuple[Measurement, ...], scales: Array) -> tuple[Measurement, ...]:
    """Scale the standard deviations of each group of rows."""
    if np.all(scales == 1):
        return data
    left = iter(scales.tolist())
    return tuple(item.with_scaled_sigma({name: next(left) for name in item.residual_groups}) for item in data)
