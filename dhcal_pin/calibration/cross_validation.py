"""Cross-validation: errors of held-out samples under a fit of the other samples.

The model is nearly linear around a solution x. A fold is therefore solved from two triangular systems at x
instead of a new iteration: one of its fitted rows, [R_f | z_f], and one of its held-out rows, [R_h | z_h].
With prior weights W, the step of the fit without the fold, and the error of the fold, are

    δ = argmin ‖R_f·δ - z_f‖² + ‖W·(x + δ)‖²,        error² = (‖R_h·δ - z_h‖² + ρ_h²) / m_h,

with ρ_h² the part of the held-out cost that no δ changes and m_h the number of held-out rows. If the true
cost at x + δ exceeds the cost that the linear model predicts, the model is not linear enough over δ, and
the fold is fitted by iteration.

Unknowns that only held-out samples depend on, such as a contact point, are fitted to the held-out samples.

Shapes: p unknowns, c columns (unknowns that are free), m samples of a measurement, k folds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import lstsq

from .._typing import Array
from ..estimation import qr
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.qr import TriangularSystem
from ..exceptions import InvalidArgumentError
from ..measurements.base import Measurement
from .evaluation import Accuracy, compute_errors
from .partition import Fold, blocked_folds, contact_groups

if TYPE_CHECKING:
    from .result import Result

# A fold is fitted by iteration if its cost exceeds that of the linear model by more than this fraction of the
# mean cost of a fitted sample.
_NONLINEARITY_TOL = 1e-3

# Function that returns the solution x (p,) of a problem with some of the samples.
Refit = Callable[[Problem], Array]


@dataclass(frozen=True, eq=False)
class FoldSystems:
    """Triangular systems of the fitted and of the held-out samples of a fold, at one x.

    Attributes:
        fitted: System of the fitted rows.
        held_out: System of the held-out rows.
        n_rows: Number of held-out rows.
    """

    fitted: TriangularSystem
    held_out: TriangularSystem
    n_rows: int

    @property
    def is_unobserved(self) -> Array:
        """Unknowns that no fitted row depends on, such as a point that only held-out samples touch, (p,)."""
        return np.logical_not(self.fitted.r.any(0))

    def error(self, weights: Array, x: Array, columns: Array) -> float:
        """Compute the RMS of the held-out whitened rows under the fit of the other rows.

        Unknowns that only the held-out rows depend on are fitted to these.

        Args:
            weights: One over the prior standard deviations of the unknowns, (p,).
            x: Point of the linearization, (p,).
            columns: Mask of the unknowns that are fitted, (p,).

        Returns:
            The RMS in standard deviations.
        """
        step, _ = solve_columns(self.fitted, weights, x, columns)
        held_out = self.held_out.r[:, columns]
        residual = self.held_out.z - held_out @ step
        own = self.is_unobserved[columns] & held_out.any(0)
        if own.any():
            basis = np.linalg.qr(held_out[:, own])[0]
            residual = residual - basis @ (basis.T @ residual)
        return float(np.sqrt((residual @ residual + self.held_out.min_cost) / self.n_rows))


def solve_columns(system: TriangularSystem, weights: Array, x: Array, columns: Array) -> tuple[Array, float]:
    """Solve a triangular system with priors for some of the unknowns.

    Directions that neither rows nor priors determine return to 0, as x may contain information on them from
    held-out rows.

    Args:
        system: System at x.
        weights: One over the prior standard deviations of the unknowns, (p,); 0 without a prior.
        x: Point of the linearization, (p,).
        columns: Mask of the c unknowns that are fitted, (p,).

    Returns:
        The step, (c,), and the cost of rows and priors after it.
    """
    prior = weights[columns]
    a = np.concatenate([system.r[:, columns], np.diag(prior)])
    b = np.concatenate([system.z, -prior * x[columns]])
    solution = lstsq(a, b, lapack_driver="gelsy", check_finite=False)
    assert solution is not None
    step = solution[0]
    if not prior.all():
        _, s, vt = np.linalg.svd(a)
        null_space = vt[s <= qr.RANK_RTOL * s[0]]
        step = step - null_space.T @ (null_space @ (x[columns] + step))
    return step, system.min_cost + float(np.sum((a @ step - b) ** 2))


def count_rows(problem: Problem) -> int:
    """Return the number of whitened rows of a problem."""
    return sum(item.residual_dim * len(item.rows) for item in problem.data)


def factor_folds(
    problem: Problem, x: Array, folds: Sequence[Fold], progress: Callable[[int, float], None] | None = None
) -> tuple[FoldSystems, ...]:
    """Compute the triangular systems of each fold.

    Args:
        problem: Problem with the samples of all folds.
        x: Point of the linearization, (p,).
        folds: Folds of its measurements.
        progress: Called after each fold with the number of folds done and the fold's cost.

    Returns:
        The systems of each fold.
    """
    systems = []
    for fold in folds:
        systems.append(_divide(problem, x, fold)[1])
        if progress:
            progress(len(systems), systems[-1].fitted.min_cost)
    return tuple(systems)


def _divide(problem: Problem, x: Array, fold: Fold) -> tuple[Problem, FoldSystems]:
    """Return the problem of the fitted samples of a fold, and the fold's systems at x (p,)."""
    fitted, held_out = (
        problem.with_data([item.take(mask) for item, mask in zip(problem.data, masks, strict=True)])
        for masks in ([~mask for mask in fold], fold)
    )
    fitted_system = linearize_and_factor(fitted, x, small_angle=False)
    held_out_system = linearize_and_factor(held_out, x, small_angle=False)
    return fitted, FoldSystems(fitted_system, held_out_system, count_rows(held_out))


