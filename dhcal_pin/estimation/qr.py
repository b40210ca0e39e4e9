"""QR factorization of least-squares rows: the triangular system and its analysis.

The whitened rows [J | r] of one linearization, shape (k, p+1) for k rows and p unknowns, enter all further
computation through the upper triangular factor of their QR decomposition:

    Qᵀ·[J | r] = [R z; 0 ρ]        so that        ‖J·δ - r‖² = ‖R·δ - z‖² + ρ²

- Step: δ = R⁺·z by back substitution, or with a rank cut where R is ill-conditioned.
- Rank, condition and null space: singular values and vectors of R, which are those of J.
- Covariance: (RᵀR)⁻¹ = S·Sᵀ with S = R⁻¹.
- More rows: the QR decomposition of the stacked factors [R₁; R₂] is that of all rows. Chunks of samples
  therefore merge in any number, and prior rows δ/σ = -x/σ are appended in the same way.

This is the square root information filter (Bierman 1977). JᵀJ is not formed: it squares the condition,
and at condition 1e7 its inverse is wrong in the third digit (Golub & Van Loan 2013, section 5.3). The
exception are hundreds of unknowns that all have priors, see `normal_equations`.

Columns of J count in metres and radians; the ranks and conditions refer to those units.

References:
    G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, Academic Press 1977.
    G. H. Golub and C. F. Van Loan, Matrix Computations, 4th ed., Johns Hopkins 2013, chapter 5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from .._frozen import frozen
from .._kernels import (
    append_diagonal,
    invert_triangular,
    lapack,
    r_factor,
    reciprocal_condition,
    solve_triangular,
)
from .._typing import Array
from .solver_rules import EPS_MODEL

# Singular values below this fraction of the largest count as zero. On the paper's robots the observable
# directions lie above 1e-4; a value of 1e-3 or more would stop the paper's iteration from converging.
RANK_RTOL = 1e-9
# A triangular matrix whose reciprocal condition number exceeds this value has no singular value near
# RANK_RTOL: the estimated condition may be wrong by a factor of the matrix size.
WELL_CONDITIONED = 1e3 * RANK_RTOL
# Number of columns that LAPACK eliminates together, and of rows, which the cache of a processor holds.
_BLOCK_COLUMNS, _BLOCK_ROWS = 32, 1024
# Columns count as combinations of others that leave less than this fraction of the largest column.
_COMBINATION_RTOL = 1e-15


def blocked_r_factor(rows: Array) -> Array:
    """Compute the R factor of hundreds of columns (c, k, m)."""
    # LAPACK eliminates many columns at once by matrix products. The compiled kernel eliminates two at a time.
    c = len(rows)
    r = np.zeros((c, c), order="F")
    flat = rows.reshape(c, -1).T
    for start in range(0, len(flat), _BLOCK_ROWS):
        r = lapack.dtpqrt(0, _BLOCK_COLUMNS, r, flat[start : start + _BLOCK_ROWS], overwrite_a=1)[0]
    return np.ascontiguousarray(r)


def independent_columns(a: Array) -> tuple[Array, Array]:
    """Find numbers (k,) of columns of which all are combinations, and the coefficients of these, (k, n)."""
    packed, numbers = lapack.dgeqp3(np.linalg.qr(a, mode="r"))[:2]
    r, order = np.triu(packed), numbers - 1
    pivots = np.abs(np.diag(r))
    k = int(np.sum(pivots > _COMBINATION_RTOL * pivots.max(initial=0.0)))
    coefficients = np.zeros((k, len(order)))
    coefficients[:, order] = lapack.dtrtrs(r[:k, :k], r[:k])[0] if k else coefficients
    return order[:k], coefficients


def singular_value_decomposition(a: Array) -> tuple[Array, Array, Array]:
    """Compute the singular value decomposition of a matrix."""
    try:
        u, s, vt = np.linalg.svd(a)
        return u, s, vt
    except np.linalg.LinAlgError:
        # The divide and conquer method does not converge for some matrices of a wide range of values.
        from scipy.linalg import svd  # lazy import: slow

        return svd(a, lapack_driver="gesvd")


def singular_values(r: Array) -> Array:
    """Compute the singular values of R."""
    return np.linalg.svd(r, compute_uv=False)


def left_singular_vectors(a: Array) -> tuple[Array, Array]:
    """Compute the left singular vectors (m, k) that have a singular value, and these values (k,)."""
    u, s, _ = singular_value_decomposition(a)
    return u[:, : len(s)], s


def right_singular_vectors(r: Array) -> tuple[Array, Array]:
    """Compute the singular values of R and its right singular vectors, the rows of a matrix (p, p)."""
    # Rows of zeros only add singular values of 0.
    _, s, vt = singular_value_decomposition(r[r.any(1)])
    return np.append(s, np.zeros(len(vt) - len(s))), vt


def row_space(r: Array) -> Array:
    """Compute an orthonormal basis of the observable directions in parameter space."""
    _, s, vt = singular_value_decomposition(r)
    return vt[: len(_without_zeros(s))]


def _without_zeros(s: Array) -> Array:
    """Return the singular values, largest first, that do not count as zero."""
    return s[s > RANK_RTOL * s[0]] if s.size else s


def rank(r: Array) -> int:
    """Count the observable directions in parameter space."""
    return len(_without_zeros(singular_values(r)))


def null_space(r: Array) -> Array:
    """Compute an orthonormal basis of the directions that the data do not determine."""
    _, s, vt = singular_value_decomposition(r)
    return vt[len(_without_zeros(s)) :].T


def sum_of_squares(a: Array) -> float:
    """Compute the sum of the squared elements of an array."""
    return float(np.vdot(a, a))


def euclidean_norm(a: Array) -> float:
    """Compute the root of the sum of the squared elements of an array."""
    return math.sqrt(sum_of_squares(a))


@frozen(eq=False)
class TriangularSystem:
    """R factor of the whitened rows [J | r] at one x: ‖J·δ - r‖² = ‖R·δ - z‖² + min_cost.

    `batch.TriangularSystemBatch` is the same for b problems. It has the members `r`, `z`, `cost`,
    `roundoff`, `residual_change` and `predicted_reduction`, too, with a leading axis b. The classes
    are separate because a single system is solved by LAPACK's triangular routines, which NumPy does not offer
    for stacks: a damped step with p = 24 takes seven times as long in a stack of one.
    """

    rows: Array  #: [R z; 0 ρ], upper triangular, shape (p+1, p+1).

    @property
    def r(self) -> Array:
        """R factor of the Jacobian, upper triangular, shape (p, p)."""
        return self.rows[:-1, :-1]

    @property
    def z(self) -> Array:
        """Right-hand side, shape (p,)."""
        return self.rows[:-1, -1]

    @property
    def min_cost(self) -> float:
        """Cost ρ² that remains after the best step."""
        return float(self.rows[-1, -1] ** 2)

    @property
    def cost(self) -> float:
        """Cost at the current x: sum of the squared rows."""
        return sum_of_squares(self.rows[:, -1])

    @property
    def roundoff(self) -> float:
        """Rounding error of the rows, EPS_MODEL·‖R‖."""
        return EPS_MODEL * euclidean_norm(self.r)

    @property
    def is_unobserved(self) -> Array:
        """Unknowns that no row depends on, (p,)."""
        return np.logical_not(self.r.any(0))

    @property
    def column_norms(self) -> Array:
        """Change of the rows per unit of each unknown, (p,)."""
        return np.linalg.norm(self.r, axis=0)

    @cached_property
    def singular_values(self) -> Array:
        """Singular values of R, those of the Jacobian, largest first."""
        return singular_values(self.r)

    @property
    def rank(self) -> int:
        """Number of observable directions in parameter space."""
        return len(_without_zeros(self.singular_values))

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest singular value of the observable directions."""
        s = _without_zeros(self.singular_values)
        return float(s[0] / s[-1]) if s.size else 0.0

    @cached_property
    def null_space(self) -> Array:
        """Orthonormal basis of the directions that the data do not determine."""
        return null_space(self.r)

    def scaled(self, factor: float) -> TriangularSystem:
        """Return the system of the rows times a factor."""
        return TriangularSystem(factor * self.rows)

    def merged(self, other: TriangularSystem) -> TriangularSystem:
        """Compute the system of the rows of two systems of the same unknowns."""
        return TriangularSystem(merge_r_factors([self.rows, other.rows]))

    def select(self, columns: Array) -> TriangularSystem:
        """Compute the system of some of the unknowns, the others held."""
        return self if columns.all() else self._with_columns(np.flatnonzero(np.append(columns, True)))

    def _with_columns(self, kept: Array) -> TriangularSystem:
        """Compute the system of some columns of [J | r], the last one included."""
        return TriangularSystem(merge_r_factors([self.rows[:, kept]]))

    def with_priors(self, weights: Array, x: Array | float) -> TriangularSystem:
        """Append the prior rows δ/σ = -x/σ."""
        return append_rows(self, weights, -(weights * x))

    def solve(self, weights: Array, x: Array | float) -> tuple[Array, float]:
        """Compute the best step δ from x with prior weights 1/σ, and the cost of rows and priors after it."""
        posterior = self.with_priors(weights, x)
        return posterior.best_step(), posterior.min_cost

    def best_step(self) -> Array:
        """Compute the best step δ, of minimum norm, shape (p,)."""
        return pseudo_inverse(self.r, self.z)

    def appended(self, diagonal: Array, right: Array) -> TriangularSystem:
        """Append the rows diag(diagonal)·δ = right."""
        return TriangularSystem(append_diagonal(self.rows[None], diagonal[None], right[None])[0])

    def sqrt_covariance(self, weights: Array) -> tuple[Array, Array]:
        """Compute a square root (p, r) of the covariance, and a basis (p, p-r) of undetermined directions."""
        # S·Sᵀ = (RᵀR + W²)⁻¹, W = diag(weights). Where [R; W] is ill-conditioned, parameter space is split by
        # the rank of R: in the observable directions data and priors count, in the others the priors alone.
        # Exact data with tiny standard deviations would otherwise hide the information of the priors.
        if not len(weights):
            return np.empty((0, 0)), np.empty((0, 0))
        full = self.with_priors(weights, 0.0).r
        if is_well_conditioned(full):
            return invert_triangular(full), np.empty((len(weights), 0))
        # Unknowns of different units may alone cause the condition.
        scale = np.linalg.norm(full, axis=0)
        if weights.all() and is_well_conditioned(full / scale):
            return invert_triangular(full / scale) / scale[:, None], np.empty((len(weights), 0))
        _, s, vt = singular_value_decomposition(self.r)
        n_observable = int(np.sum(s > RANK_RTOL * s[0]))
        observable, unobservable = vt[:n_observable].T, vt[n_observable:].T
        # Priors within the unobservable directions: W·unobservable = left·diag(t)·yt.
        left, t, yt = singular_value_decomposition(weights[:, None] * unobservable)
        has_prior = t > RANK_RTOL * weights.max(initial=0.0)
        left, prior_root = left[:, : len(t)][:, has_prior], unobservable @ (yt[has_prior].T / t[has_prior])
        # What the priors add to the observable directions after the unobservable ones are eliminated.
        priors = weights[:, None] * observable
        rows = np.concatenate([np.diag(s[:n_observable]), priors - left @ (left.T @ priors)])
        # LAPACK prints a complaint about an empty matrix.
        data_root = invert_triangular(np.linalg.qr(rows)[1]) if n_observable else np.empty((0, 0))
        root = np.concatenate([(observable - prior_root @ (left.T @ priors)) @ data_root, prior_root], 1)
        return root, unobservable @ np.delete(yt, np.flatnonzero(has_prior), 0).T

    def covariance(self, weights: Array) -> Array:
        """Compute the covariance of data and priors, on the directions that they determine, (p, p)."""
        root = self.sqrt_covariance(weights)[0]
        return root @ root.T

    def squared_error(self, step: Array) -> float:
        """Compute the cost after a step."""
        return sum_of_squares(self.z - self.r @ step) + self.min_cost

    def predicted_variance(self, root: Array) -> float:
        """Compute the variance of all rows that uncertain unknowns cause."""
        return sum_of_squares(self.r @ root)

    def residual_change(self, step: Array) -> Array:
        """Compute the change of the rows by a step, up to a rotation."""
        return self.r @ step

    def predicted_reduction(self, change: Array) -> float:
        """Compute by how much the linear model reduces the cost."""
        z = self.z
        return sum_of_squares(z) - sum_of_squares(change - z)

    def recentered(self, step: Array) -> TriangularSystem:
        """Build the system at x + step, assuming that the model is linear over the step."""
        rows = self.rows.copy()
        rows[:-1, -1] -= self.r @ step
        return TriangularSystem(rows)


