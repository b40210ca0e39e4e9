"""Stacked triangles: what `solver` and `observability` do with one, for many problems at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._kernels import r_factors
from .._typing import Array
from .qr import RANK_RTOL
from .solver import EPS_MODEL, STEP_RTOL


@dataclass(frozen=True, eq=False)
class TriangularSystems:
    """`solver.Triangle` of b members: r (b, p, p), z (b, p), rest (b,)."""

    r: Array
    z: Array
    min_cost: Array

    @classmethod
    def from_r_factors(cls, rows: Array) -> TriangularSystems:
        """From R, z and the root of the rest (b, p+1, p+1)."""
        return cls(rows[:, :-1, :-1], rows[:, :-1, -1], rows[:, -1, -1] ** 2)

    @property
    def cost(self) -> Array:
        """Sums (b,) of the squared rows that they hold."""
        return self.min_cost + np.sum(self.z**2, -1)

    def take(self, members: Array) -> TriangularSystems:
        """Those of an index (j,)."""
        return TriangularSystems(self.r[members], self.z[members], self.min_cost[members])

    def assign(self, members: Array, other: TriangularSystems) -> None:
        """Writes other ones in their places."""
        self.r[members], self.z[members], self.min_cost[members] = other.r, other.z, other.min_cost

    def with_damping(self, damping: Array) -> TriangularSystems:
        """With rows of damping (b, p) below."""
        b, p = self.z.shape
        block = np.zeros((b, p + 1, 2 * p))
        block[:, :p, :p], block[:, p, :p] = self.r.swapaxes(1, 2), self.z
        block[:, np.arange(p), np.arange(p, 2 * p)] = damping
        return factor_columns(block)

    def solve(self, min_singular_value: Array | float = 0.0) -> Array:
        """Shortest least-squares solutions (b, p), singular values cut as in `observability`.

        Args:
            min_singular_value: what no singular value is below, (b,), as far as that is known.
        """
        p = self.z.shape[1]
        size, out = _size(self.r), np.empty_like(self.z)
        # A triangle's singular values go at least as low as its diagonal.
        plain = np.flatnonzero(np.abs(np.diagonal(self.r, axis1=1, axis2=2)).min(1) > RANK_RTOL * size)
        # Some directions beside z show how near to singular it is; decompositions are for those that are.
        probes = np.random.default_rng(0).standard_normal((p, 4))
        probes /= np.linalg.norm(probes, axis=0)
        sides = np.concatenate([self.z[plain, :, None], np.tile(probes, (len(plain), 1, 1))], 2)
        found = np.linalg.solve(self.r[plain], sides)
        condition = size[plain] * np.linalg.norm(found[..., 1:], axis=1).max(1)
        good = (condition < 1e-3 / RANK_RTOL) | (min_singular_value > RANK_RTOL * size)[plain]
        out[plain[good]] = found[good, :, 0]
        rest = np.setdiff1d(np.arange(len(out)), plain[good])
        if rest.size:
            u, s, vt = np.linalg.svd(self.r[rest])
            kept = s > RANK_RTOL * s[:, :1]
            share = np.where(kept, 1 / np.where(kept, s, 1.0), 0.0)
            along = share[..., None] * (u.swapaxes(1, 2) @ self.z[rest, :, None])
            out[rest] = (vt.swapaxes(1, 2) @ along)[..., 0]
        return out

    def residual_change(self, step: Array) -> Array:
        """R·step (b, p)."""
        return (self.r @ step[..., None])[..., 0]

    def is_step_negligible(self, change: Array, cost: Array, last: Array | float = 0.0) -> Array:
        """Whether the rows will not move by anything that matters, (b,), as `solver` has it.

        Args:
            change: (b,) how far a step moves them.
            cost: (b,) before it.
            last: (b,) how far the last step moved them; zero where nothing is known of it.
        """
        enough = STEP_RTOL * np.sqrt(cost)
        shrunk = (change < 1e-2 * last) & (change**2 < 0.1 * enough * last)
        return (change <= enough) | shrunk | (change <= self.roundoff())

    def is_converged(self, cost: Array, last: Array | float = 0.0) -> Array:
        """Whether not even a plain step moves the rows by anything that matters, (b,)."""
        last = np.broadcast_to(last, cost.shape)
        # No step moves them farther than all that is left.
        out = self.is_step_negligible(np.linalg.norm(self.z, axis=1), cost, last)
        rest = np.flatnonzero(~out)
        if rest.size:
            left = self.take(rest)
            change = np.linalg.norm(left.residual_change(left.solve()), axis=1)
            out[rest] = left.is_step_negligible(change, cost[rest], last[rest])
        return out

    def roundoff(self) -> Array:
        """What the model's own rounding makes of the rows, (b,)."""
        return EPS_MODEL * _size(self.r)


def factor_columns(columns: Array) -> TriangularSystems:
    """Of whitened rows [J | r], column by column: (b, p+1, k)."""
    return TriangularSystems.from_r_factors(r_factors(np.ascontiguousarray(columns)[:, :, None]))


def _size(matrices: Array) -> Array:
    return np.sqrt(np.einsum("bij,bij->b", matrices, matrices))
