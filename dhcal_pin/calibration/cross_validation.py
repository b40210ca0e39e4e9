"""Samples left out of a fit, and what the fit to the others says of them.

The model is nearly linear around a fit, so a fold is solved from two triangles: that of its fitted rows and
that of its left-out rows. Where few samples make a fold's fit quite another one, its cost tells, and it is
fitted again.
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
from ..exceptions import DhcalError
from ..measurements.base import Measurement
from .evaluation import Accuracy, compute_errors
from .partition import Fold, blocked_folds, contact_groups

if TYPE_CHECKING:
    from .result import Result

# A fold's fit may cost more than its triangle foretells by this share of one fitted sample's cost.
_NONLINEARITY_TOL = 1e-3


# Where a fit of a problem ends (p,).
Refit = Callable[[Problem], Array]


@dataclass(frozen=True, eq=False)
class FoldSystems:
    """A fold's triangles around one x: of what it fits and of what it leaves out, and the latter's rows."""

    fitted: TriangularSystem
    held_out: TriangularSystem
    n_rows: int

    @property
    def unobserved(self) -> Array:
        """Columns (p,) that the fitted rows do not depend on, such as a point that was touched elsewhere."""
        return np.logical_not(self.fitted.r.any(0))

    def error(self, weights: Array, x: Array, columns: Array) -> float:
        """RMS of the left-out whitened rows after a fit of some columns (p,) with priors of weights about 0.

        What only the left-out rows depend on is fitted to them.
        """
        step, _ = solve_columns(self.fitted, weights, x, columns)
        own = self.held_out.r[:, columns]
        rest = self.held_out.z - own @ step
        alone = self.unobserved[columns] & own.any(0)
        if alone.any():
            basis = np.linalg.qr(own[:, alone])[0]
            rest = rest - basis @ (basis.T @ rest)
        return float(np.sqrt((rest @ rest + self.held_out.min_cost) / self.n_rows))


def solve_columns(
    triangle: TriangularSystem, weights: Array, x: Array, columns: Array
) -> tuple[Array, float]:
    """The step (c,) of the columns that count (p,) with priors of weights (p,) about 0, and its cost.

    What neither rows nor priors tell goes back to 0, as x may have it from rows that are left out.
    """
    held = weights[columns]
    a = np.concatenate([triangle.r[:, columns], np.diag(held)])
    b = np.concatenate([triangle.z, -held * x[columns]])
    found = lstsq(a, b, lapack_driver="gelsy", check_finite=False)
    assert found is not None
    step = found[0]
    if not held.all():
        _, s, vt = np.linalg.svd(a)
        untold = vt[s <= qr.RANK_RTOL * s[0]]
        step = step - untold.T @ (untold @ (x[columns] + step))
    return step, triangle.min_cost + float(np.sum((a @ step - b) ** 2))


def count_rows(problem: Problem) -> int:
    """Number of whitened rows."""
    return sum(item.residual_dim * len(item.rows) for item in problem.data)


def factor_folds(
    problem: Problem, x: Array, folds: Sequence[Fold], progress: Callable[[int, float], None] | None = None
) -> tuple[FoldSystems, ...]:
    """Each fold's triangles around x (p,)."""
    found = []
    for fold in folds:
        found.append(_split(problem, x, fold)[1])
        if progress:
            progress(len(found), found[-1].fitted.min_cost)
    return tuple(found)


def _split(problem: Problem, x: Array, fold: Fold) -> tuple[Problem, FoldSystems]:
    """The problem of what a fold fits, and the fold's triangles around x (p,)."""
    kept, left = (
        problem.with_data([item.take(side) for item, side in zip(problem.data, sides, strict=True)])
        for sides in ([~mask for mask in fold], fold)
    )
    inside = linearize_and_factor(kept, x, small_angle=False)
    return kept, FoldSystems(inside, linearize_and_factor(left, x, small_angle=False), count_rows(left))