def merge_r_factors(factors: Sequence[Array]) -> Array:
    """Merge R factors of different rows of the same columns."""
    return r_factor(np.concatenate(factors).T[:, None].copy())


def combine_r_factors(factors: Iterable[Array], p: int) -> TriangularSystem:
    """Merge the R factors of chunks one after the other; plain rows of small chunks are collected first."""
    merged: Array | None = None
    pending: list[Array] = []
    for factor in factors:
        pending.append(factor)
        if sum(map(len, pending)) > p:
            merged = _merge_with(merged, pending)
            pending = []
    if pending:
        merged = _merge_with(merged, pending)
    return TriangularSystem(np.zeros((p + 1, p + 1)) if merged is None else merged)


def _merge_with(merged: Array | None, pending: Sequence[Array]) -> Array:
    """Merge pending factors or rows with the factor of all rows before them, if there is one."""
    if merged is None and len(pending) == 1 and len(pending[0]) == pending[0].shape[1]:
        return pending[0]
    return merge_r_factors(pending if merged is None else (merged, *pending))


def append_rows(system: TriangularSystem, diagonal: Array, right: Array) -> TriangularSystem:
    """Append the rows diag(diagonal)·δ = right to a system."""
    return system.appended(diagonal, right) if diagonal.any() else system


