"""Normal equations: inner products of the whitened rows, for hundreds of unknowns that all have priors.

The inner products P = [J | r]ᵀ·[J | r] of many columns are computed in a tenth of the time of the R factor of
the rows (`qr`), as the columns of correction curves have a structure, see `problem.StructuredRows`. Sums and
differences of P belong to the union and the difference of sets of samples. With prior weights W,

    ‖J·δ - r‖² + ‖W·(x + δ)‖² = ‖R·δ - z‖² + ρ²,    RᵀR = JᵀJ + W²,    Rᵀz = Jᵀr - W²·x,

with R from the Cholesky decomposition. JᵀJ has the square of the condition number of J. This is accurate
enough here: in units of the prior standard deviations no eigenvalue of RᵀR is below 1, and its largest one λ
is the square of the ratio of prior to remaining uncertainty. The relative error of R is about 1e-16·λ.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from .._typing import Array
from .qr import TriangularSystem, merge_r_factors

# Added to the diagonal of a matrix of unit diagonal that rounding errors make indefinite, and the smallest
# squared pivot of such a matrix that counts.
_DIAGONAL_SHIFT = _MIN_PIVOT = 1e-12


class NormalEquations(TriangularSystem):
    """Triangular system of the whitened rows [J | r] at one x, which is given by their inner products."""

    products: Array  # [J | r]ᵀ·[J | r], shape (p+1, p+1)

    def __init__(self, products: Array):
        """Store the inner products."""
        vars(self)["products"] = products

    @cached_property
    def rows(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """[R z; 0 ρ], upper triangular, shape (p+1, p+1).

        Directions that the rows determine by less than a millionth of the norm of a column count as
        undetermined.
        """
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
        return float(self.products[-1, -1])

    @property
    def is_unobserved(self) -> Array:
        """Unknowns that no row depends on, (p,)."""
        return np.diag(self.products)[:-1] == 0

    def scaled(self, factor: float) -> NormalEquations:
        """Return the system of the rows times a factor."""
        return NormalEquations(factor**2 * self.products)

    def merged(self, other: TriangularSystem) -> TriangularSystem:
        """Compute the system of the rows of two systems of the same unknowns."""
        if isinstance(other, NormalEquations):
            return NormalEquations(self.products + other.products)
        return super().merged(other)

    def _with_columns(self, kept: Array) -> NormalEquations:
        """Return the system of some columns of [J | r], the last one included."""
        return NormalEquations(self.products[np.ix_(kept, kept)])

    def recentered(self, step: Array) -> NormalEquations:
        """Build the system at x + step, assuming that the model is linear over the step."""
        products = self.products.copy()
        products[:-1, -1] -= self.products[:-1, :-1] @ step
        products[-1, :-1] = products[:-1, -1]
        products[-1, -1] = self.squared_error(step)
        return NormalEquations(products)

    def squared_error(self, step: Array) -> float:
        """Compute the cost after a step."""
        both = np.append(step, -1.0)
        return max(float(both @ self.products @ both), 0.0)

    def with_priors(self, weights: Array, x: Array | float) -> TriangularSystem:
        """Build the triangular system of data and priors."""
        root, scale = self._decompose(weights)
        z, min_cost = self._right_side(weights, x)
        rows = np.zeros_like(self.products)
        np.multiply(root, scale, out=rows[:-1, :-1])
        rows[:-1, -1], rows[-1, -1] = z, np.sqrt(min_cost)
        return TriangularSystem(rows)

    def solve(self, weights: Array, x: Array | float) -> tuple[Array, float]:
        """Compute the best step with priors, and the cost after it; see `qr.TriangularSystem.solve`."""
        root, scale = self._decompose(weights)
        z, min_cost = self._right_side(weights, x)
        return lapack.dtrtrs(root, z)[0] / scale, min_cost

    def _right_side(self, weights: Array, x: Array | float) -> tuple[Array, float]:
        """Return z, (p,), and ρ² of the system with priors."""
        root, scale = self._decompose(weights)
        z = lapack.dtrtrs(root, (self.products[:-1, -1] - weights**2 * x) / scale, trans=1)[0]
        return z, max(self.cost + float(np.sum((weights * x) ** 2)) - float(z @ z), 0.0)

    def sqrt_covariance(self, weights: Array) -> tuple[Array, Array]:
        """Compute a square root of the covariance of data and priors together; see `qr.TriangularSystem`.

        The weights are positive, so there are no undetermined directions.
        """
        root, scale = self._decompose(weights)
        if "_inverse_root" not in vars(self):
            vars(self)["_inverse_root"] = lapack.dtrtri(root)[0] / scale[:, None]
        return vars(self)["_inverse_root"], np.empty((len(weights), 0))

    def _decompose(self, weights: Array) -> tuple[Array, Array]:
        """Decompose JᵀJ + W² = D·RᵀR·D; the last result is kept for the covariance of the same solution."""
        last = vars(self).get("_decomposition")
        if last is not None and np.array_equal(last[0], weights):
            return last[1:]
        matrix, scale = self._with_unit_diagonal(weights)
        # LAPACK reads the transposed matrix, which is the same.
        root, info = lapack.dpotrf(matrix.T)
        if info:
            matrix.flat[:: len(matrix) + 1] += _DIAGONAL_SHIFT
            root, info = lapack.dpotrf(matrix.T, overwrite_a=1)
        assert info == 0
        vars(self)["_decomposition"] = weights, root, scale
        vars(self).pop("_inverse_root", None)
        return root, scale

    def _with_unit_diagonal(self, weights: Array) -> tuple[Array, Array]:
        """Return D⁻¹·(JᵀJ + W²)·D⁻¹, whose diagonal is 1, and the diagonal of D; 1 for a column of zeros."""
        products = self.products[:-1, :-1]
        # A difference of sums may be negative by rounding.
        scale = np.sqrt(np.fmax(np.diag(products) + weights**2, 0.0))
        scale[scale == 0] = 1.0
        matrix = products / scale
        matrix /= scale[:, None]
        matrix.flat[:: len(matrix) + 1] += (weights / scale) ** 2
        return matrix, scale

    def predicted_variance(self, root: Array) -> float:
        """Compute the variance of all rows that uncertain unknowns cause; the root is upper triangular."""
        upper = lapack.dlauum(root)[0]
        products = self.products[:-1, :-1]
        return 2 * float(np.vdot(products, upper)) - float(np.diag(products) @ np.diag(upper))
