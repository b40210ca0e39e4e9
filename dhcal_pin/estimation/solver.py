"""Nonlinear least squares: Levenberg-Marquardt and Gauss-Newton on a triangular system.

Both methods minimize over the p unknowns x the cost

    F(x) = ‖r(x)‖² + ‖W·x‖²

with whitened residuals r and prior weights W = diag(1/σ). At each x all samples are reduced to a triangular
system (module `qr`) with ‖r(x + δ)‖² ≈ ‖R·δ - z‖² + min_cost; the prior rows δ/σ = -x/σ are appended to it.
The steps work on this (p+1)×(p+1) matrix only.

**Levenberg-Marquardt** (Nocedal & Wright 2006, chapter 10). A step solves

    min ‖R·δ - z‖² + λ·‖D·δ‖²        low ≤ x + δ ≤ high

where D holds the largest norms so far of the columns of R (Moré 1978), so that the steps do not depend on the
units. The gain ratio ρ of actual over predicted reduction decides on acceptance and on the next damping λ
(Nielsen 1999); `solver_rules` states the rules. A rejected step keeps R and costs one evaluation of F. The
first trial of an iteration is mostly accepted; it is therefore linearized at once, which also yields F.

In a narrow curved valley damped steps downhill become tiny, while undamped Gauss-Newton steps first go
uphill and then arrive at the minimum. From time to time, and when only damped steps have become negligible,
a series of undamped steps is tried, and kept if the cost falls.

Where such a series fails after many iterations, rotations make the valley curved, such as those of a tool and
of a board on it that turns back: no row changes, but the board moves along a circle. Translations are linear.
Then D counts rotations more, so that steps in directions that several unknowns share are translations.

The iteration has converged if a step changes the rows by less than 1e-8 of their norm, or by less than
rounding, at small damping. In a curved valley it has converged, too, if the undamped step no longer shrinks
and is short against the standard deviations of the unknowns.

**Gauss-Newton** is the iteration of the paper, equations (36) to (39): x ← x + R⁺·z with a pseudo-inverse of
fixed rank cut, without damping.

References:
    J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006.
    J. J. Moré, The Levenberg-Marquardt Algorithm: Implementation and Theory, Springer LNM 630, 1978.
    H. B. Nielsen, Damping Parameter in Marquardt's Method, IMM-REP-1999-05, DTU 1999.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import ConvergenceError, UnknownNameError
from . import solver_rules as rules
from .problem import Problem, linear_system, linearize_and_factor
from .qr import (
    TriangularSystem,
    append_rows,
    euclidean_norm,
    sum_of_squares,
)
from .solver_rules import has_diverged, step_is_negligible

# Receives the iteration number and the cost.
IterationCallback = Callable[[int, float], None]

# A loose solution ends when a step changes the rows by less than this fraction of their norm. Noise scales
# and prior widths estimated there agree with those at the minimum.
LOOSE_RTOL = 0.1
# Width [m or rad] by which bounds are relaxed: the bounded solver does not accept an interval of zero width.
BOUND_TOL = 1e-15


@frozen(eq=False)
class DampingState:
    """State of a Levenberg-Marquardt iteration that a continuation starts from."""

    damping: float = rules.INITIAL_DAMPING
    scale: Array | float = 0.0  # Column scales D of shape (p,), the largest norms of the columns of R so far
    last_change: float = 0.0  # Norm of the change of the rows by the last step; zero if unknown
    last_step: Array | None = None  # Last step (p,); None if it does not show a direction of slow steps


@frozen(eq=False)
class SolverResult:
    """Result of `minimize`."""

    x: Array  #: Solution of shape (p,) [m and rad].
    system: TriangularSystem  #: Triangular system of the data at x, without priors.
    iterations: int  #: Number of iterations.
    converged: bool  #: Whether the last step was negligible.
    iterates: Array  #: All x from the start to the solution, shape (iterations + 1, p).
    damping_state: DampingState = DampingState()  #: State to continue from (`warm_start`).


def minimize(
    problem: Problem,
    method: str = "lm",
    x: Array | None = None,
    max_iterations: int = 100,
    progress: IterationCallback | None = None,
    **options: Any,
) -> SolverResult:
    """Minimize the cost of a problem."""
    if method not in METHODS:
        raise UnknownNameError(f"unknown method {method!r}; choose from {', '.join(METHODS)}")
    start = np.zeros(len(problem.weights)) if x is None else x
    return METHODS[method](problem, start, max_iterations, progress, **options)


def bounded_step(problem: Problem, system: TriangularSystem, x: Array) -> Array:
    """Compute the least-squares step that stays within the bounds of a problem."""
    if problem.bounds is None:
        return system.best_step()
    # lazy import: scipy.optimize takes longer to import than most calibrations take.
    from scipy.optimize import lsq_linear

    scale = np.linalg.norm(system.r, axis=0)
    scale[scale == 0] = 1.0
    low, high = (problem.bounds - x) * scale
    relaxed = low - BOUND_TOL * scale, high + BOUND_TOL * scale
    scaled = lsq_linear(system.r / scale, system.z, relaxed, "bvls").x
    return np.clip(scaled, low, high) / scale


def next_iterate(problem: Problem, solution: SolverResult) -> Array:
    """Compute the point that one undamped step reaches from a loose solution."""
    system = solution.system.with_priors(problem.weights, solution.x)
    return solution.x + bounded_step(problem, system, solution.x)


def complete(problem: Problem, loose: SolverResult, max_iterations: int) -> tuple[Array, float]:
    """Complete a loose solution by an undamped step, or else by iterations; return its end and the cost."""
    end = next_iterate(problem, loose)
    cost = problem.cost(end)
    if cost <= _cost(problem, loose.system, loose.x):
        return end, cost
    # An undamped step in a curved valley, or along an undetermined direction, can lead far away.
    further = minimize(problem, "lm", loose.x, max_iterations, warm_start=loose)
    return further.x, _cost(problem, further.system, further.x)


def _undamped_change(problem: Problem, data: TriangularSystem, x: Array) -> float:
    """Compute the norm of the change of the whitened rows by an undamped step from x (p,)."""
    system = data.with_priors(problem.weights, x)
    return euclidean_norm(system.residual_change(bounded_step(problem, system, x)))


def remaining_change(problem: Problem, x: Array) -> float:
    """Compute the norm of the change of the whitened rows by a fresh Gauss-Newton step from x (p,)."""
    return _undamped_change(problem, linearize_and_factor(problem, x, small_angle=False), x)


def _cost(problem: Problem, system: TriangularSystem, x: Array) -> float:
    """Compute the cost at x from the triangular system of the data there."""
    return system.cost + sum_of_squares(problem.weights * x)


def _is_stationary(
    problem: Problem,
    undamped: TriangularSystem,
    x: Array,
    cost: float,
    last_change: float,
    roundoff: float,
    rtol: float = rules.STEP_RTOL,
) -> bool:
    """Check that the undamped step from x is negligible, too; damping alone may shorten a step."""
    residual_norm = math.sqrt(cost)
    # No step changes the rows by more than ‖z‖.
    max_change = euclidean_norm(undamped.z)
    if problem.bounds is None and step_is_negligible(max_change, residual_norm, last_change, roundoff, rtol):
        return True
    change = euclidean_norm(undamped.residual_change(bounded_step(problem, undamped, x)))
    return step_is_negligible(change, residual_norm, last_change, roundoff, rtol)


def gauss_newton(
    problem: Problem, x: Array, max_iterations: int, progress: IterationCallback | None = None
) -> SolverResult:
    """Minimize by undamped steps with a pseudo-inverse: the paper's iteration, equations (36) to (39)."""
    iterates, converged, iteration = [x], False, 0
    while iteration < max_iterations and not converged:
        data = linearize_and_factor(problem, x, small_angle=True)
        system = data.with_priors(problem.weights, x)
        step = system.best_step()
        cost = system.min_cost + float(system.z @ system.z)
        change = euclidean_norm(system.residual_change(step))
        converged = step_is_negligible(change, math.sqrt(cost), 0.0, system.roundoff)
        x = x + step
        iterates.append(x)
        iteration += 1
        if progress:
            progress(iteration, cost)
        if has_diverged(x):
            raise ConvergenceError("method gn: the iteration diverged; use --method lm, or fix parameters")
    system = linearize_and_factor(problem, x, small_angle=False)
    return SolverResult(x, system, iteration, converged, np.array(iterates))


