"""Triangular systems of many problems, stacked along a leading axis.

`TriangularSystemBatch` is `qr.TriangularSystem` for b problems: for each of them

    ‖J·δ - r‖² = ‖R·δ - z‖² + min_cost

The formulas are those of `qr`; kernels and NumPy loop over the stack in compiled code.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..._frozen import frozen
from ..._kernels import append_diagonal, solve_triangular
from ..._typing import Array
from ..qr import RANK_RTOL
from ..solver_rules import EPS_MODEL, step_is_negligible

# Largest estimated condition number at which R is solved without a singular value decomposition. The margin
# of 1000 to the rank cut covers the error of the estimate.
MAX_CONDITION = 1e-3 / RANK_RTOL
# Random unit vectors from which the condition number is estimated.
N_PROBES = 7


@frozen(eq=False)
class TriangularSystemBatch:
    """R factors of the whitened rows [J | r] of b problems.

    `qr.TriangularSystem` documents the members that both classes share, and why there are two.
    """

    rows: Array  # [R z; 0 ρ], upper triangular, shape (b, p+1, p+1)

    @property
    def r(self) -> Array:
        """R factors of the Jacobians, upper triangular, shape (b, p, p)."""
        return self.rows[:, :-1, :-1]

    @property
    def z(self) -> Array:
        """Right-hand sides, shape (b, p)."""
        return self.rows[:, :-1, -1]

    @property
    def cost(self) -> Array:
        """Costs at the current x, shape (b,)."""
        return _squared_norms(self.rows[:, :, -1])

    @property
    def column_norms(self) -> Array:
        """Norms of the columns of the R factors, shape (b, p)."""
        return np.sqrt(np.einsum("bij,bij->bj", self.r, self.r))

    @property
    def _norms(self) -> Array:
        """Frobenius norms of the R factors, shape (b,)."""
        return np.sqrt(np.einsum("bij,bij->b", self.r, self.r))

    @property
    def roundoff(self) -> Array:
        """Rounding errors of the rows, EPS_MODEL·‖R‖, shape (b,)."""
        return EPS_MODEL * self._norms

    def take(self, members: Array) -> TriangularSystemBatch:
        """Select problems."""
        return TriangularSystemBatch(self.rows[members])

    def assign(self, members: Array, other: TriangularSystemBatch) -> None:
        """Replace the systems of some problems in place."""
        self.rows[members] = other.rows

    def with_damping(self, diagonal: Array) -> TriangularSystemBatch:
        """Append the rows diag(diagonal)·δ = 0."""
        return TriangularSystemBatch(append_diagonal(self.rows, diagonal, np.zeros(diagonal.shape)))

    def solve(self, min_singular_value: Array | float = 0.0) -> Array:
        """Compute the minimum-norm least-squares solutions R⁺·z."""
        # Singular values below RANK_RTOL times the largest count as zero. Only matrices that may have such
        # singular values are decomposed: a solution of a few random right-hand sides bounds the condition
        # numbers.
        p = self.z.shape[1]
        size, out = self._norms, np.empty(self.z.shape)
        # The smallest diagonal element of a triangular matrix bounds its smallest singular value from above.
        diagonal = np.abs(np.diagonal(self.r, axis1=1, axis2=2))
        candidates = np.flatnonzero(diagonal.min(1) > RANK_RTOL * size)
        sides = np.empty((len(candidates), p, N_PROBES + 1))
        sides[:, :, 0], sides[:, :, 1:] = self.z[candidates], _probes(p)
        solved = solve_triangular(self.r[candidates], sides)
        condition = size[candidates] * np.sqrt(np.einsum("bps,bps->bs", solved, solved)[:, 1:].max(1))
        is_regular = (condition < MAX_CONDITION) | (min_singular_value > RANK_RTOL * size)[candidates]
        out[candidates[is_regular]] = solved[is_regular, :, 0]
        others = np.setdiff1d(np.arange(len(out)), candidates[is_regular])
        if others.size:
            u, s, vt = np.linalg.svd(self.r[others])
            is_nonzero = s > RANK_RTOL * s[:, :1]
            inverse = np.where(is_nonzero, 1 / np.where(is_nonzero, s, 1.0), 0.0)
            along = inverse[..., None] * (u.swapaxes(1, 2) @ self.z[others, :, None])
            out[others] = (vt.swapaxes(1, 2) @ along)[..., 0]
        return out

    def residual_change(self, step: Array) -> Array:
        """Compute the changes of the rows by steps, up to a rotation."""
        return (self.r @ step[..., None])[..., 0]

    def predicted_reduction(self, change: Array) -> Array:
        """Compute by how much the linear models reduce the costs."""
        return _squared_norms(self.z) - _squared_norms(change - self.z)

    def is_stationary(self, cost: Array, last_change: Array) -> Array:
        """Check whether the undamped steps of the problems (b,) are negligible, too, at costs (b,)."""
        residual_norm, roundoff = np.sqrt(cost), self.roundoff
        # No step changes the rows by more than ‖z‖.
        out = step_is_negligible(np.linalg.norm(self.z, axis=1), residual_norm, last_change, roundoff)
        others = np.flatnonzero(~out)
        if others.size:
            systems = self.take(others)
            change = np.linalg.norm(systems.residual_change(systems.solve()), axis=1)
            out[others] = step_is_negligible(
                change, residual_norm[others], last_change[others], roundoff[others]
            )
        return out


def _squared_norms(vectors: Array) -> Array:
    """Compute the squared norms of stacked vectors, shape (b,)."""
    return np.einsum("bi,bi->b", vectors, vectors)


@lru_cache(maxsize=64)
def _probes(p: int) -> Array:
    """Return random unit vectors, shape (p, N_PROBES)."""
    probes = np.random.default_rng(0).standard_normal((p, N_PROBES))
    return probes / np.linalg.norm(probes, axis=0)
