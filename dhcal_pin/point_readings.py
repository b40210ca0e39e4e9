"""What the kinds that read nothing but where the tool point is have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from .chain import Chain
from .kinematics import Mixture, Sweep
from .measurements import Unknown
from .se3 import Array


@dataclass(frozen=True, eq=False)
class PointReading:
    """A reading that depends on where the tool point is, in one or two configurations, and on nothing else.

    A kind derives from it and gives `model`; the rest follows.

    Attributes:
        q: (m, n) joint values, rad or m.
        reading: (m, k) m.
        sigma: (m, k) standard deviations, m.
        rows: (m,) row numbers.
        stated: whether sigma is the instrument's own.
        unknowns: (s,).
    """

    q: Array
    reading: Array
    sigma: Array
    rows: Array
    stated: bool
    unknowns: tuple[Unknown, ...]

    kind: ClassVar[str]
    groups: ClassVar[Mapping[str, slice]]
    columns: ClassVar[Mapping[str, str]]
    needs: ClassVar[tuple[frozenset[str], ...]]
    ends: ClassVar[int] = 1
    touches: ClassVar[bool] = False
    metric: ClassVar[bool] = True
    # Fields with an entry a sample.
    per_row: ClassVar[tuple[str, ...]] = ("q", "reading", "sigma", "rows")

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Modelled reading (k, m) of tool points (c, 3, m), its derivatives (c, k, 3, m) and (s, k, m)."""
        raise NotImplementedError

    def reads(self) -> tuple[str, ...]:
        """The columns of the reading, as many as it has."""
        return tuple(name for name, what in self.columns.items() if what == "length" and "sigma" not in name)

    def to_columns(self) -> dict[str, Any]:
        """The reading's columns, and their sigmas where these are the instrument's own."""
        names = self.reads()
        out = {name: self.reading[:, i] for i, name in enumerate(names)}
        if self.stated:
            out |= {f"sigma_{name}": self.sigma[:, i] for i, name in enumerate(names)}
        return out

    def configurations(self) -> Array:
        """As they are, (m, n)."""
        return self.q

    @property
    def size(self) -> int:
        """As many as the reading has columns."""
        return self.reading.shape[1]

    @cached_property
    def _weights(self) -> Array:
        """One over sigma, (k, m)."""
        return 1 / np.ascontiguousarray(self.sigma.T)

    @cached_property
    def _reading(self) -> Array:
        """(k, m), the samples last in memory."""
        return np.ascontiguousarray(self.reading.T)

    def _points(self, sweep: Sweep) -> Array:
        m = len(self.rows)
        return sweep.tool[3].reshape(3, -1, m).transpose(1, 0, 2) if m else np.empty((1, 3, 0))

    def started(self, chain: Chain) -> Self:
        """Nothing to start."""
        return self

    def residual(self, sweep: Sweep, u: Array) -> Array:
        """(k, m)."""
        return (self._reading - self.model(self._points(sweep), u)[0]) * self._weights

    def mixture(self, sweep: Sweep, u: Array, residual: Array) -> Mixture:
        """By what the reading depends on."""
        derivative = self.model(self._points(sweep), u)[1].swapaxes(0, 1)
        row, end, axis = np.nonzero(derivative.any(-1))
        return Mixture(row, 6 * end + axis, derivative[row, end, axis] * self._weights[row])

    def own(self, sweep: Sweep, u: Array) -> Array:
        """(s, k, m)."""
        return self.model(self._points(sweep), u)[2] * self._weights

    def small_angle(self, sweep: Sweep, u: Array) -> tuple[Array, Mixture]:
        """The same rows: there is no rotation in them."""
        residual = self.residual(sweep, u)
        return residual, self.mixture(sweep, u, residual)

    def errors(self, sweep: Sweep, u: Array) -> dict[str, Array]:
        """{group: (m, k)} in m."""
        return {name: (self.residual(sweep, u) * self.sigma.T)[rows].T for name, rows in self.groups.items()}

    def positions(self) -> Array:
        """None, (0, 3)."""
        return np.empty((0, 3))

    def rotations(self) -> Array:
        """None, (0, 3, 3)."""
        return np.empty((0, 3, 3))

    def scaled(self, scales: Mapping[str, float]) -> Self:
        """The same readings with sigmas multiplied."""
        (scale,) = scales.values()
        return replace(self, sigma=self.sigma * scale)

    def weighted(self, weights: Array) -> Self:
        """The same readings with each sample counting for a weight (m,), by wider sigmas."""
        return replace(self, sigma=self.sigma / np.sqrt(weights)[:, None])

    def take(self, index: Array | slice) -> Self:
        """The samples of an index or mask."""
        return replace(self, **{name: getattr(self, name)[index] for name in self.per_row})