def _undamped_steps(problem: Problem, x: Array, cost: float) -> tuple[Array, float]:
    """Try a series of undamped steps, also uphill; return its end and the cost there if that is lower."""
    end, end_cost = x, math.inf
    for _ in range(rules.N_UNDAMPED_STEPS):
        system = linear_system(problem, end).with_priors(problem.weights, end)
        trial = end + bounded_step(problem, system, end)
        if has_diverged(trial):
            break
        end, end_cost = trial, problem.cost(trial)
    return (end, end_cost) if end_cost < cost else (x, cost)


def _extrapolated(
    problem: Problem,
    undamped: TriangularSystem,
    x: Array,
    system: TriangularSystem,
    steps: tuple[Array, Array],
) -> tuple[Array, TriangularSystem] | None:
    """Return a better point on the way to the limit of slow steps, with its system; None without one."""
    # The last two steps led to x, the last one second; the undamped system is that before it.
    last_change, change = map(undamped.residual_change, steps)
    factor = rules.extrapolation_factor(change, last_change)
    cost = _cost(problem, system, x)
    roundoff = rules.cost_roundoff(math.sqrt(cost), undamped.roundoff)
    for share in rules.EXTRAPOLATED_SHARES if factor else ():
        end = x + share * factor * steps[1]
        end = end if problem.bounds is None else np.clip(end, *problem.bounds)
        if has_diverged(end):
            continue
        end_system = linear_system(problem, end)
        reduction = cost - _cost(problem, end_system, end)
        # Costs that agree within rounding do not show which point is better, but the undamped steps do.
        if reduction > roundoff or (
            reduction > -roundoff
            and _undamped_change(problem, end_system, end) < _undamped_change(problem, system, x)
        ):
            return end, end_system
    return None


