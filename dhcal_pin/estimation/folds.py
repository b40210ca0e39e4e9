"""Folds: fits of a part of the samples, and the errors of the others, from triangular systems at one x.

The model is nearly linear around a solution x. A fold is therefore solved from two triangular systems at x
instead of a new iteration: one of its fitted rows, [R_f | z_f], and one of its held-out rows, [R_h | z_h].
With prior weights W, the step of the fit without the fold, and the error of the fold, are

    δ = argmin ‖R_f·δ - z_f‖² + ‖W·(x + δ)‖²,        error² = (‖R_h·δ - z_h‖² + ρ_h²) / m_h,

with ρ_h² the part of the held-out cost that no δ changes and m_h the number of held-out rows. If the true
cost at x + δ exceeds the cost that the linear model predicts, the model is not linear enough over δ, and
the fold is fitted by iteration.

Shapes: p unknowns, c columns (unknowns that are free), m samples of a measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq

from .._typing import Array
from . import qr
from .normal_equations import NormalEquations
from .problem import Problem, linearize_and_factor, normal_equations, uses_normal_equations
from .qr import TriangularSystem, merge_r_factors

# Mask of the held-out samples (m,) of each measurement.
Fold = tuple[Array, ...]
# Function that returns the solution x (p,) of a problem with some of the samples, from an approximate one.
Refit = Callable[[Problem, Array], Array]

# A fold is fitted by iteration if its cost exceeds that of the linear model by more than this fraction of the
# mean cost of a fitted sample.
_NONLINEARITY_TOL = 1e-3
# Undetermined directions that change the held-out rows by less than this fraction have no effect on them.
_UNBOUNDED_TOL = 1e-6


@dataclass(frozen=True, eq=False)
class FoldSystems:
    """Triangular systems of the fitted and of the held-out samples of a fold, at one x."""

    fitted: TriangularSystem  # System of the fitted rows
    held_out: TriangularSystem  # System of the held-out rows
    n_rows: int  # Number of held-out rows

    @property
    def is_unobserved(self) -> Array:
        """Unknowns that no fitted row depends on, such as a point that only held-out samples touch, (p,)."""
        return self.fitted.is_unobserved

    def error(self, weights: Array, x: Array, columns: Array) -> float:
        """Compute the RMS of the held-out whitened rows under the fit of the other rows.

        Unknowns that only the held-out rows depend on are fitted to these.
        """
        step = np.zeros(len(x))
        step[columns] = solve_columns(self.fitted, weights, x, columns)[0]
        own = self._own_unknowns(columns)
        if not own.size:
            return float(np.sqrt(self.held_out.squared_error(step) / self.n_rows))
        residual = self.held_out.z - self.held_out.r @ step
        residual -= own @ (own.T @ residual)
        return float(np.sqrt((residual @ residual + self.held_out.min_cost) / self.n_rows))

    def prediction_std(self, weights: Array, columns: Array) -> float:
        """Compute the RMS of the held-out whitened rows that the uncertainty of the fit causes."""
        known = columns & ~self.is_unobserved
        if not known.any():
            return 0.0
        root, unbounded = self.fitted.select(known).sqrt_covariance(weights[known])
        own = self._own_unknowns(columns)
        if known.all() and not unbounded.size:
            return float(np.sqrt(self.held_out.predicted_variance(root) / self.n_rows))
        rows = self.held_out.r[:, known]
        rows = rows - own @ (own.T @ rows) if own.size else rows
        if np.linalg.norm(rows @ unbounded) > _UNBOUNDED_TOL * np.linalg.norm(rows):
            return np.inf
        return float(np.linalg.norm(rows @ root) / np.sqrt(self.n_rows))

    def _own_unknowns(self, columns: Array) -> Array:
        """Return an orthonormal basis of the held-out rows that only unknowns of their own explain."""
        own = columns & self.is_unobserved
        if not own.any():
            return np.empty((0, 0))
        rows = self.held_out.r[:, own]
        return np.linalg.qr(rows[:, rows.any(0)])[0]


def solve_columns(system: TriangularSystem, weights: Array, x: Array, columns: Array) -> tuple[Array, float]:
    """Solve a triangular system with priors for some of the unknowns.

    Directions that neither rows nor priors determine return to 0, as x may contain information on them from
    held-out rows.
    """
    prior = weights[columns]
    if prior.all():
        return system.select(columns).solve(prior, x[columns])
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


def factor_partition(problem: Problem, x: Array, folds: Sequence[Fold]) -> tuple[FoldSystems, ...]:
    """Compute the triangular systems of disjoint folds; the rows of each sample are factored once."""
    rest = tuple(~np.any(masks, 0) for masks in zip(*folds, strict=True))
    parts = [
        problem.with_data([item.take(mask) for item, mask in zip(problem.data, masks, strict=True)])
        for masks in (*folds, rest)
        if np.any(np.concatenate(masks))
    ]
    if uses_normal_equations(problem):
        equations = [normal_equations(part, x).products for part in parts]
        total = np.sum(equations, 0)
        systems = [(NormalEquations(total - one), NormalEquations(one)) for one in equations]
    else:
        factors = [linearize_and_factor(part, x, small_angle=False).rows for part in parts]
        systems = [
            (
                TriangularSystem(merge_r_factors([other for other in factors if other is not one])),
                TriangularSystem(one),
            )
            for one in factors[: len(folds)]
        ]
    return tuple(
        FoldSystems(*system, count_rows(part))
        for system, part in zip(systems[: len(folds)], parts[: len(folds)], strict=True)
    )


def factor_folds(problem: Problem, x: Array, folds: Sequence[Fold]) -> Iterator[FoldSystems]:
    """Compute the triangular systems of folds; consecutive disjoint folds are factored once."""
    group: list[Fold] = []
    for fold in folds:
        if any(np.any(a & b) for other in group for a, b in zip(fold, other, strict=True)):
            yield from factor_partition(problem, x, group)
            group = []
        group.append(fold)
    if group:
        yield from factor_partition(problem, x, group)


def solve_fold(
    problem: Problem, fold: Fold, systems: FoldSystems, x: Array, columns: Array, refit: Refit
) -> Array:
    """Solve a fold by one step from x (p,) in the free columns, or by iteration if that is not enough."""
    fitted = problem.with_data([item.take(~mask) for item, mask in zip(problem.data, fold, strict=True)])
    candidate = x.copy()
    step, cost = solve_columns(systems.fitted, fitted.weights, x, columns)
    candidate[columns] += step
    cost += float(np.sum((fitted.weights * x)[~columns] ** 2))
    n_samples = sum(len(item.rows) for item in fitted.data)
    if fitted.cost(candidate) <= cost + _NONLINEARITY_TOL * cost / max(1, n_samples):
        return candidate
    return refit(fitted, candidate)
