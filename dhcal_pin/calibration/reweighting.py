"""Iterative reweighting: noise scales, prior widths and robust weights that the fit itself determines.

The least-squares problem depends on three sets of numbers that are not known beforehand:

1. The standard deviations of residual groups whose instrument does not state them. Group g has a scale

       s_g² = Σ_i w_i·‖r_gi‖² / (m_g - p_g),

   with r_gi the residuals in units of the placeholder standard deviation, w_i robust weights, m_g the
   weighted rows of the group and p_g the degrees of freedom that they lose. This is a variance component
   estimate (Helmert 1907; Foerstner 1979). For geometric errors alone the rank of the Jacobian is shared
   equally among the rows. For families of joint errors, many of which only their priors determine, p_g is the
   sum of the leverages of the rows, if it is not negligible: a group that takes more parameters than its
   share would otherwise be fitted more closely in each round.
2. The widths of the default priors, from the evidence procedure (MacKay 1992), see `estimation.priors`.
3. The weight of each sample under a robust loss, from iteratively reweighted least squares, see
   `estimation.robust`; loss "auto" starts from the samples that a majority agrees with, see
   `good_samples`. A solution that bad samples shifted may be far from the one of the good samples, and its
   prior widths are too large. The good samples are therefore solved from the nominal robot with the expected
   widths, and searched again at that solution until they stay the same.

Each round estimates all three from the current solution and solves the problem again, starting from it.
Early rounds solve loosely. Once none of the numbers changes by more than 1 %, the problem is iterated to full
convergence in each round, until that holds again.

References:
    F. R. Helmert, Die Ausgleichungsrechnung nach der Methode der kleinsten Quadrate, Teubner 1907.
    W. Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, AVN 86, 1979.
    D. J. C. MacKay, Bayesian Interpolation, Neural Computation 4, 1992.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from typing import NamedTuple

import numpy as np

from .._frozen import frozen
from .._typing import Array, Progress
from ..estimation import robust
from ..estimation.priors import PriorGroups, effective_parameters, update_prior_scales
from ..estimation.problem import Problem
from ..estimation.robust import SolvedProblem, WeightChange, studentized_residuals
from ..estimation.solver import SolverResult, minimize
from ..measurements.base import Measurement
from .good_samples import find_good_samples
from .partition import configuration_groups

# Smallest scale of a standard deviation: a nanometre or a nanoradian for a placeholder of 1 mm or 1 mrad.
MIN_SIGMA_SCALE = 1e-6
# Largest number of rounds.
MAX_ROUNDS = 30
# Largest number of searches for the good samples.
MAX_SEARCHES = 4
# Name of the rounds for the user.
PHASE = "robust weights"
# Rounds end when no scale, prior or weight changes by more than this fraction.
CHANGE_TOL = 0.01
# Replaces the weight 0 of a parameter without a prior, to avoid a division by zero.
MIN_WEIGHT = 1e-300

# Function that returns the degrees of freedom (g,) that residual groups of n_rows (g,) rows lose.
LostFreedom = Callable[[SolvedProblem, Array], Array]


@frozen(eq=False)
class Fit:
    """Solved least-squares problem with the sample weights that it was solved with."""

    data: tuple[Measurement, ...]  # Measurements with their own standard deviations, without robust weights
    problem: Problem  # Problem as it was solved, with scaled standard deviations and robust weights
    solution: SolverResult  # Solution of `problem`
    weights: tuple[Array, ...]  # Robust weight of each sample, one array of shape (m,) per measurement
    previous_iterations: int = 0  # Number of iterations of the solutions before this one
    stage: str = robust.KEPT  # Robust stage that the weights are from, see `robust.LOSSES`
    start: Array | None = None  # Unknowns (p+s,) at which a fit without outliers starts; zero if None

    @property
    def iterations(self) -> int:
        """Number of iterations of all solutions."""
        return self.previous_iterations + self.solution.iterations

    def solved_with(self, data: Sequence[Measurement], max_iterations: int) -> Fit:
        """Solve loosely again with other standard deviations of the same measurements."""
        return self.with_sigmas(data).solved(max_iterations)

    def with_sigmas(self, data: Sequence[Measurement]) -> Fit:
        """Return the fit, not solved again, with other standard deviations of the same measurements."""
        weighted = [item.with_weights(w) for item, w in zip(data, self.weights, strict=True)]
        return replace(self, problem=replace(self.problem, data=tuple(weighted)))

    def solved(self, max_iterations: int) -> Fit:
        """Solve the problem loosely from the solution."""
        solution = minimize(self.problem, "lm", self.solution.x, max_iterations, loose=True)
        return replace(self, solution=solution, previous_iterations=self.iterations)

    def solved_with_weights(self, weights: tuple[Array, ...], max_iterations: int) -> Fit:
        """Solve loosely again with other robust weights."""
        ratios = zip(self.problem.data, weights, self.weights, strict=True)
        problem = self.problem.with_data([item.with_weights(new / old) for item, new, old in ratios])
        solution = minimize(problem, "lm", self.solution.x, max_iterations, loose=True)
        solved = replace(self, problem=problem, solution=solution, previous_iterations=self.iterations)
        return replace(solved, weights=weights)

    def without_rejected(self) -> Fit:
        """Return the fit without rejected samples, which are not evidence of the noise."""
        masks = [w > robust.ZERO_WEIGHT for w in self.weights]
        if all(mask.all() for mask in masks):
            return self
        return replace(
            self,
            data=tuple(item.take(mask) for item, mask in zip(self.data, masks, strict=True)),
            problem=self.problem.with_data(
                [item.take(mask) for item, mask in zip(self.problem.data, masks, strict=True)]
            ),
            weights=tuple(w[mask] for w, mask in zip(self.weights, masks, strict=True)),
        )


@frozen(eq=False)
class ReweightState:
    """State between two rounds of `reweight`."""

    fit: Fit
    scales: Array  # Scale of the standard deviation of each residual group, shape (g,)
    stages: tuple[str, ...]  # Robust stages that are left, the current one first; see `robust.LOSSES`
    # Change of the robust weights in the last round.
    weight_change: WeightChange = field(default_factory=WeightChange)
    n_searches: int = 0  # Number of searches for the good samples
    is_final: bool = False  # Whether the last solution was iterated to full convergence
    is_done: bool = False  # Whether all numbers have settled


def shared_rank(solved: SolvedProblem, n_rows: Array) -> Array:
    """Share the number of directions of parameter space that the data determine among all rows."""
    return solved.solution.system.rank * n_rows / n_rows.sum()


def leverages(solved: SolvedProblem, n_rows: Array) -> Array:
    """Sum the leverages of the rows of each group, or share the sum among all rows if it is negligible."""
    total = effective_parameters(solved.problem, solved.solution)
    if total < robust.NEGLIGIBLE_LEVERAGE * n_rows.sum():
        return total * n_rows / n_rows.sum()
    return np.array(
        [
            np.einsum("mkk->", covariances[:, group.rows, group.rows])
            for item, covariances in zip(solved.problem.data, solved.prediction_covariances, strict=True)
            for group in item.residual_groups.values()
        ]
    )


def reweight(
    fit: Fit,
    stages: tuple[str, ...],
    groups: PriorGroups,
    max_iterations: int,
    progress: Progress | None,
    lost_freedom: LostFreedom = shared_rank,
) -> Fit:
    """Solve a problem again until noise scales, prior widths and robust weights have settled."""
    expected = fit.problem.weights
    state = ReweightState(fit, np.ones(sum(len(item.residual_groups) for item in fit.data)), stages)
    for rounds_left in reversed(range(MAX_ROUNDS)):
        if progress:
            progress(PHASE, MAX_ROUNDS - rounds_left, MAX_ROUNDS)
        is_last = rounds_left <= 1
        state = _next_round(state, groups, expected, max_iterations, lost_freedom, is_last)
        if state.is_done:
            break
    return replace(state.fit, stage=state.stages[-1])


def _next_round(
    state: ReweightState,
    groups: PriorGroups,
    expected: Array,
    max_iterations: int,
    lost_freedom: LostFreedom,
    is_last: bool,
) -> ReweightState:
    """Estimate scales, priors and weights from the current solution, and solve again if they changed."""
    fit, stage = state.fit, state.stages[0]
    problem, solution, weights, change = fit.problem, fit.solution, fit.weights, WeightChange(0.0)
    solved = SolvedProblem(problem, solution)
    scales = estimate_variance_components(solved, fit.data, weights, lost_freedom)
    weighted = with_sigma_scales(fit.data, scales)
    if stage == robust.TRIMMED:
        groups_of_samples = configuration_groups(fit.data)
        weights, last = find_good_samples(problem, solution, weighted, groups_of_samples, fit.weights)
        change = robust.weight_change(weights, fit.weights)
        # The rounds go on with these weights, then with another search or with those of the nonlinear model.
        # A fit to all parts of joint space does not show that one of them agrees better by itself.
        n_searches = MAX_SEARCHES if last == robust.REGIONAL else state.n_searches + 1
        next_search = (robust.TRIMMED,) if change.size and n_searches < MAX_SEARCHES else ()
        state = replace(state, stages=(robust.KEPT, *next_search, last), n_searches=n_searches)
    elif stage in robust.WEIGHT_FUNCTIONS:
        residuals = studentized_residuals(solved, weighted, weights)
        wanted = [
            robust.reject_groups(robust.sample_weights(t, stage), t, item)
            for t, item in zip(residuals, fit.data, strict=True)
        ]
        weights, change = robust.update_weights(weights, wanted, stage, state.weight_change)
    if any((w != 1).any() for w in weights):
        weighted = tuple(item.with_weights(w) for item, w in zip(weighted, weights, strict=True))
    start, priors = solution.x, update_prior_scales(problem, solution, groups)
    if stage == robust.TRIMMED and change.size:
        start, priors = np.zeros_like(start) if fit.start is None else fit.start, expected
    relative = np.log(scales / state.scales), (priors - problem.weights) / np.fmax(expected, MIN_WEIGHT)
    has_settled = max(change.size, *(np.abs(each).max(initial=0.0) for each in relative)) < CHANGE_TOL
    if has_settled and (state.is_final or len(state.stages) > 1):
        fit = replace(fit, weights=tuple(weights))
        if len(state.stages) > 1:
            return replace(state, fit=fit, stages=state.stages[1:], weight_change=WeightChange())
        return replace(state, fit=fit, weight_change=change, is_done=True)
    is_final = has_settled or is_last or state.is_final
    if has_settled or all(new is old for new, old in zip(weighted, problem.data, strict=True)):
        # The rows are the same: continue the previous iteration with the new priors.
        problem = problem.with_prior_weights(priors)
        warm_start, previous_iterations, scales = solution, fit.previous_iterations, state.scales
    else:
        problem = problem.with_data(weighted).with_prior_weights(priors)
        warm_start, previous_iterations = None, fit.iterations
    fit = replace(
        fit,
        problem=problem,
        solution=minimize(problem, "lm", start, max_iterations, warm_start=warm_start, loose=not is_final),
        weights=tuple(weights),
        previous_iterations=previous_iterations,
    )
    return replace(state, fit=fit, scales=scales, weight_change=change, is_final=is_final)


def estimate_variance_components(
    solved: SolvedProblem,
    data: tuple[Measurement, ...],
    weights: Sequence[Array],
    lost_freedom: LostFreedom,
) -> Array:
    """Estimate one noise scale per residual group from the residuals of a fit; 1 for stated groups."""
    # A group with no more rows than determined parameters could be fitted exactly, so its residuals do not
    # show its noise. It takes the pooled scale of all groups of its unit that do not state their standard
    # deviations, or 1 if it is the only one. All scales are 1 if there are not more rows in all.
    if all(item.has_stated_sigma for item in data):
        return np.ones(sum(len(item.residual_groups) for item in data))
    problem, solution = solved.problem, solved.solution
    chain = problem.errors.at(solution.x[: len(problem.errors.parameters)])
    residuals = [
        item.residual(
            chain.forward_kinematics(item.conditions()), problem.instrument_values_of(item, solution.x)
        )
        for item in data
    ]
    each = [
        (group.unit, item.has_stated_sigma, len(r[group.rows]) * w.sum(), np.sum(r[group.rows] ** 2 * w))
        for item, r, w in zip(data, residuals, weights, strict=True)
        for group in item.residual_groups.values()
    ]
    lost = lost_freedom(solved, np.array([n_rows for _, _, n_rows, _ in each]))
    groups = [_ResidualGroup(*values, n_lost) for values, n_lost in zip(each, lost.tolist(), strict=True)]
    n_determined = lost.sum()
    scales = np.ones(len(groups))
    for i, group in enumerate(groups if n_determined < sum(group.n_rows for group in groups) else ()):
        same_unit = [other for other in groups if other.unit == group.unit]
        pooled = [other for other in same_unit if not other.is_stated]
        freedom, squares, is_stated = group.freedom, group.squares, group.is_stated
        if group.n_rows <= n_determined and len(same_unit) > 1:
            freedom = sum(other.freedom for other in pooled)
            squares = sum(other.squares for other in pooled)
            is_stated = is_stated or len(pooled) == 1
        if not is_stated:
            scales[i] = max(float(np.sqrt(squares / freedom)), MIN_SIGMA_SCALE)
    return scales


class _ResidualGroup(NamedTuple):
    """Residual group of one measurement: its weighted number of rows, sum of squares and lost freedom."""

    unit: str
    is_stated: bool
    n_rows: float
    squares: float
    n_lost: float

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the residuals."""
        return self.n_rows - self.n_lost


def with_sigma_scales(data: tuple[Measurement, ...], scales: Array) -> tuple[Measurement, ...]:
    """Scale the standard deviations of each residual group."""
    if np.all(scales == 1):
        return data
    remaining = iter(scales.tolist())
    return tuple(
        item.with_scaled_sigma({name: next(remaining) for name in item.residual_groups}) for item in data
    )