def levenberg_marquardt(
    problem: Problem,
    x: Array,
    max_iterations: int,
    progress: IterationCallback | None = None,
    warm_start: SolverResult | None = None,
    loose: bool = False,
) -> SolverResult:
    """Minimize by damped steps (see the module docstring)."""
    state = warm_start.damping_state if warm_start else DampingState()
    damping, scale, last_change = state.damping, state.scale, state.last_change
    iterates, iteration = (list(warm_start.iterates), warm_start.iterations) if warm_start else ([x], 0)
    growth, converged, last_undamped = rules.INITIAL_GROWTH, False, 0
    # Whether a series of undamped steps has failed, and the change of the rows by one undamped step.
    is_curved, remaining = False, math.inf
    last_step = state.last_step
    system = warm_start.system if warm_start else linear_system(problem, x)
    cost = _cost(problem, system, x)
    while iteration < max_iterations and not converged and damping <= rules.MAX_DAMPING:
        start, accepted_system = x, None
        undamped = system.with_priors(problem.weights, x)
        roundoff, residual_norm = undamped.roundoff, math.sqrt(cost)
        if is_curved:
            last_remaining, remaining = remaining, _undamped_change(problem, system, x)
            if rules.is_slow_and_short(remaining, last_remaining):
                converged = True
                break
        if (
            loose
            and damping < rules.MAX_CONVERGED_DAMPING
            and _is_stationary(problem, undamped, x, cost, last_change, roundoff, LOOSE_RTOL)
        ):
            state = DampingState(damping, scale, last_change, last_step)
            return SolverResult(x, system, iteration, False, np.array(iterates), state)
        scale = np.maximum(scale, np.sqrt(np.einsum("ij,ij->j", undamped.r, undamped.r)))
        damping_scale = np.where(scale > 0, scale, 1.0)
        if is_curved:
            is_rotation = [parameter.unit == "rad" for parameter in problem.parameters]
            damping_scale[is_rotation] *= rules.CURVED_ROTATION_FACTOR
        # Whether steps have become negligible although the undamped step is not.
        stalled = False
        iteration += 1
        while True:
            damped = append_rows(undamped, math.sqrt(damping) * damping_scale, np.zeros(len(x)))
            step = bounded_step(problem, damped, x)
            row_change = undamped.residual_change(step)
            change = euclidean_norm(row_change)
            if (
                loose
                and damping < rules.MAX_CONVERGED_DAMPING
                and step_is_negligible(change, residual_norm, last_change, roundoff, LOOSE_RTOL)
            ):
                stalled = last_undamped == 0
            is_negligible = step_is_negligible(change, residual_norm, last_change, roundoff)
            predicted = undamped.predicted_reduction(row_change)
            trial_system = None
            if is_negligible and predicted <= rules.cost_roundoff(residual_norm, roundoff):
                # Costs cannot verify a reduction below rounding; the linear model is trusted.
                trial_cost = max(cost - predicted, 0.0)
            elif not is_negligible and growth == rules.INITIAL_GROWTH:
                # First trial of the iteration: the next iteration needs its linearization.
                trial_system = linear_system(problem, x + step)
                trial_cost = _cost(problem, trial_system, x + step)
            else:
                trial_cost = problem.cost(x + step)
            gain = rules.gain_ratio(cost, trial_cost, predicted)
            within_roundoff = rules.is_within_roundoff(predicted, trial_cost, residual_norm, roundoff)
            if within_roundoff and not is_negligible:
                # Costs do not show whether the step is good, but the length of the next one does.
                trial_system = trial_system or linear_system(problem, x + step)
                changes = (
                    _undamped_change(problem, system, x),
                    _undamped_change(problem, trial_system, x + step),
                )
                if rules.is_growing(*changes, roundoff):
                    within_roundoff, gain = False, 0.0
            if rules.is_acceptable(cost, trial_cost, gain, within_roundoff):
                damping = rules.damping_after_acceptance(damping, gain, within_roundoff)
                growth = rules.INITIAL_GROWTH
                converged = is_negligible and damping < rules.MAX_CONVERGED_DAMPING
                x, cost, accepted_system = x + step, trial_cost, trial_system
                break
            if is_negligible or damping > rules.MAX_DAMPING:
                # No reduction beyond rounding is left.
                converged = is_negligible
                break
            damping, growth = rules.damping_after_rejection(damping, growth)
        if (
            converged
            and last_undamped == 0
            and not _is_stationary(problem, undamped, start, cost, last_change, roundoff)
        ):
            stalled, converged = True, False
        if converged and is_curved:
            converged = remaining <= rules.MAX_DEVIATION
        if not converged and (stalled or rules.undamped_steps_are_due(iteration, last_undamped)):
            last_undamped, damped_end = iteration, x
            x, cost = _undamped_steps(problem, x, cost)
            is_curved = x is damped_end and iteration >= rules.MIN_CURVED_ITERATIONS
            accepted_system = None
        # Unknown if x did not move, or only by undamped steps after a rejection.
        has_moved = x is not start and growth == rules.INITIAL_GROWTH
        last_change = change if has_moved else 0.0
        iterates.append(x)
        if progress:
            progress(iteration, cost)
        if converged:
            # The model is linear over a negligible step.
            system = system.recentered(x - start)
        elif x is not start:
            system = accepted_system or linear_system(problem, x)
            steps = (last_step, step) if last_step is not None and has_moved else None
            last_step = step if has_moved and last_undamped != iteration else None
            if steps and (better := _extrapolated(problem, undamped, x, system, steps)):
                # The next two steps show a direction again.
                x, system = better
                cost, last_step, last_change = _cost(problem, system, x), None, 0.0
    state = DampingState(damping, scale, last_change, last_step)
    return SolverResult(x, system, iteration, converged, np.array(iterates), state)


METHODS: dict[str, Callable[..., SolverResult]] = {
    "lm": levenberg_marquardt,
    "gn": gauss_newton,
}
