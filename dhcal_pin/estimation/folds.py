"""Folds: fits of a part of the samples, and the errors of the others, from triangular systems at one x.

The model is nearly linear around a solution x. A fold is therefore solved from two triangular systems at x
instead of a new iteration: one of its fitted rows, [R_f | z_f], and one of its held-out rows, [R_h | z_h].
With prior weights W, the step of the fit without the fold, and the error of the fold, are

    δ = argmin ‖R_f·δ - z_f‖² + ‖W·(x + δ)‖²,        error² = (‖R_h·δ - z_h‖² + ρ_h²) / m_h,

with ρ_h² the part of the held-out cost that no δ changes and m_h the number of held-out rows. If the true
cost at x + δ exceeds the cost that the linear model predicts, the model is not linear enough over δ, and
the fold is fitted by iteration.

The noise of the rows may be estimated with the unknowns, alone or beside noise that is known. The rows are
then in classes c. The variance of the whitened rows of a class is

    v_c = 1 - t_c + t_c·s²

with the noise s, which is common to all classes, and the share t_c of the variance that it scales: 1 if
nothing is known of the noise, 0 if it is known. Corners of an image are between the two: they have the
noise of their detection and a displacement of the arm, see `calibration.cameras.joint_errors`. With the
squared residuals C_c of the n_c rows of a class, γ_c of which the unknowns take up, the noise of greatest
evidence is the fixed point of

    s² = Σ (C_c - (n_c - γ_c)·(1 - t_c))·t_c/v_c² / Σ (n_c - γ_c)·t_c²/v_c².

Shapes: p unknowns, c columns (unknowns that are free), m samples of a measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce

import numpy as np

from .._frozen import frozen
from .._typing import Array
from . import qr
from .normal_equations import NormalEquations
from .problem import Problem, factor, normal_equations_by_part, uses_normal_equations
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


@frozen(eq=False)
class FoldSystems:
    """Triangular systems of the fitted and of the held-out samples of a fold, at one x."""

    fitted: TriangularSystem  # System of the fitted rows
    held_out: TriangularSystem  # System of the held-out rows
    n_rows: int  # Number of held-out rows
    whole: NormalEquations | None = None  # Normal equations of both, where both are given by theirs

    @property
    def is_unobserved(self) -> Array:
        """Unknowns that no fitted row depends on, such as a point that only held-out samples touch, (p,)."""
        return self.fitted.is_unobserved

    def error(self, weights: Array, x: Array, columns: Array) -> float:
        """Compute the RMS of the held-out whitened rows; unknowns of these rows alone are fitted to them."""
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
        if known.all() and self.whole is not None:
            assert isinstance(self.fitted, NormalEquations)
            return float(np.sqrt(self.whole.variance_of_others(self.fitted, weights) / self.n_rows))
        root, unbounded = self.fitted.select(known).sqrt_covariance(weights[known])
        own = self._own_unknowns(columns)
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
    """Solve a triangular system with priors for some of the unknowns."""
    # Directions that neither rows nor priors determine return to 0: x may contain information from held-out
    # rows.
    prior = weights[columns]
    if prior.all():
        return system.select(columns).solve(prior, x[columns])
    from scipy.linalg import lstsq  # lazy import: slow

    a = np.concatenate([system.r[:, columns], np.diag(prior)])
    b = np.concatenate([system.z, -prior * x[columns]])
    solution = lstsq(a, b, lapack_driver="gelsy", check_finite=False)
    assert solution is not None
    step = solution[0]
    if not prior.all():
        _, s, vt = qr.singular_value_decomposition(a)
        null_space = vt[s <= qr.RANK_RTOL * s[0]]
        step = step - null_space.T @ (null_space @ (x[columns] + step))
    return step, system.min_cost + float(np.sum((a @ step - b) ** 2))


def count_rows(problem: Problem) -> int:
    """Return the number of whitened rows of a problem."""
    return sum(item.residual_dim * len(item.rows) for item in problem.data)


def factor_partition(
    problem: Problem, x: Array, folds: Sequence[Fold], whole: NormalEquations | None = None
) -> Iterator[FoldSystems]:
    """Compute the triangular systems of disjoint folds; the rows of each sample are factored once."""
    if uses_normal_equations(problem):
        # The last label is that of samples in no fold, which count only in the equations of all samples.
        labels = [np.argmax([*masks, np.ones(len(masks[0]))], 0) for masks in zip(*folds, strict=True)]
        has_rest = whole is None and any((label == len(folds)).any() for label in labels)
        equations = normal_equations_by_part(problem, x, labels, len(folds) + has_rest)
        whole = whole or NormalEquations(reduce(np.add, (one.products for one in equations)))
        for fold, one in zip(folds, equations, strict=False):
            n_rows = sum(
                item.residual_dim * int(mask.sum()) for item, mask in zip(problem.data, fold, strict=True)
            )
            yield FoldSystems(NormalEquations(whole.products - one.products), one, n_rows, whole)
        return
    rest = tuple(~np.any(masks, 0) for masks in zip(*folds, strict=True))
    parts = [
        problem.with_data([item.take(mask) for item, mask in zip(problem.data, masks, strict=True)])
        for masks in (*folds, rest)
        if np.any(np.concatenate(masks))
    ]
    held_out = parts[: len(folds)]
    linearization = problem.linearize(x)
    factors = [factor(part, linearization, len(x)).rows for part in parts]
    for part, one in zip(held_out, factors, strict=False):
        others = merge_r_factors([other for other in factors if other is not one])
        yield FoldSystems(TriangularSystem(others), TriangularSystem(one), count_rows(part))


def factor_folds(problem: Problem, x: Array, folds: Sequence[Fold]) -> Iterator[FoldSystems]:
    """Compute the triangular systems of folds; consecutive disjoint folds are factored once."""
    groups: list[list[Fold]] = []
    for fold in folds:
        last = groups[-1] if groups else []
        if not last or any(np.any(a & b) for other in last for a, b in zip(fold, other, strict=True)):
            groups.append([])
        groups[-1].append(fold)
    whole: NormalEquations | None = None
    for group in groups:
        for systems in factor_partition(problem, x, group, whole):
            whole = systems.whole
            yield systems


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
    candidate_cost = fitted.cost(candidate)
    if candidate_cost <= cost + _NONLINEARITY_TOL * cost / max(1, n_samples):
        return candidate
    # A step in a curved valley can lead far away.
    return refit(fitted, candidate if candidate_cost <= fitted.cost(x) else x)


@frozen(eq=False)
class NoiseClass:
    """Rows of one variance."""

    system: TriangularSystem  # System of the rows
    n_rows: int  # Number of rows
    share: float = 1.0  # Share t of the variance that the noise scales

    def variance(self, noise: float) -> float:
        """Return the variance of the rows."""
        return 1 - self.share + self.share * noise**2


@frozen(eq=False)
class NoisyRows:
    """Rows of all classes, at one x (p,)."""

    classes: tuple[NoiseClass, ...]

    @property
    def n_scaled(self) -> int:
        """Number of rows whose noise is estimated."""
        return sum(one.n_rows for one in self.classes if one.share)

    def select(self, columns: Array) -> NoisyRows:
        """Return the rows of some of the unknowns, the others held."""
        return NoisyRows(
            tuple(NoiseClass(one.system.select(columns), one.n_rows, one.share) for one in self.classes)
        )

    def at(self, noise: float) -> TriangularSystem:
        """Return the system of all rows, divided by their standard deviations."""
        used = [one for one in self.classes if one.n_rows]
        scaled = [one.system.scaled(1 / np.sqrt(one.variance(noise))) for one in used]
        if len(scaled) == 1:
            return scaled[0]
        return TriangularSystem(merge_r_factors([one.rows for one in scaled]))

    def log_det(self, noise: float) -> float:
        """Return the sum of the logarithms of the standard deviations of all rows."""
        return 0.5 * sum(one.n_rows * float(np.log(one.variance(noise))) for one in self.classes)

    def noise_after(self, noise: float, step: Array, root: Array, n_determined: float) -> float:
        """Return the noise that the rows show after a step (p,), from the noise before and the root."""
        total = weight = smallest = 0.0
        others = [one.system.predicted_variance(root) / one.variance(noise) for one in self.classes[1:]]
        for one, determined in zip(self.classes, (n_determined - sum(others), *others), strict=True):
            if one.share and one.n_rows:
                variance = one.variance(noise)
                freedom = one.n_rows - determined
                excess = one.system.squared_error(step) - freedom * (1 - one.share)
                total += excess * one.share / variance**2
                weight += freedom * (one.share / variance) ** 2
                smallest = max(smallest, (one.share / variance) ** 2)
        return float(np.sqrt(max(total / max(weight, smallest), 0.0)))


@frozen(eq=False)
class NoisyFold:
    """Rows of the fitted and of the held-out samples of a fold, at one x (p,)."""

    fitted: NoisyRows
    held_out: TriangularSystem  # System of the held-out rows whose noise is estimated
    n_rows: int  # Number of these rows

    def squared_error(self, noise: float, weights: Array, x: Array, columns: Array) -> float:
        """Compute the sum of the squared held-out rows under the fit of the other rows."""
        systems = FoldSystems(self.fitted.at(noise), self.held_out, self.n_rows)
        return self.n_rows * systems.error(weights, x, columns) ** 2


def join_classes(parts: Sequence[NoisyRows]) -> NoisyRows:
    """Join the rows of several parts of the samples, class by class."""
    return NoisyRows(
        tuple(
            NoiseClass(
                TriangularSystem(merge_r_factors([one.system.rows for one in same])),
                sum(one.n_rows for one in same),
                same[0].share,
            )
            for same in zip(*(part.classes for part in parts), strict=True)
        )
    )
