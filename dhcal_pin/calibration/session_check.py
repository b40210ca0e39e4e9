"""Confirmation of changes during a session by a model with all joint errors.

Errors that the geometry leaves, such as gear errors, differ between configurations. If the configurations at
the begin of a session differ from those at its end, such errors look like a change. The changes are therefore
kept only if the measurements support them beside all families of joint errors, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from .._typing import Array
from ..estimation.solver import minimize
from ..session import Session
from ..session.causes import Step
from ..session.robot_changes import RobotChanges
from ..session.search import MAX_SAMPLE_COST, MIN_EFFECT, MIN_LOG_EVIDENCE, MIN_NOISE
from .reweighting import Fit

# Logarithm of the evidence that each coefficient of a change costs.
COST_PER_COEFFICIENT = 5.0
# Largest number of iterations of the fit of changes and joint errors.
MAX_ITERATIONS = 20
# Ratio of the noise without changes to that with them above which no comparison with joint errors is needed.
MIN_GROSS_RATIO = 10.0


def confirm_changes(session: Session, without: Fit, fit: Fit, extended: Callable[[Fit], Fit]) -> bool:
    """Return whether changes explain measurements beside all families of joint errors.

    `without` and `fit` are the first fits without and with the changes; `extended` adds all families of joint
    errors that the measurements support without the changes. They are fitted to both. Joint errors do not
    imitate changes that are far larger than what they leave.
    """
    noises = [_noise(_residuals(each)) for each in (without, fit)]
    if max(np.max(a / b) for a, b in zip(*noises, strict=True)) > MIN_GROSS_RATIO:
        return True
    unchanged = extended(without)
    timeline = session.timeline
    fitted, _ = session.applied(unchanged.problem.data, timeline.data[timeline.n_fitted :])
    problem = unchanged.problem.with_data(fitted)
    solution = minimize(problem, "lm", unchanged.solution.x, MAX_ITERATIONS, loose=True)
    changed = replace(unchanged, data=fit.data, problem=problem, solution=solution)
    residuals = [_residuals(each) for each in (unchanged, changed)]
    noise = _noise(residuals[1])
    costs = [
        sum(
            float(np.sum(np.minimum(np.sum((r / s) ** 2, 0), len(r) + MAX_SAMPLE_COST)))
            for r, s in zip(each, noise, strict=True)
        )
        for each in residuals
    ]
    gain, n_rows = costs[0] - costs[1], sum(r.size for r in residuals[1])
    changes = [cause for cause in session.causes if not cause.block.is_constant]
    n_coefficients = sum(len(cause.values) for cause in changes)
    numbers = session.timeline.fitted_numbers
    shares = [np.mean(numbers < c.shape.number) for c in changes if isinstance(c.shape, Step)]
    share = min([1.0, *(min(each, 1 - each) for each in shares)])
    needed = 2 * (MIN_LOG_EVIDENCE + COST_PER_COEFFICIENT * n_coefficients)
    return bool(gain > max(needed, MIN_EFFECT**2 * n_rows * share))


def _noise(residuals: Sequence[Array]) -> list[Array]:
    """Estimate the noise of each row of residuals (k, m) each, (k, 1) each."""
    return [np.maximum(1.4826 * np.median(np.abs(r), 1, keepdims=True), MIN_NOISE) for r in residuals]


def _residuals(fit: Fit) -> Sequence[Array]:
    """Return the residuals of a fit, (k, m) each."""
    problem, x = fit.problem, fit.solution.x
    chain = problem.errors.at(x[: len(problem.errors.parameters)])
    return [
        item.residual(chain.forward_kinematics(item.conditions()), problem.instrument_values_of(item, x))
        for item in fit.data
    ]


def without_changes(session: Session) -> Session:
    """Return a session in which nothing changed."""
    kept = tuple(cause for cause in session.causes if cause.block.is_constant)
    return replace(session, changes=RobotChanges(), causes=kept, events=(), drifts=())
