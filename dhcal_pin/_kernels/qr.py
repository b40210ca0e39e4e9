"""Triangles of tall rows by LAPACK: for installations without a compiler; see `loops`."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import lapack

from .._typing import Array
from .kinematics import apply_observation_matrix, batch_point_jacobian, point_jacobian
from .types import ObservationMatrix
from .work_arrays import UnbufferedRows, work_array

# Columns that are reduced at once where that pays.
PANEL_WIDTH = 8


# OpenBLAS has kernels for narrow products where there is AVX-512: there panels take half the time of LAPACK's
# plain reduction, elsewhere twice.
USE_PANELS = not {"AVX512F", "X86_V4"}.isdisjoint(np.show_config(mode="dicts")["SIMD Extensions"]["found"])


# From so many rows on, each reading's are reduced apart: below, the calls cost more than the arithmetic.
MIN_TALL_ROWS = 2000


def r_factor(rows: Array) -> Array:
    """Upper triangle R (c, c) of k·m rows A given as (c, k, m), RᵀR = AᵀA; they may be overwritten."""
    columns, readings, samples = rows.shape
    if readings == 1 or readings * samples < MIN_TALL_ROWS:
        return _qr(np.ascontiguousarray(rows).reshape(columns, -1))
    parts = [_factor_nonzero_columns(np.ascontiguousarray(part)) for part in rows.swapaxes(0, 1)]
    return _qr(np.concatenate(parts).T.copy())


def r_factors(rows: Array) -> Array:
    """The triangles (b, c, c) of b members' rows (b, c, k, m)."""
    b, c = rows.shape[:2]
    stacked = rows.reshape(b, c, -1)
    short = c - stacked.shape[2]
    if short > 0:
        stacked = np.concatenate([stacked, np.zeros((b, c, short))], 2)
    return np.asarray(np.linalg.qr(stacked.swapaxes(1, 2), mode="r"))


@UnbufferedRows()
def factor_jacobian(
    frames: Array, point: Array, at: Array, twists: Array, mixture: ObservationMatrix, given: Array
) -> Array:
    """Upper triangles (b, p+s, p+s) of members' rows, of which p columns follow from errors and s are given.

    The m samples of one member follow those of the one before, and all second configurations all first ones.

    Args:
        frames: (j, 7, 3, c·b·m), as `kinematics.point_velocities` takes them, and so are
        point: (3, c·b·m), and
        at: (p,).
        twists: (b, p, 6) of each member's errors.
        mixture: of the point's velocities into k rows at b·m samples.
        given: (s, k, b·m); they may be overwritten.
    """
    (s, k, n), (b, p, _) = given.shape, twists.shape
    block = work_array("rows", k, p + s, n).swapaxes(0, 1)
    velocities = work_array("velocities of errors", p, 6, point.shape[1])
    if b == 1:
        point_jacobian(frames, point, at, twists[0], velocities)
    else:
        batch_point_jacobian(frames, point, at, twists, point.shape[1] // max(n, 1), velocities)
    apply_observation_matrix(velocities, mixture, block[:p])
    block[p:] = given
    if b == 1:
        return r_factor(block)[None]
    return r_factors(np.ascontiguousarray(block.reshape(p + s, k, b, -1).transpose(2, 0, 1, 3)))


def append_diagonal(triangle: Array, diagonal: Array, right: Array) -> Array:
    """Triangle (p+1, p+1) of [R | z] and of rows diagonal·δ = right (p,) below it."""
    p = len(diagonal)
    stacked = np.zeros((p + 1, 2 * p + 1))
    stacked[:, : p + 1] = triangle.T
    # Entry i of the diagonal stands in column p + 1 + i of line i.
    stacked.reshape(-1)[p + 1 : 2 * p * (p + 1) : 2 * p + 2] = diagonal
    stacked[p, p + 1 :] = right
    return _qr(stacked)


def _factor_nonzero_columns(rows: Array) -> Array:
    """Triangle (u, c) of rows (c, m), which are overwritten, by the u columns that are not zero in all.

    Half the errors of an arm are lengths, which turn nothing: a quarter of the work for rows of rotations.
    """
    columns = len(rows)
    used, rest = np.flatnonzero(rows[:, 0]), np.flatnonzero(rows[:, 0] == 0)
    if not rest.size or rows[rest].any():
        return _qr(rows)
    out = np.zeros((len(used), columns))
    part = work_array("narrow", len(used), rows.shape[1])
    out[:, used] = _qr(np.take(rows, used, 0, out=part, mode="clip"))
    return out


def _qr(rows: Array) -> Array:
    """Upper triangle (c, c) of rows (c, n), a C-order array that LAPACK sees as (n, c) and overwrites."""
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
    return np.triu(np.ones((size, size), bool))
