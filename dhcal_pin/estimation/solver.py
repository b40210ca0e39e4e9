"""Least squares on one small triangle: the paper's pseudo-inverse loop, and Levenberg-Marquardt.

Step, rank and predicted cost come from the triangle of a `problem`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..exceptions import DhcalError
from .problem import Problem, linearize_and_factor
from .qr import TriangularSystem, append_priors, append_rows, pseudo_inverse

Progress = Callable[[int, float], None]


# A step is the last one when it changes the rows by less than this share of what they are, or by no more
# than the rounding of the model, as a share of the Jacobian's size.
STEP_RTOL, EPS_MODEL = 1e-8, 1e-15


# With so small a step ahead sigmas and priors can be told as well as at the end of the loop.
LOOSE_XTOL = 0.1


# After so many damped steps Gauss-Newton tries to get farther in a few, and again after twice as many.
UNDAMPED_INTERVAL, N_UNDAMPED_STEPS = 8, 6


# An error of so many metres or radians is no error any more.
DIVERGENCE_LIMIT = 1e6


def bounded_step(problem: Problem, triangle: TriangularSystem, x: Array) -> Array:
    """The least-squares step from x (p,) that stays within the problem's bounds."""
    if problem.bounds is None:
        return pseudo_inverse(triangle.r, triangle.z)
    # Loaded where it is needed: it takes longer than most calibrations.
    from scipy.optimize import lsq_linear

    scale = np.linalg.norm(triangle.r, axis=0)
    scale[scale == 0] = 1.0
    low, high = (problem.bounds - x) * scale
    # Bounds of no width are not allowed there; a step may touch one.
    found = lsq_linear(triangle.r / scale, triangle.z, (low - 1e-15 * scale, high + 1e-15 * scale), "bvls")
    return np.clip(found.x, low, high) / scale


def _sum_of_squares(a: Array) -> float:
    """Sum of squares."""
    return float(np.vdot(a, a))


def _norm(a: Array) -> float:
    """Root of the sum of squares."""
    return math.sqrt(_sum_of_squares(a))


def _residual_change(r: Array, step: Array) -> float:
    """How far a step moves the whitened rows."""
    return _norm(r @ step)


def _cost(problem: Problem, triangle: TriangularSystem, x: Array) -> float:
    """Sum of squared whitened residuals and priors at x (p,), given the data's triangle there."""
    return triangle.cost + _sum_of_squares(problem.weights * x)


def _step_is_negligible(
    r: Array, change: float, cost: float, last_change: float = 0.0, relative: float = STEP_RTOL
) -> bool:
    """Whether the rows will not move by anything that matters after a step that moves them by `change`.

    Near the end steps shrink quadratically: where this one is far smaller than the `last` (zero where
    nothing is known of it), the next one shrinks at least as much.
    """
    enough = relative * math.sqrt(cost)
    shrunk = change < 1e-2 * last_change and change * change < 0.1 * enough * last_change
    return change <= enough or shrunk or change <= EPS_MODEL * _norm(r)


def _is_stationary(
    problem: Problem,
    undamped: TriangularSystem,
    x: Array,
    cost: float,
    last: float,
    relative: float = STEP_RTOL,
) -> bool:
    """Whether a plain step from x would not matter either; a damped one may be tiny in a narrow valley."""
    # No step moves the rows farther than all that is left.
    if problem.bounds is None and _step_is_negligible(undamped.r, _norm(undamped.z), cost, last, relative):
        return True
    return _step_is_negligible(
        undamped.r, _residual_change(undamped.r, bounded_step(problem, undamped, x)), cost, last, relative
    )


@dataclass(frozen=True, eq=False)
class DampingState:
    """How far a loop trusts a triangle by now: damping, scales (p,), how far the last step moved the rows."""

    damping: float = 1e-8
    scale: Array | float = 0.0
    last_change: float = 0.0


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Where a loop ended: x (p,), the data's triangle there, iterations, every x on the way, its trust."""

    x: Array
    system: TriangularSystem
    iterations: int
    converged: bool
    iterates: Array
    damping_state: DampingState = DampingState()


def gauss_newton(problem: Problem, x: Array, max_iterations: int, progress: Progress | None) -> SolverResult:
    """The paper's loop (37) to (39): x ← x + R⁺·DX with a rank-revealing pseudo-inverse.

    Rotation errors are (36) and the derivative is R itself, as printed. Priors join only if given.
    """
    path, converged, done = [x], False, 0
    while done < max_iterations and not converged:
        triangle = linearize_and_factor(problem, x, small_angle=True)
        full = append_priors(triangle, problem.weights, x)
        step = pseudo_inverse(full.r, full.z)
        cost = full.min_cost + float(full.z @ full.z)
        converged = _step_is_negligible(full.r, _residual_change(full.r, step), cost)
        x = x + step
        path.append(x)
        done += 1
        if progress:
            progress(done, cost)
        if not np.abs(x).max() < DIVERGENCE_LIMIT:
            raise DhcalError("the loop diverged; use --method lm, more poses, or fix parameters")
    return SolverResult(
        x, linearize_and_factor(problem, x, small_angle=False), done, converged, np.array(path)
    )