def _refit_estimate(kept: Problem, part: FoldSystems, x: Array, columns: Array, refit: Refit) -> Array:
    """Where the fit of what a fold keeps ends (p,), from the fit of all at x with its free columns."""
    moved = x.copy()
    step, cost = solve_columns(part.fitted, kept.weights, x, columns)
    moved[columns] += step
    cost += float(np.sum((kept.weights * x)[~columns] ** 2))
    samples = sum(len(item.rows) for item in kept.data)
    # One step is all where the model is as straight as its triangle.
    if kept.cost(moved) <= cost + _NONLINEARITY_TOL * cost / max(1, samples):
        return moved
    return refit(kept)


def cross_validate_folds(
    problem: Problem,
    x: Array,
    data: Sequence[Measurement],
    folds: Sequence[Fold],
    refit: Refit,
    shrinkage_factor: float = 1.0,
) -> Iterator[tuple[list[dict[str, Array]], float]]:
    """For each fold the deviations of its left-out samples, and their RMS in standard deviations.

    Args:
        problem: as it was fitted.
        x: (p,) where it ended.
        data: the fitted measurements, whose samples are judged.
        folds: made for them.
        refit: the same fit of some of its samples, where one step from x does not reach it.
        shrinkage_factor: of each fold's x that its samples are judged by.

    Raises:
        DhcalError: folds that were made for other data.
    """
    sizes = [len(item.rows) for item in data]
    if any([len(mask) for mask in fold] != sizes for fold in folds):
        raise DhcalError(f"folds were made for other data; {len(sizes)} measurements have {sizes} samples")
    columns, robot = problem.is_interior(x), len(problem.errors.parameters)
    for fold in folds:
        kept, part = _split(problem, x, fold)
        moved = shrinkage_factor * _refit_estimate(kept, part, x, columns, refit)
        unseen = {
            u.name
            for u, alone in zip(problem.instrument_parameters, part.unobserved[robot:], strict=True)
            if alone
        }
        known = {name: value for name, value in problem.instruments(moved).items() if name not in unseen}
        left = [item.take(mask) for item, mask in zip(data, fold, strict=True) if mask.any()]
        found = compute_errors(problem.errors.at(moved[:robot]), left, known)
        yield found, part.error(problem.weights, x, columns)


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors on what was left out.

    Attributes:
        folds: of each fold what `accuracy` says of its left-out samples, m and rad.
        errors: (k,) RMS of each fold's left-out rows in standard deviations as the fit used them.
        accuracy: the same as a fold's, of all folds' samples together.
    """

    folds: tuple[Accuracy, ...]
    errors: Array
    accuracy: Accuracy


def standard_error(values: Array) -> float:
    """Standard error of the mean of values (k,), as wide as Student's t makes few; infinite for one."""
    if len(values) < 2:
        return np.inf
    from scipy.special import (  # a good part of the start-up, and few fits need it
        ndtr,
        stdtrit,
    )

    return float(stdtrit(len(values) - 1, ndtr(1.0)) * values.std(ddof=1) / np.sqrt(len(values)))


def cross_validate(fit: Result, folds: Sequence[Fold] | None = None) -> CrossValidation:
    """How well a result's model predicts what it is not fitted to.

    Args:
        fit: a calibration; its sigmas, weights and priors are kept.
        folds: of `k_fold`, `leave_one_group_out` or `blocked_folds`; the last without it.

    Raises:
        DhcalError: folds that were not made for the fitted data.
    """
    if folds is None:
        folds = blocked_folds(fit.data, groups=contact_groups(fit.problem, fit.x))
    judged = list(cross_validate_folds(fit.problem, fit.solution.x, fit.data, folds, fit.refit))
    every = [item for found, _ in judged for item in found]
    return CrossValidation(
        tuple(Accuracy.from_errors(found) for found, _ in judged),
        np.array([error for _, error in judged]),
        Accuracy.from_errors(every),
    )
