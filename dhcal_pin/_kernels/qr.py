"""R factors of tall matrices by LAPACK.

A matrix A of k·m rows and c columns is given as an array (c, k, m): k residuals of m samples, columns first.
Its R factor is the upper triangular matrix with RᵀR = AᵀA; the signs of its rows are arbitrary. The
orthogonal factor is never formed. The compiled implementation in `qr.h` gives the same factor up to rounding
and signs.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from .._typing import Array
from . import lapack
from .kinematics import apply_observation_matrix, batch_point_jacobian, point_jacobian
from .types import ObservationMatrix
from .work_arrays import UnbufferedRows, work_array

# Columns per panel of the blocked factorization (dgeqrt).
PANEL_WIDTH = 8
# OpenBLAS has kernels for narrow products on processors with AVX-512. There the blocked factorization takes
# half the time of dgeqrf, elsewhere twice the time.
USE_PANELS = not {"AVX512F", "X86_V4"}.isdisjoint(np.show_config(mode="dicts")["SIMD Extensions"]["found"])
# Smallest number of rows for factoring each residual separately; with fewer rows the calls take more time
# than the arithmetic.
MIN_TALL_ROWS = 2000


def r_factor(rows: Array) -> Array:
    """Compute the R factor (c, c) of a matrix of k·m rows, shape (c, k, m), which may be overwritten."""
    columns, residuals, samples = rows.shape
    if residuals == 1 or residuals * samples < MIN_TALL_ROWS:
        return _qr(np.ascontiguousarray(rows).reshape(columns, -1))
    parts = [_factor_nonzero_columns(np.ascontiguousarray(part)) for part in rows.swapaxes(0, 1)]
    return _qr(np.concatenate(parts).T.copy())


def r_factors(rows: Array) -> Array:
    """Compute the R factors (b, c, c) of a batch of matrices of k·m rows, shape (b, c, k, m)."""
    b, c = rows.shape[:2]
    stacked = rows.reshape(b, c, -1)
    n_missing = c - stacked.shape[2]
    if n_missing > 0:
        stacked = np.concatenate([stacked, np.zeros((b, c, n_missing))], 2)
    return np.asarray(np.linalg.qr(stacked.swapaxes(1, 2), mode="r"))


@UnbufferedRows()
def factor_jacobian(
    frames: Array, point: Array, bodies: Array, twists: Array, observation: ObservationMatrix, given: Array
) -> Array:
    """Compute R factors (b, p+s, p+s) of whitened Jacobians, one per member of a batch.

    The first p columns are the Jacobian of the residuals by p errors; the other s columns are given, shape
    (s, r, b·m), and may be overwritten. The samples are ordered by configuration of the sample (first or
    second), then by member of the batch. Frames, bodies and twists are those of
    `kinematics.batch_point_jacobian`.
    """
    (s, k, n), (b, p, _) = given.shape, twists.shape
    block = work_array("rows", k, p + s, n).swapaxes(0, 1)
    jacobian = work_array("jacobian", p, 6, point.shape[1])
    if b == 1:
        point_jacobian(frames, point, bodies, twists[0], jacobian)
    else:
        batch_point_jacobian(frames, point, bodies, twists, point.shape[1] // max(n, 1), jacobian)
    apply_observation_matrix(jacobian, observation, block[:p])
    block[p:] = given
    if b == 1:
        return r_factor(block)[None]
    return r_factors(np.ascontiguousarray(block.reshape(p + s, k, b, -1).transpose(2, 0, 1, 3)))


def append_diagonal(r: Array, diagonal: Array, target: Array) -> Array:
    """Compute the R factors of [R | z] with rows diag(diagonal)·δ = target below it, for a batch.

    R has the right-hand side z in its last column, shape (b, p+1, p+1), like the result. Diagonal and target
    have shape (b, p).
    """
    b, p = diagonal.shape
    stacked = np.zeros((b, p + 1, 2 * p + 1))
    stacked[:, :, : p + 1] = r.swapaxes(1, 2)
    # `stacked` is transposed: entry i of the diagonal is at [i, p + 1 + i].
    stacked.reshape(b, -1)[:, p + 1 : 2 * p * (p + 1) : 2 * p + 2] = diagonal
    stacked[:, p, p + 1 :] = target
    return _qr(stacked[0])[None] if b == 1 else r_factors(stacked[:, :, None])


def invert_triangular(r: Array) -> Array:
    """Compute the inverse of an upper triangular matrix (p, p) whose diagonal has no zeros."""
    return lapack.dtrtri(r)[0]


def reciprocal_condition(r: Array) -> float:
    """Compute or estimate the reciprocal condition number of an upper triangular matrix in the 1-norm."""
    return lapack.dtrcon(r)[0]


def solve_triangular(r: Array, sides: Array) -> Array:
    """Solve upper triangular systems R·x = y of a batch; R has shape (b, p, p), y and x (b, p, s)."""
    return np.linalg.solve(r, sides)


def _factor_nonzero_columns(rows: Array) -> Array:
    """Compute the R factor (u, c) of rows (c, m) from their u nonzero columns; overwrite the rows.

    Half the errors of a robot are translations, which do not affect orientation residuals. Skipping these
    columns saves three quarters of the work for such rows.
    """
    columns = len(rows)
    nonzero, zero = np.flatnonzero(rows[:, 0]), np.flatnonzero(rows[:, 0] == 0)
    if not zero.size or rows[zero].any():
        return _qr(rows)
    out = np.zeros((len(nonzero), columns))
    part = work_array("nonzero columns", len(nonzero), rows.shape[1])
    out[:, nonzero] = _qr(np.take(rows, nonzero, 0, out=part, mode="clip"))
    return out


def _qr(rows: Array) -> Array:
    """Compute the R factor (c, c) of rows (c, n), which LAPACK reads as (n, c) and overwrites."""
    columns, count = rows.shape
    out = np.zeros((columns, columns))
    if not rows.size:
        return out
    if USE_PANELS:
        packed = lapack.dgeqrt(min(PANEL_WIDTH, columns, count), rows.T, overwrite_a=1)[0]
    else:
        packed = lapack.dgeqrf(rows.T, overwrite_a=1)[0]
    top = min(columns, count)
    np.copyto(out[:top], packed[:top], where=_upper(columns)[:top])
    return out


@lru_cache(maxsize=64)
def _upper(size: int) -> Array:
    """Return the mask of the upper triangle, shape (size, size)."""
    return np.triu(np.ones((size, size), bool))
