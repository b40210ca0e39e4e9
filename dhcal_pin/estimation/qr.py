"""What the data see, in numbers: rank, unseen and weakly seen directions, observability indices.

All of it comes from the triangle of a QR; the words are in `explanations`.

The triangle is R of the QR of the whitened Jacobian, metres and radians in its columns. Nothing here
forms JᵀJ: at condition 1e7 that is wrong in the third digit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from .._kernels import append_diagonal, r_factor
from .._typing import Array

# Singular values below this share of the largest are rounding. The paper's arms keep what they see
# above 1e-4; a cut of 1e-3 or more would already block its loop.
RANK_RTOL = 1e-9


def singular_values(triangle: Array) -> Array:
    """Singular values (p,) of a triangle (p, p), falling."""
    return np.linalg.svd(triangle, compute_uv=False)


def row_space(triangle: Array) -> Array:
    """Orthonormal basis (rank, p) of the directions in parameter space that the data see."""
    _, s, vt = np.linalg.svd(triangle)
    return vt[: int(np.sum(s > RANK_RTOL * s[0]))] if s.size and s[0] > 0 else vt[:0]


def rank(triangle: Array) -> int:
    """Number of independent directions that the data see."""
    return len(row_space(triangle))


def condition(triangle: Array) -> float:
    """Largest over smallest singular value among the seen directions; 0 if there is none."""
    s = singular_values(triangle)
    seen = s[s > RANK_RTOL * s[0]] if s.size else s
    return float(seen[0] / seen[-1]) if seen.size else 0.0


def null_space(triangle: Array) -> Array:
    """Orthonormal basis (p, d) of the directions in parameter space that the data do not see."""
    return np.linalg.svd(triangle)[2][rank(triangle) :].T


@dataclass(frozen=True, eq=False)
class TriangularSystem:
    """QR of the whitened [J | r] at one x: ‖J·δ - r‖² = ‖R·δ - z‖² + rest.

    Attributes:
        rows: (p+1, p+1) upper triangular, R and z with the root of the rest below z.
    """

    rows: Array

    @property
    def r(self) -> Array:
        """(p, p) upper triangular, of the data alone."""
        return self.rows[:-1, :-1]

    @property
    def z(self) -> Array:
        """(p,) right-hand side."""
        return self.rows[:-1, -1]

    @property
    def min_cost(self) -> float:
        """The part of the cost that no step removes."""
        return float(self.rows[-1, -1] ** 2)

    @property
    def cost(self) -> float:
        """Sum of the squared rows, at no step."""
        return float(np.vdot(self.rows[:, -1], self.rows[:, -1]))

    def recentered(self, step: Array) -> TriangularSystem:
        """As it is seen from a step (p,) ahead, where that is too small to bend the model."""
        rows = self.rows.copy()
        rows[:-1, -1] -= self.r @ step
        return TriangularSystem(rows)


def merge_r_factors(factors: Sequence[Array]) -> Array:
    """The triangle (c, c) of the rows of several (u, c), which may come from anywhere."""
    return r_factor(np.concatenate(factors).T[:, None].copy())


def combine_r_factors(factors: Iterable[Array], p: int) -> TriangularSystem:
    """All chunks' triangles (p+1, p+1) in one; memory holds one of them and the one that comes next."""
    whole = None
    for triangle in factors:
        whole = triangle if whole is None else merge_r_factors((whole, triangle))
    if whole is None:
        whole = np.zeros((p + 1, p + 1))
    return TriangularSystem(whole)


# A triangle with such a reciprocal condition has no singular value near the cut, however large it is.
WELL_CONDITIONED = 1e3 * RANK_RTOL


def append_rows(triangle: TriangularSystem, diagonal: Array, right: Array) -> TriangularSystem:
    """The triangle with rows diagonal·δ = right (p,) below it."""
    return TriangularSystem(append_diagonal(triangle.rows, diagonal, right)) if diagonal.any() else triangle


def append_priors(triangle: TriangularSystem, weights: Array, x: Array | float) -> TriangularSystem:
    """The triangle with prior rows -x/σ below it."""
    return append_rows(triangle, weights, -(weights * x))


def _is_well_conditioned(r: Array) -> bool:
    """Whether no singular value of a triangle (p, p) can be near the cut."""
    return bool(r.size) and lapack.dtrcon(r)[0] > WELL_CONDITIONED


def pseudo_inverse(r: Array, z: Array) -> Array:
    """Shortest least-squares solution of R·δ = z, singular values cut as in `observability`."""
    # Far from the cut there is one solution, and the triangle gives it a hundred times as fast.
    if _is_well_conditioned(r):
        return lapack.dtrtrs(r, z)[0]
    return np.linalg.lstsq(r, z, rcond=RANK_RTOL)[0]


def posterior_sqrt_covariance(triangle: TriangularSystem, weights: Array) -> tuple[Array, Array]:
    """A root (p, r) of the covariance with priors of these weights (p,), and a basis (p, p-r) of the rest.

    The rest are directions that neither data nor a prior tell.
    """
    full = append_priors(triangle, weights, 0.0).r
    if _is_well_conditioned(full):
        return lapack.dtrtri(full)[0], np.empty((len(weights), 0))
    # However exact the data are, what they do not see is the priors' to tell: by what is seen and what not.
    _, s, vt = np.linalg.svd(triangle.r)
    count = int(np.sum(s > RANK_RTOL * s[0]))
    seen, unseen = vt[:count].T, vt[count:].T
    left, t, yt = np.linalg.svd(weights[:, None] * unseen)
    told = t > RANK_RTOL * weights.max(initial=0.0)
    left, across = left[:, : len(t)][:, told], unseen @ (yt[told].T / t[told])
    priors = weights[:, None] * seen
    rows = np.concatenate([np.diag(s[:count]), priors - left @ (left.T @ priors)])
    along = lapack.dtrtri(np.linalg.qr(rows)[1])[0]
    root = np.concatenate([(seen - across @ (left.T @ priors)) @ along, across], 1)
    return root, unseen @ np.delete(yt, np.flatnonzero(told), 0).T