def is_well_conditioned(r: Array) -> bool:
    """Check that no singular value of R can be near the rank cut."""
    return bool(r.size) and reciprocal_condition(r) > WELL_CONDITIONED


def pseudo_inverse(r: Array, z: Array) -> Array:
    """Compute the minimum-norm least-squares solution R⁺·z (p,) by the singular values above RANK_RTOL."""
    # Back substitution takes a hundredth of the time of the singular value decomposition.
    if is_well_conditioned(r):
        return _substitute(r, z)
    # Unknowns of different units may alone cause the condition. None of them may count as zero.
    scale = np.linalg.norm(r, axis=0)
    if scale.min(initial=np.inf) > RANK_RTOL * scale.max(initial=0.0) and is_well_conditioned(r / scale):
        return _substitute(r / scale, z) / scale
    try:
        return np.linalg.lstsq(r, z, rcond=RANK_RTOL)[0]
    except np.linalg.LinAlgError:
        u, s, vt = singular_value_decomposition(r)
        k = len(_without_zeros(s))
        return vt[:k].T @ ((z @ u[:, :k]) / s[:k])


def _substitute(r: Array, z: Array) -> Array:
    """Solve R·x = z, (p,)."""
    return solve_triangular(r[None], np.ascontiguousarray(z)[None, :, None])[0, :, 0]
