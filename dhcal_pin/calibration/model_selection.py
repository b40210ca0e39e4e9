"""Model selection: which families of joint errors the measurements support.

Forward selection by cross-validation. A family is a set of parameters that describe one physical cause,
such as `harmonics` for gear eccentricity. In each round every remaining family is tried on top of those
selected before. The family with the lowest cross-validated error is added if

1. the error of held-out regions of joint space, e_k for fold k, falls by more than the standard error of
   its mean change and by more than 1 %;
2. an F-test on all data rejects that the family has no effect:

       F = ((C_0 - C_1)/q) / (C_1/(m - p - q)),    P(F_{q, m-p-q} > F) < 0.01,

   with C_0, C_1 the costs without and with the q parameters of the family, m rows and p other parameters.

Cross-validation also selects the width of the family's priors: the narrowest one whose error is within one
standard error of the lowest (the "one standard error rule"). A family that extrapolates badly under wide
priors may be useful under narrow ones.

All trials use one linearization of the model around the fit without extensions, with columns for all
families. The selected families are then identified together with the geometry, as both share directions of
parameter space.

Shapes: p unknowns of the robot with all families and of the instruments, k folds.

References:
    L. Breiman, J. Friedman, R. Olshen and C. Stone, Classification and Regression Trees, Wadsworth 1984.
    B. Laurent and P. Massart, Adaptive Estimation of a Quadratic Functional, Annals of Statistics 28, 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._typing import Array
from ..estimation.error_model import ErrorParameter
from ..estimation.parameters import EXTENSIONS, PARAMETER_SETS
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.qr import TriangularSystem
from ..estimation.solver import Progress
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..formatting import Table, format_fixed
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..robot.error_families import FAMILIES
from .arguments import require_chain
from .cross_validation import (
    FoldSystems,
    count_rows,
    factor_folds,
    solve_columns,
    standard_error,
)
from .partition import blocked_folds, contact_groups
from .procedure import calibrate
from .result import Result

# Widths of a family's priors that are tried, as fractions of the default ones.
PRIOR_WIDTHS = (1.0, 0.3, 0.1, 0.03)
# Smallest relative improvement of the cross-validated error for which a family is added.
MIN_IMPROVEMENT = 0.01
# Largest p-value of the F-test for which a family is added.
MAX_P_VALUE = 0.01
# Largest ratio of the errors with and without a family for which a hint is given.
MAX_HINT_RATIO = 0.9
# Smallest number of rows that must remain per parameter of a family for a hint.
MIN_ROWS_PER_PARAMETER = 5
# Largest number of samples of each measurement that a hint is computed from.
MAX_HINT_SAMPLES = 500
# Negative logarithm of the largest p-value for which a hint is given: one in a million.
HINT_LOG_P = 14
# Smaller p-values are shown as "< 1e-06".
MIN_SHOWN_P_VALUE = 1e-6

# All parameters that positions and poses can determine, wherever instrument and target are.
FULL_SET = "minimal,base,tool"


@dataclass(frozen=True)
class FamilyTrial:
    """Effect of a family on top of those selected before it.

    Attributes:
        family: Name of the family, one of `estimation.EXTENSIONS`.
        cv_before: Cross-validated error without the family, in standard deviations.
        cv_after: Cross-validated error with it, in standard deviations.
        standard_error: Standard error of the difference.
        p_value: Probability that chance alone lowers the cost of all data as much.
        prior_width: Width of its priors as a fraction of the default one.
        is_selected: Whether it was added.
    """

    family: str
    cv_before: float
    cv_after: float
    standard_error: float
    p_value: float
    prior_width: float
    is_selected: bool = False

    @property
    def is_significant(self) -> bool:
        """Whether the measurements support the family."""
        reduction = self.cv_before - self.cv_after
        return (
            reduction > max(self.standard_error, MIN_IMPROVEMENT * self.cv_before)
            and self.p_value < MAX_P_VALUE
        )


def trial_table(trials: Sequence[FamilyTrial]) -> Table:
    """Make a table of the effect of each family on the cross-validated error.

    Args:
        trials: Trials of a selection.

    Returns:
        Table with one row per family.
    """
    header = ["family", "verdict", "before", "after"]
    header += ["standard error of the change", "p-value", "prior width"]
    rows = [
        [
            trial.family,
            "added" if trial.is_selected else "not selected",
            format_fixed(trial.cv_before, 3),
            format_fixed(trial.cv_after, 3),
            format_fixed(trial.standard_error, 3),
            f"{trial.p_value:.1g}" if trial.p_value > MIN_SHOWN_P_VALUE else f"< {MIN_SHOWN_P_VALUE:g}",
            f"{trial.prior_width:g} of default",
        ]
        for trial in trials
    ]
    return Table(header, rows, n_text_columns=2)


@dataclass(frozen=True, eq=False)
class _LinearizedFit:
    """Linear model around a fit without extensions, with columns for all families.

    Attributes:
        problem: Problem with the parameters and default priors of all families.
        system: Triangular system of all its data.
        x: Point of the linearization, (p,).
        family: Name of the family of each unknown, "" for the unknowns of the fit, (p,).
        folds: Triangular systems of the folds.
    """

    problem: Problem
    system: TriangularSystem
    x: Array
    family: Array
    folds: tuple[FoldSystems, ...] = ()

    def weights_and_columns(self, selected: dict[str, float]) -> tuple[Array, Array]:
        """Return prior weights (p,) and mask of the columns (p,) with families of these prior widths."""
        width = np.array([selected.get(name, 1.0) for name in self.family])
        return self.problem.weights / width, (self.family == "") | np.isin(self.family, list(selected))

    def errors(self, selected: dict[str, float]) -> Array:
        """Compute the held-out error of each fold, (k,), with families of these prior widths."""
        weights, columns = self.weights_and_columns(selected)
        return np.array([fold.error(weights, self.x, columns) for fold in self.folds])

    def cost(self, selected: dict[str, float]) -> float:
        """Compute the lowest cost of all data and priors with families of these prior widths."""
        weights, columns = self.weights_and_columns(selected)
        return solve_columns(self.system, weights, self.x, columns)[1]

    def degrees_of_freedom(self, name: str, selected: dict[str, float]) -> tuple[int, int]:
        """Return the number of parameters that a family adds, and the number of rows that remain."""
        added = int(np.sum(self.family == name))
        return added, count_rows(self.problem) - int(np.sum(self.weights_and_columns(selected)[1])) - added

    def trial(self, name: str, selected: dict[str, float]) -> FamilyTrial:
        """Try a family on top of the selected ones."""
        before = self.errors(selected)
        tried = [(self.errors(selected | {name: width}), width) for width in PRIOR_WIDTHS]
        best = min((errors for errors, _ in tried), key=np.mean)
        # One standard error rule, from the narrowest width on.
        after, width = next(
            (errors, width)
            for errors, width in reversed(tried)
            if np.mean(errors - best) <= standard_error(errors - best)
        )
        added, remaining = self.degrees_of_freedom(name, selected)
        cost_before, cost_after = self.cost(selected), self.cost(selected | {name: 1.0})
        p_value = 1.0
        if remaining > 0 and cost_after > 0:
            from scipy.special import fdtrc  # lazy import: slow, and few calibrations need it

            f = (cost_before - cost_after) / added / (cost_after / remaining)
            p_value = float(fdtrc(added, remaining, f))
        error = standard_error(before - after)
        return FamilyTrial(name, float(before.mean()), float(after.mean()), error, p_value, width)


def _missing_parameters(fit: Result, families: Sequence[str]) -> dict[str, list[ErrorParameter]]:
    """Return the parameters of each family that has some which the fit does not have."""
    identified = {p.name for p in fit.errors.parameters}
    by_family = {name: PARAMETER_SETS[name](fit.errors.chain) for name in families}
    return {name: ps for name, ps in by_family.items() if any(p.name not in identified for p in ps)}


def _linearize_fit(
    fit: Result, data: Sequence[Measurement], families: dict[str, list[ErrorParameter]]
) -> _LinearizedFit:
    """Linearize a fit on some of its data with the parameters of families, without folds."""
    identified = {p.name for p in fit.errors.parameters}
    added = [p for parameters in families.values() for p in parameters if p.name not in identified]
    errors = fit.errors.with_parameters(added)
    robot = len(fit.errors.parameters)
    names = [p.name for p in fit.errors.parameters]
    # x and prior weight of each identified parameter; the others start from 0 with their default priors.
    start = dict(zip(names, zip(fit.x[:robot], fit.problem.weights[:robot], strict=True), strict=True))
    values = [start.get(p.name, (0.0, 1 / p.prior)) for p in errors.parameters]
    x = np.array([*(value for value, _ in values), *fit.x[robot:]])
    weights = np.array([*(weight for _, weight in values), *fit.problem.weights[robot:]])
    family_of = {
        p.name: name for name, parameters in families.items() for p in parameters if p.name not in identified
    }
    problem = replace(fit.problem, errors=errors, weights=weights, data=tuple(data))
    return _LinearizedFit(
        problem,
        linearize_and_factor(problem, x, small_angle=False),
        x,
        np.array([family_of.get(p.name, "") for p in errors.parameters] + [""] * len(fit.x[robot:])),
    )


def select_error_families(
    fit: Result, families: Sequence[str] = EXTENSIONS, progress: Progress | None = None
) -> tuple[FamilyTrial, ...]:
    """Select the families of joint errors that lower the cross-validated error, one after the other.

    Args:
        fit: Calibration without them, by method "lm" and with priors.
        families: Names of `estimation.EXTENSIONS` to try; those without a parameter on this robot are
            skipped.
        progress: Called after each fold with the number of folds done and the cost.

    Returns:
        Trials of the selected families in the order of selection, then trials of the others on top of those.

    Raises:
        UnknownNameError: If a family is unknown.
    """
    if unknown := [name for name in families if name not in EXTENSIONS]:
        raise UnknownNameError(
            f"unknown extension {unknown[0]!r}; choose from {', '.join(EXTENSIONS)}, or auto or none"
        )
    candidates = _missing_parameters(fit, families)
    if not candidates:
        return ()
    model = _linearize_fit(fit, fit.problem.data, candidates)
    folds = blocked_folds(model.problem.data, groups=contact_groups(model.problem, model.x))
    model = replace(model, folds=factor_folds(model.problem, model.x, folds, progress))
    selected: dict[str, float] = {}
    selected_trials: list[FamilyTrial] = []
    while True:
        trials = [model.trial(name, selected) for name in candidates if name not in selected]
        significant = [trial for trial in trials if trial.is_significant]
        if not significant:
            return (*selected_trials, *trials)
        best = min(significant, key=lambda trial: trial.cv_after)
        selected[best.family] = best.prior_width
        selected_trials.append(replace(best, is_selected=True))


def family_hint(fit: Result) -> str:
    """Suggest an extension if one family explains a significant part of the residuals.

    The hint is computed from a linearization around the fit and at most `MAX_HINT_SAMPLES` samples of each
    measurement. It requires a change of the cost that chance causes less than once in a million fits, by
    the bound P(χ²_q > q + 2·sqrt(q·t) + 2·t) <= exp(-t) of Laurent and Massart (2000).

    Args:
        fit: Calibration by method "lm" and with priors.

    Returns:
        One sentence; empty without a significant family.
    """
    data = [item.take(np.s_[:: max(1, -(-len(item.rows) // MAX_HINT_SAMPLES))]) for item in fit.problem.data]
    candidates = _missing_parameters(fit, EXTENSIONS)
    model = _linearize_fit(fit, data, candidates)
    cost_before, best = model.cost({}), (MAX_HINT_RATIO, "")
    for name in candidates:
        added, remaining = model.degrees_of_freedom(name, {})
        cost_after = model.cost({name: 1.0})
        if remaining < MIN_ROWS_PER_PARAMETER * added or not cost_after > 0:
            continue
        threshold = added + 2 * np.sqrt(HINT_LOG_P * added) + 2 * HINT_LOG_P
        if (cost_before - cost_after) / (cost_after / remaining) > threshold:
            ratio = float(np.sqrt(cost_after / remaining / (cost_before / (remaining + added))))
            best = min(best, (ratio, name))
    ratio, name = best
    return name and (
        f"residuals vary with the joint values ({FAMILIES[name].description}?); "
        f"--extend auto may reduce them by about {100 * (1 - ratio):.0f} %"
    )


def extend(
    chain: Chain,
    data: Measurement | Sequence[Measurement],
    parameters: str | None = None,
    families: Sequence[str] = EXTENSIONS,
    **options: Any,
) -> tuple[Result, tuple[FamilyTrial, ...]]:
    """Calibrate with those families of joint errors that the measurements support.

    Args:
        chain: Nominal robot.
        data: One measurement or several of any kinds.
        parameters: Names of parameter sets, separated by commas; the chain's own default set if not given.
        families: Names of `estimation.EXTENSIONS` that may be added.
        **options: Keyword arguments of `calibrate`; method "lm" and priors are required.

    Returns:
        Result with the selected families, and the trials of all families.

    Raises:
        InvalidArgumentError: If the method is not "lm" or there are no priors.
    """
    require_chain(chain)
    priors = options.get("priors") or "default"
    if families and (options.get("method", "lm") != "lm" or priors == "none"):
        raise InvalidArgumentError(
            "an extension requires method lm and priors; leave out --method gn and --priors none"
        )
    parameters = chain.parameters if parameters is None else parameters
    fit = calibrate(chain, data, parameters, **options)
    trials = select_error_families(fit, families, options.get("progress"))
    widths = {trial.family: trial.prior_width for trial in trials if trial.is_selected}
    if not widths:
        return fit, trials
    narrowed = {
        p.name: p.prior * width for name, width in widths.items() for p in PARAMETER_SETS[name](chain)
    }
    stated = {} if isinstance(priors, str) else dict(priors)
    options["priors"] = narrowed | stated
    return calibrate(chain, data, ",".join([parameters, *widths]), **options), trials


def is_restricted(sets: Sequence[str]) -> bool:
    """Check whether parameter sets describe the robot, but fewer of its errors than `FULL_SET`.

    Args:
        sets: Names of parameter sets.

    Returns:
        Whether the full set has parameters that these sets lack.
    """
    frames = {"base", "tool"}
    is_full = frames <= set(sets) and {"minimal", "placement"} & set(sets)
    return not is_full and not set(sets) <= frames