def _undamped_steps(problem: Problem, x: Array, cost: float) -> tuple[Array, float]:
    """A few plain Gauss-Newton steps, uphill ones too; where they end if that is lower, else x."""
    far, ends = x, math.inf
    for _ in range(N_UNDAMPED_STEPS):
        triangle = append_priors(linearize_and_factor(problem, far, small_angle=False), problem.weights, far)
        there = far + bounded_step(problem, triangle, far)
        if not np.abs(there).max() < DIVERGENCE_LIMIT:
            break
        far, ends = there, problem.cost(there)
    return (far, ends) if ends < cost else (x, cost)


def levenberg_marquardt(
    problem: Problem,
    x: Array,
    max_iterations: int,
    progress: Progress | None,
    warm_start: SolverResult | None = None,
    loose: bool = False,
) -> SolverResult:
    """Levenberg-Marquardt; a retry costs forward kinematics only, the triangle stays.

    Along a narrow valley that bends, damped steps downhill are tiny and Gauss-Newton's, far uphill at
    first, arrive: now and then it may try, and at once where a damped step is so small that it looks like
    the end and a plain one is not. A loop on the same data that was `before` goes on. Who needs no more than
    where it `nearly` ends gets that, unconverged.
    """
    trust = warm_start.damping_state if warm_start else DampingState()
    damping, scale, last = trust.damping, trust.scale, trust.last_change
    path, done = (list(warm_start.iterates), warm_start.iterations) if warm_start else ([x], 0)
    growth, converged, leapt = 2.0, False, 0
    triangle = warm_start.system if warm_start else linearize_and_factor(problem, x, small_angle=False)
    cost = _cost(problem, triangle, x)
    while done < max_iterations and not converged and damping <= 1e16:
        start, reached = x, None
        free = append_priors(triangle, problem.weights, x)
        scale = np.maximum(scale, np.sqrt(np.einsum("ij,ij->j", free.r, free.r)))
        floor = np.where(scale > 0, scale, 1.0)
        rounding = EPS_MODEL * _norm(free.r)
        # Where all that is left to gain is rounding, costs tell nothing and the step is to be trusted.
        blur = (10 * rounding) ** 2 + 2 * rounding * math.sqrt(cost)
        creeping = False
        done += 1
        while True:
            damped = append_rows(free, np.sqrt(damping) * floor, np.zeros(len(x)))
            step = bounded_step(problem, damped, x)
            change = _residual_change(free.r, step)
            if loose and damping < 1e-3 and _step_is_negligible(free.r, change, cost, last, LOOSE_XTOL):
                if _is_stationary(problem, free, x, cost, last, LOOSE_XTOL):
                    return SolverResult(
                        x, triangle, done - 1, False, np.array(path), DampingState(damping, scale, last)
                    )
                creeping = leapt == 0
            settled = _step_is_negligible(free.r, change, cost, last)
            expected = _sum_of_squares(free.z) - _sum_of_squares(free.r @ step - free.z)
            ahead = None
            if settled and expected <= blur:
                trial = max(cost - expected, 0.0)
            elif not settled and growth == 2.0:
                # A first try mostly holds, and its triangle, which the next step needs, tells its cost too.
                ahead = linearize_and_factor(problem, x + step, small_angle=False)
                trial = _cost(problem, ahead, x + step)
            else:
                trial = problem.cost(x + step)
            gain = (cost - trial) / expected if expected > 0 else 0.0
            trusted = expected <= blur and trial <= (math.sqrt(cost) + 10 * rounding) ** 2
            if trusted or (trial <= cost and gain > 1e-3):
                easier = 1e-2 if trusted or gain > 0.9 else max(1e-3, 1 - (2 * gain - 1) ** 3)
                damping *= easier
                damping, growth = max(damping, 1e-16), 2.0
                x, cost, converged, reached = x + step, trial, settled and damping < 1e-3, ahead
                break
            if settled or damping > 1e16:
                # Nothing left to gain beyond rounding.
                converged = settled
                break
            damping, growth = damping * growth, growth * 2
        if converged and leapt == 0 and not _is_stationary(problem, free, start, cost, last):
            creeping, converged = True, False
        if not converged and (creeping or done >= max(UNDAMPED_INTERVAL, 2 * leapt)):
            leapt = done
            x, cost, reached = *_undamped_steps(problem, x, cost), None
        # Only whole steps show how fast they shrink.
        last = change if x is not start and growth == 2.0 else 0.0
        path.append(x)
        if progress:
            progress(done, cost)
        if converged:
            # Too small a step to bend the model.
            triangle = triangle.recentered(x - start)
        elif x is not start:
            triangle = reached or linearize_and_factor(problem, x, small_angle=False)
    return SolverResult(x, triangle, done, converged, np.array(path), DampingState(damping, scale, last))


def next_iterate(problem: Problem, solution: SolverResult) -> Array:
    """Where the least-squares step leads (p,) from where a loop nearly ended."""
    full = append_priors(solution.system, problem.weights, solution.x)
    return solution.x + bounded_step(problem, full, solution.x)


METHODS: dict[str, Callable[[Problem, Array, int, Progress | None], SolverResult]] = {
    "lm": levenberg_marquardt,
    "gn": gauss_newton,
}