def _solve_fold(fitted: Problem, systems: FoldSystems, x: Array, columns: Array, refit: Refit) -> Array:
    """Solve a fold by one step from x (p,) in the free columns, or by iteration if that is not enough."""
    candidate = x.copy()
    step, cost = solve_columns(systems.fitted, fitted.weights, x, columns)
    candidate[columns] += step
    cost += float(np.sum((fitted.weights * x)[~columns] ** 2))
    n_samples = sum(len(item.rows) for item in fitted.data)
    if fitted.cost(candidate) <= cost + _NONLINEARITY_TOL * cost / max(1, n_samples):
        return candidate
    return refit(fitted)


def cross_validate_folds(
    problem: Problem,
    x: Array,
    data: Sequence[Measurement],
    folds: Sequence[Fold],
    refit: Refit,
    shrinkage_factor: float = 1.0,
) -> Iterator[tuple[list[dict[str, Array]], float]]:
    """Generate the errors of the held-out samples of each fold.

    Args:
        problem: Problem that was solved.
        x: Its solution, (p,).
        data: Fitted measurements without robust weights, whose errors are computed.
        folds: Folds of these measurements.
        refit: Fit of a part of the samples, for folds that one step from x does not solve.
        shrinkage_factor: Factor to the solution of each fold.

    Yields:
        Errors of the held-out samples of each measurement, as from `compute_errors`, and their RMS in
        standard deviations.

    Raises:
        InvalidArgumentError: If the folds were made for other data.
    """
    sizes = [len(item.rows) for item in data]
    if any([len(mask) for mask in fold] != sizes for fold in folds):
        raise InvalidArgumentError(
            f"folds were made for other data; expected masks of {', '.join(map(str, sizes))} samples"
        )
    columns, robot = problem.is_interior(x), len(problem.errors.parameters)
    for fold in folds:
        fitted, systems = _divide(problem, x, fold)
        solution = shrinkage_factor * _solve_fold(fitted, systems, x, columns, refit)
        unobserved = {
            parameter.name
            for parameter, is_unobserved in zip(
                problem.instrument_parameters, systems.is_unobserved[robot:], strict=True
            )
            if is_unobserved
        }
        known = {name: v for name, v in problem.instruments(solution).items() if name not in unobserved}
        held_out = [item.take(mask) for item, mask in zip(data, fold, strict=True) if mask.any()]
        errors = compute_errors(problem.errors.at(solution[:robot]), held_out, known)
        yield errors, systems.error(problem.weights, x, columns)


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors of held-out samples.

    Attributes:
        folds: Accuracy of the held-out samples of each fold.
        errors: RMS of the held-out rows of each fold in standard deviations, (k,).
        accuracy: Accuracy of the held-out samples of all folds together.
    """

    folds: tuple[Accuracy, ...]
    errors: Array
    accuracy: Accuracy


def standard_error(values: Array) -> float:
    """Compute the standard error of a mean, widened for few values by Student's t distribution.

    Args:
        values: Values, (k,).

    Returns:
        Half width of the interval that contains the mean as often as one standard deviation of a normal
        distribution; infinite for one value.
    """
    if len(values) < 2:
        return np.inf
    from scipy.special import ndtr, stdtrit  # lazy import: slow, and few calibrations need it

    return float(stdtrit(len(values) - 1, ndtr(1.0)) * values.std(ddof=1) / np.sqrt(len(values)))


def cross_validate(fit: Result, folds: Sequence[Fold] | None = None) -> CrossValidation:
    """Measure how well the model of a calibration predicts samples that it is not fitted to.

    Standard deviations, weights and priors are those of the calibration.

    Args:
        fit: Result of a calibration.
        folds: Folds of `fit.data` from `k_fold`, `leave_one_group_out` or `blocked_folds`; the last one
            with the contacts of the measurements if not given.

    Returns:
        Errors of the held-out samples.
    """
    if folds is None:
        folds = blocked_folds(fit.data, groups=contact_groups(fit.problem, fit.x))
    results = list(cross_validate_folds(fit.problem, fit.solution.x, fit.data, folds, fit.refit))
    return CrossValidation(
        tuple(Accuracy.from_errors(errors) for errors, _ in results),
        np.array([error for _, error in results]),
        Accuracy.from_errors([item for errors, _ in results for item in errors]),
    )
