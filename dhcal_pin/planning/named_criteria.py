"""Criteria that users select by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import UnknownNameError
from ..robot.error_families import COMPLIANCE, GAIN, HARMONICS
from .criteria import AOptimality, BiasVarianceCriterion, Criterion, DOptimality, EOptimality
from .information import Information

# Part of the task, relative to its norm, that may be unobservable.
UNOBSERVABLE_RTOL = 1e-6


def _robust_criterion(
    observable: Array, combinations: Array, full_information: Information, task_q: Array
) -> Criterion:
    """Create the criterion of bias and variance over a task; of the variance if no unknown is omitted."""
    fitted = full_information.fitted
    if fitted.all():
        return AOptimality(combinations)
    all_combinations = full_information.task_combinations(task_q)
    fitted_combinations = observable.T @ (observable @ all_combinations[fitted])
    # Displacements over the task that a fit can produce, and their share of the effect of the omitted
    # unknowns.
    displacements, std, _ = np.linalg.svd(fitted_combinations.T, full_matrices=False)
    displacements = displacements[:, std > UNOBSERVABLE_RTOL * std[0]]
    return BiasVarianceCriterion(
        fitted, fitted_combinations @ displacements, displacements.T @ all_combinations[~fitted].T
    )


@frozen
class CriterionOption:
    """Criterion that users select by name."""

    # Function from observable directions (r, p), observable combinations of the task (p, w), knowledge and
    # joint positions of the task (t, n) to the criterion.
    create: Callable[[Array, Array, Information, Array], Criterion]
    help: str  # One line for help texts
    # Parameter sets whose effects the fit omits and the criterion considers. The joint positions then scatter
    # in addition to the noise.
    omitted_sets: tuple[str, ...] = ()


# Criterion that fills the bins of the joints evenly before another one decides.
FILLS_BINS = "curves"

CRITERIA: dict[str, CriterionOption] = {
    "D": CriterionOption(
        lambda observable, combinations, full_information, task_q: DOptimality(),
        "volume of the confidence ellipsoid of all parameters",
    ),
    "A": CriterionOption(
        lambda observable, combinations, full_information, task_q: AOptimality(observable.T),
        "mean variance of the parameters",
    ),
    "E": CriterionOption(
        lambda observable, combinations, full_information, task_q: EOptimality(observable),
        "largest variance of any combination of parameters",
    ),
    "task": CriterionOption(
        lambda observable, combinations, full_information, task_q: AOptimality(combinations),
        "mean position error over the task",
    ),
    "robust": CriterionOption(
        _robust_criterion,
        "as `task`, and also limits the bias from unmodelled effects",
        (GAIN, HARMONICS, COMPLIANCE),
    ),
    FILLS_BINS: CriterionOption(
        lambda observable, combinations, full_information, task_q: DOptimality(),
        "fills each joint's bins of 5° evenly, for joint correction curves; then as `D`, or as another "
        "criterion in `curves,task`",
    ),
}


def parse_criterion(text: str) -> tuple[CriterionOption, bool]:
    """Return the criterion of a name, or of two joined by a comma, and whether it fills bins first."""
    names = text.split(",")
    main = [name for name in names if name != FILLS_BINS] or [FILLS_BINS]
    if len(names) > 2 or len(main) > 1 or main[0] not in CRITERIA:
        raise UnknownNameError(
            f"unknown criterion {text!r}; choose from {', '.join(CRITERIA)}, or combine {FILLS_BINS} with "
            f"another one as in {FILLS_BINS},task"
        )
    return CRITERIA[main[0]], FILLS_BINS in names
