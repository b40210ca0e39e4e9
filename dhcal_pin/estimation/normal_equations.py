"""Normal equations: inner products of the whitened rows, for hundreds of unknowns that all have priors.

The inner products P = [J | r]ᵀ·[J | r] of many columns are computed in a tenth of the time of the R factor of
the rows (`qr`), as the columns of correction curves have a structure, see `problem.StructuredRows`. Sums and
differences of P belong to the union and the difference of sets of samples. With prior weights W,

    ‖J·δ - r‖² + ‖W·(x + δ)‖² = ‖R·δ - z‖² + ρ²,    RᵀR = JᵀJ + W²,    Rᵀz = Jᵀr - W²·x,

with R from the Cholesky decomposition. JᵀJ has the square of the condition number of J. This is accurate
enough here: in units of the prior standard deviations no eigenvalue of RᵀR is below 1, and its largest one λ
is the square of the ratio of prior to remaining uncertainty. The relative error of R is about 1e-16·λ.

`DeterminedSystem` is the system with priors. Its damped steps use the decomposition without damping.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from .._kernels import lapack
from .._typing import Array
from .qr import TriangularSystem, euclidean_norm, is_well_conditioned, merge_r_factors, sum_of_squares
from .solver_rules import EPS_MODEL

# Added to the diagonal of a matrix of unit diagonal that rounding errors make indefinite, and the smallest
# squared pivot of such a matrix that counts.
_DIAGONAL_SHIFT = _MIN_PIVOT = 1e-12
# Attributes of normal equations that do not depend on the residuals.
_OF_JACOBIAN = ("_decomposition", "_inverse_root")
# Half the size of a triangular matrix below which BLAS divides by it at once.
_SMALL = 100
# Largest number of refinements of a step, the relative change that ends them, and the largest ratio of two
# successive changes with which they go on.
_MAX_REFINEMENTS, _REFINED, _MAX_RATIO = 16, 1e-12, 0.1


class NormalEquations(TriangularSystem):
    """Triangular system of the whitened rows [J | r] at one x, which is given by their inner products."""

    def __init__(self, products: Array, factor: float = 1.0):
        """Store inner products (p+1, p+1), and the factor of the rows to theirs."""
        vars(self).update(_unscaled=products, _factor=factor)

    @cached_property
    def products(self) -> Array:
        """Inner products [J | r]ᵀ·[J | r], shape (p+1, p+1)."""
        return self._unscaled if self._factor == 1 else self._factor**2 * self._unscaled

    @cached_property
    def rows(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """[R z; 0 ρ], (p+1, p+1); a millionth of the norm of a column or less counts as undetermined."""
        matrix, scale = self._with_unit_diagonal(np.zeros(len(self.products) - 1))
        root, pivots, rank, _ = lapack.dpstrf(matrix, tol=_MIN_PIVOT)
        order, right = pivots - 1, self.products[:-1, -1] / scale
        rows = np.zeros((rank + 1, len(self.products)))
        rows[:-1, order] = np.triu(root)[:rank]
        rows[:-1, -1] = lapack.dtrtrs(root[:rank, :rank], right[order[:rank]], trans=1)[0]
        rows[-1, -1] = np.sqrt(max(self.cost - float(rows[:-1, -1] @ rows[:-1, -1]), 0.0))
        rows[:-1, :-1] *= scale
        return merge_r_factors([rows])

    @property
    def cost(self) -> float:
        """Cost at the current x: sum of the squared rows."""
        return self._factor**2 * float(self._unscaled[-1, -1])

    @property
    def column_norms(self) -> Array:
        """Change of the rows per unit of each unknown, (p,)."""
        return np.sqrt(np.diag(self.products)[:-1])

    @property
    def is_unobserved(self) -> Array:
        """Unknowns that no row depends on, (p,)."""
        return np.diag(self._unscaled)[:-1] == 0

    def scaled(self, factor: float) -> NormalEquations:
        """Return the system of the rows times a factor."""
        return NormalEquations(self._unscaled, factor * self._factor)

    def merged(self, other: TriangularSystem) -> TriangularSystem:
        """Compute the system of the rows of two systems of the same unknowns."""
        if isinstance(other, NormalEquations):
            return NormalEquations(self.products + other.products)
        return super().merged(other)

    def _with_columns(self, kept: Array) -> NormalEquations:
        """Return the system of some columns of [J | r], the last one included."""
        return NormalEquations(self.products.take(kept, 0).take(kept, 1))

    def recentered(self, step: Array) -> NormalEquations:
        """Build the system at x + step, assuming that the model is linear over the step."""
        products = self.products.copy()
        products[:-1, -1] -= self.products[:-1, :-1] @ step
        products[-1, :-1] = products[:-1, -1]
        products[-1, -1] = self.squared_error(step)
        # The decomposition of JᵀJ is the same.
        system = NormalEquations(products)
        vars(system).update({name: value for name, value in vars(self).items() if name in _OF_JACOBIAN})
        return system

    def squared_error(self, step: Array) -> float:
        """Compute the cost after a step."""
        both = np.append(step, -1.0)
        return max(float(both @ self.products @ both), 0.0)

    def with_priors(self, weights: Array, x: Array | float) -> DeterminedSystem:
        """Build the system of data and priors."""
        right = self._factor**2 * self._unscaled[:-1, -1] - weights**2 * x
        system = DeterminedSystem(self, weights**2, right, self.cost + float(np.sum((weights * x) ** 2)))
        vars(system)["_cholesky"] = self._decompose(weights)
        return system

    def solve(self, weights: Array, x: Array | float) -> tuple[Array, float]:
        """Compute the best step with priors, and the cost after it; see `qr.TriangularSystem.solve`."""
        posterior = self.with_priors(weights, x)
        return posterior.substitute(), posterior.min_cost

    def sqrt_covariance(self, weights: Array) -> tuple[Array, Array]:
        """Compute a root of the covariance of data and priors; positive weights determine all directions."""
        root, scale = self._decompose(weights)
        if "_inverse_root" not in vars(self):
            vars(self)["_inverse_root"] = _quotient(np.diag(1 / scale).T, root)
        return vars(self)["_inverse_root"], np.empty((len(weights), 0))

    def covariance(self, weights: Array) -> Array:
        """Compute the covariance of data and priors together, shape (p, p)."""
        upper = lapack.dlauum(self.sqrt_covariance(weights)[0])[0]
        covariance = upper + upper.T
        covariance.flat[:: len(covariance) + 1] *= 0.5
        return covariance

    def _decompose(self, weights: Array) -> tuple[Array, Array]:
        """Decompose JᵀJ + W² = D·RᵀR·D; the last result is kept for the covariance of the same solution."""
        last = vars(self).get("_decomposition")
        if last is None or not np.array_equal(last[0], weights):
            last = vars(self)["_decomposition"] = weights, *self.cholesky(weights**2)
            vars(self).pop("_inverse_root", None)
        return last[1:]

    def cholesky(self, diagonal: Array) -> tuple[Array, Array]:
        """Compute R and the diagonal of D of JᵀJ + diag(diagonal) = D·RᵀR·D."""
        for shift in (0.0, _DIAGONAL_SHIFT):
            matrix, scale = self._with_unit_diagonal(diagonal)
            matrix.flat[:: len(matrix) + 1] += shift
            # LAPACK reads the transposed matrix, which is the same.
            root, info = lapack.dpotrf(matrix.T, overwrite_a=1)
            if not info:
                return root, scale
        raise AssertionError("the matrix is not positive definite")

    def _with_unit_diagonal(self, diagonal: Array) -> tuple[Array, Array]:
        """Return D⁻¹·(JᵀJ + diag(diagonal))·D⁻¹ of diagonal 1, and D; 1 for a column of zeros."""
        products, diagonal = self._unscaled[:-1, :-1], diagonal / self._factor**2
        # A difference of sums may be negative by rounding.
        scale = np.sqrt(np.fmax(np.diag(products) + diagonal, 0.0))
        scale[scale == 0] = 1.0
        matrix = products * (1 / scale)
        matrix *= 1 / scale[:, None]
        matrix.flat[:: len(matrix) + 1] += diagonal / scale**2
        return matrix, self._factor * scale

    def predicted_variance(self, root: Array) -> float:
        """Compute the variance of all rows that uncertain unknowns cause; the root is upper triangular."""
        upper = lapack.dlauum(root)[0]
        # The products are symmetric. Both arrays are then read in the order of memory.
        products = self.products[:-1, :-1].T
        return 2 * float(np.einsum("ij,ij->", products, upper)) - float(np.diag(products) @ np.diag(upper))

    def variance_of_others(self, part: NormalEquations, weights: Array) -> float:
        """Compute the variance of all rows but those of a part that a fit of the part with priors causes."""
        # With A = P + W² of this system and B of the part, it is trace(B⁻¹·(A - B)) = ‖S·R⁻¹‖² - p for the
        # decompositions A = SᵀS and B = RᵀR.
        (upper, scale), (root, part_scale) = self._decompose(weights), part._decompose(weights)
        return sum_of_squares(_quotient(upper * (scale / part_scale), root).T) - len(root)


class DeterminedSystem(TriangularSystem):
    """Triangular system of normal equations to which diagonal rows were appended: priors, and a damping."""

    def __init__(self, equations: NormalEquations, diagonal: Array, right: Array, cost: float):
        """Store the equations, the squares (p,) of appended rows, and Jᵀr (p,) and ‖r‖² of both."""
        vars(self).update(_equations=equations, _diagonal=diagonal, _right=right, _cost=cost)

    @cached_property
    def _cholesky(self) -> tuple[Array, Array]:
        """R of unit columns, and the norms D of the columns."""
        return self._equations.cholesky(self._diagonal)

    @cached_property
    def rows(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """[R z; 0 ρ], upper triangular, shape (p+1, p+1)."""
        rows = np.zeros((len(self.z) + 1,) * 2, order="F")
        rows[:-1, :-1], rows[:-1, -1], rows[-1, -1] = self.r, self.z, np.sqrt(self.min_cost)
        return rows

    @cached_property
    def r(self) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """R factor, upper triangular, shape (p, p)."""
        root, scale = self._cholesky
        return root * scale

    @cached_property
    def z(self) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Right-hand side, shape (p,)."""
        root, scale = self._cholesky
        return lapack.dtrtrs(root, self._right / scale, trans=1)[0]

    @property
    def roundoff(self) -> float:
        """Rounding error of the rows, EPS_MODEL·‖R‖."""
        return EPS_MODEL * euclidean_norm(self._cholesky[1])

    @property
    def min_cost(self) -> float:
        """Cost ρ² that remains after the best step."""
        return max(self._cost - float(self.z @ self.z), 0.0)

    @property
    def cost(self) -> float:
        """Cost at the current x."""
        return self._cost

    def appended(self, diagonal: Array, right: Array) -> DeterminedSystem:
        """Append the rows diag(diagonal)·δ = right."""
        system = DeterminedSystem(
            self._equations,
            self._diagonal + diagonal**2,
            self._right + diagonal * right,
            self._cost + float(right @ right),
        )
        vars(system)["_before"] = self
        return system

    def best_step(self) -> Array:
        """Compute the best step, shape (p,)."""
        before = vars(self).get("_before")
        step = self._refined_step(before) if before and is_well_conditioned(before._cholesky[0]) else None
        if step is not None:
            return step
        return self.substitute() if is_well_conditioned(self._cholesky[0]) else super().best_step()

    def _refined_step(self, before: DeterminedSystem) -> Array | None:
        """Compute the best step from the decomposition without the last rows; None if they are too large."""
        # With A of that decomposition and E of these rows, the iteration δ ← A⁻¹·(b - E·δ) ends at the
        # solution for A + E. A damping is mostly so small that it takes some steps only.
        root, scale = before._cholesky
        added, right = (self._diagonal - before._diagonal) / scale**2, self._right / scale
        step, change = lapack.dpotrs(root, right)[0], np.inf
        for _ in range(_MAX_REFINEMENTS):
            last, step = step, lapack.dpotrs(root, right - added * step)[0]
            last_change, change = change, euclidean_norm(step - last)
            if change <= _REFINED * euclidean_norm(step):
                return step / scale
            if change > _MAX_RATIO * last_change:
                break
        return None

    def substitute(self) -> Array:
        """Compute the best step by back substitution, shape (p,)."""
        root, scale = self._cholesky
        return lapack.dtrtrs(root, self.z)[0] / scale


def _quotient(upper: Array, root: Array) -> Array:
    """Compute upper·root⁻¹ of upper triangular matrices in the order of Fortran."""
    # Products of parts are faster than LAPACK, which does not use that the first matrix is triangular.
    half = len(root) // 2
    if half < _SMALL:
        return lapack.dtrsm(1.0, root, upper, side=1)
    first, last = slice(None, half), slice(half, None)
    out = np.zeros_like(root)
    out[first, first] = _quotient(upper[first, first], root[first, first])
    out[last, last] = _quotient(upper[last, last], root[last, last])
    beside = upper[first, last] - lapack.dtrmm(1.0, out[first, first], root[first, last])
    out[first, last] = lapack.dtrsm(1.0, root[last, last], beside, side=1, overwrite_b=1)
    return out
