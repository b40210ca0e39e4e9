"""Step rules of the solvers: acceptance, damping and termination of a Levenberg-Marquardt iteration.

Both solvers decide by these rules: `solver` for one problem, with Python floats, and `batch` for many
problems in lockstep, with one array element per problem. Each rule is one expression that serves both.

Notation of one iteration, with the triangular system ‖R·δ - z‖² + min_cost at the current x:

- δ: trial step, minimizes ‖R·δ - z‖² + λ·‖D·δ‖² with damping λ and column scales D,
- F: cost at x; √F is the norm of all whitened rows,
- F₊: cost at x + δ,
- ‖R·δ‖: change of the whitened rows,
- predicted reduction: ‖z‖² - ‖R·δ - z‖²,
- gain ratio: ρ = (F - F₊) / predicted reduction,
- roundoff: ε = EPS_MODEL·‖R‖, the rounding error of the model's rows.

Acceptance: F₊ ≤ F and ρ > MIN_GAIN_RATIO, or both costs agree within rounding and undamped steps do not grow.

Damping (Nielsen 1999): after an accepted step λ ← λ·max(MIN_DAMPING_FACTOR, 1 - (2ρ - 1)³), after a
rejected one λ ← λ·ν and ν ← 2·ν.

Extrapolation: where the rows are curved, steps may shrink by the same ratio again and again, along one
direction. A further step leads to their limit (`extrapolation_factor`), or a part of the way. It is kept if
the cost falls; where costs agree within rounding, if undamped steps become shorter.

Termination: the step is negligible (`step_is_negligible`) and λ < MAX_CONVERGED_DAMPING.

References:
    A. C. Aitken, On Bernoulli's numerical solution of algebraic equations, Proc. Royal Society of
    Edinburgh 46, 1926.
    J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 4 and 10.
    H. B. Nielsen, Damping Parameter in Marquardt's Method, IMM-REP-1999-05, DTU 1999.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from .._typing import Array

# A step is negligible if it changes the rows by less than this fraction of their norm.
STEP_RTOL = 1e-8
# Rounding error of the model's rows as a fraction of the norm of the Jacobian.
EPS_MODEL = 1e-15
# Safety factor on the rounding error where two costs are compared.
ROUNDOFF_FACTOR = 10
# A step that is shorter than the previous one by this ratio indicates quadratic convergence.
MAX_QUADRATIC_RATIO = 1e-2

# Smallest gain ratio of an accepted step.
MIN_GAIN_RATIO = 1e-3
# Gain ratio above which the linear model is accurate; the damping then falls by GOOD_STEP_FACTOR.
GOOD_GAIN_RATIO = 0.9
GOOD_STEP_FACTOR = 1e-2
# Smallest factor by which an accepted step changes the damping.
MIN_DAMPING_FACTOR = 1e-3

# Damping of the first iteration, relative to the squared column norms of R, and its limits.
INITIAL_DAMPING = 1e-8
MIN_DAMPING = 1e-16
MAX_DAMPING = 1e16
# Largest damping at which a negligible step means convergence; above it damping alone may shorten the step.
MAX_CONVERGED_DAMPING = 1e-3
# Factor ν on the damping after the first rejected step; it doubles with each further rejection.
INITIAL_GROWTH = 2.0

# Two steps have the same direction if the cosine between their changes of the rows exceeds this value. They
# converge slowly if the second one is longer than this fraction of the first one.
MIN_SAME_DIRECTION, MIN_SLOW_RATIO = 0.99, 0.3
# Shares of the way to the limit of slow steps that are tried one after the other.
EXTRAPOLATED_SHARES = 1.0, 0.5, 0.25

# Iterations before the first series of undamped steps, and number of steps in a series.
UNDAMPED_INTERVAL = 8
N_UNDAMPED_STEPS = 6

# Iterations before which a series of undamped steps that fails means nothing: far from the minimum many do.
MIN_CURVED_ITERATIONS = 32
# Factor on the column scales of rotations after a series of undamped steps has failed.
CURVED_ROTATION_FACTOR = 1000.0
# Largest ratio of an undamped step to its standard deviation, in any direction, that means convergence in a
# curved valley. The cost falls by the square of it.
MAX_DEVIATION = 0.1
# Undamped steps that are longer than this fraction of the one before do not converge.
MIN_CREEPING_RATIO = 0.9

# Absolute value of a parameter error [m or rad] above which an iteration has diverged.
DIVERGENCE_LIMIT = 1e6

# A float for one problem, or an array of shape (b,) for b problems.
_Number = TypeVar("_Number", float, Array)


def _select(condition: Any, if_true: Any, if_false: Any) -> Any:
    """Return one of two values, elementwise if the condition is an array."""
    # A Python conditional takes 0.1 µs, np.where on floats 2 µs.
    if isinstance(condition, np.ndarray):
        return np.where(condition, if_true, if_false)
    return if_true if condition else if_false


def step_is_negligible(
    change: _Number, residual_norm: _Number, last_change: _Number, roundoff: _Number, rtol: float = STEP_RTOL
) -> Any:
    """Decide whether a step changes the whitened rows by a negligible amount."""
    # The change is below a fraction of the rows' norm, or below the rounding error of the model, or steps
    # shrink quadratically and the next change will be below that fraction.
    tolerance = rtol * residual_norm
    is_quadratic = (change < MAX_QUADRATIC_RATIO * last_change) & (
        change * change < 0.1 * tolerance * last_change
    )
    return (change <= tolerance) | is_quadratic | (change <= roundoff)


def cost_roundoff(residual_norm: _Number, roundoff: _Number) -> _Number:
    """Compute the rounding error of a cost; costs do not show whether it falls by less."""
    return (ROUNDOFF_FACTOR * roundoff) ** 2 + 2 * roundoff * residual_norm


def is_within_roundoff(
    predicted_reduction: _Number, trial_cost: _Number, residual_norm: _Number, roundoff: _Number
) -> Any:
    """Decide whether the costs before and after a step agree within rounding."""
    max_cost = (residual_norm + ROUNDOFF_FACTOR * roundoff) ** 2
    return (predicted_reduction <= cost_roundoff(residual_norm, roundoff)) & (trial_cost <= max_cost)


def gain_ratio(cost: _Number, trial_cost: _Number, predicted_reduction: _Number) -> _Number:
    """Compute the actual over the predicted reduction of the cost."""
    is_descent = predicted_reduction > 0
    return _select(is_descent, (cost - trial_cost) / _select(is_descent, predicted_reduction, 1.0), 0.0)


def is_acceptable(cost: _Number, trial_cost: _Number, gain: _Number, within_roundoff: Any) -> Any:
    """Decide whether a step is accepted."""
    return within_roundoff | ((trial_cost <= cost) & (gain > MIN_GAIN_RATIO))


def damping_after_acceptance(damping: _Number, gain: _Number, within_roundoff: Any) -> _Number:
    """Compute the damping that follows an accepted step."""
    # Clipping changes no result, and keeps the cube of a meaningless gain ratio from overflowing.
    clipped = _select(gain > 1.0, 1.0, _select(gain > 0.0, gain, 0.0))
    cubic = 1 - (2 * clipped - 1) ** 3
    factor = _select(
        within_roundoff | (gain > GOOD_GAIN_RATIO),
        GOOD_STEP_FACTOR,
        _select(cubic > MIN_DAMPING_FACTOR, cubic, MIN_DAMPING_FACTOR),
    )
    reduced = damping * factor
    return _select(reduced > MIN_DAMPING, reduced, MIN_DAMPING)


def damping_after_rejection(damping: _Number, growth: _Number) -> tuple[_Number, _Number]:
    """Compute the damping and its growth factor that follow a rejected step."""
    return damping * growth, growth * 2


def is_growing(change: float, next_change: float, roundoff: float) -> bool:
    """Decide whether undamped steps grow by more than rounding: the damping is too small for curved rows."""
    return next_change > max(change, ROUNDOFF_FACTOR * roundoff)


def extrapolation_factor(change: Array, last_change: Array) -> float:
    """Compute the further multiple of the last step that leads to the limit of slowly shrinking steps."""
    # Steps δ, ρ·δ, ρ²·δ, … end after a further ρ/(1 - ρ) of the last one (Aitken). The changes of the rows
    # (p,) by the last two steps give ρ, which is negative if the steps alternate. The factor is 0 if the
    # directions of the steps differ or convergence is fast.
    product, square = float(change @ last_change), float(last_change @ last_change)
    same_direction = MIN_SAME_DIRECTION * float(np.sqrt(square * (change @ change)))
    ratio = product / square if square else 0.0
    is_slow = abs(product) > same_direction and MIN_SLOW_RATIO < abs(ratio) < 1
    return ratio / (1 - ratio) if is_slow else 0.0


def undamped_steps_are_due(iteration: Any, last_undamped: Any) -> Any:
    """Decide whether a series of undamped steps is tried after this iteration."""
    # The first follows iteration UNDAMPED_INTERVAL; each further one, twice the iteration of the last.
    return (iteration >= UNDAMPED_INTERVAL) & (iteration >= 2 * last_undamped)


def is_slow_and_short(remaining: float, last_remaining: float) -> bool:
    """Decide whether undamped steps are short against the standard deviations, and hardly shrink."""
    # The change of the whitened rows by an undamped step is its largest ratio to a standard deviation.
    return remaining <= MAX_DEVIATION and remaining > MIN_CREEPING_RATIO * last_remaining


def has_diverged(x: Array) -> Any:
    """Decide whether parameter errors are too large to be meaningful, or not finite."""
    return ~(np.abs(x).max(-1) < DIVERGENCE_LIMIT)
