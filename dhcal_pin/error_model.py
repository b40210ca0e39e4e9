"""A chain's unknown errors: each is a twist at a station, some scaled by what the joint does.

Changes at one station act in the order of the list, M ← M·exp(x₁ξ₁)·exp(x₂ξ₂)…, so a parameter's value
is always its whole error from the nominal chain, DH's changes are exact (its rotations and translations
about one axis commute), and the derivative at any value is a twist again. A scaled one, such as a gain or
a compliance, is an entry of the chain's transmission: its twist is the joint's own, times a term of the
joint's value and load.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from . import se3
from .chain import BASE, Chain
from .loops import carry_twists
from .se3 import Array
from .stations import bodies_at, frames_before
from .transmission import Transmission

_IDENTITY = np.eye(4)


@dataclass(frozen=True)
class Parameter:
    """One scalar error.

    Attributes:
        name: what users call it, as `d2` or `elbow_joint.rx`.
        unit: "m" or "rad"; of a scaled one "1", "rad", "rad/Nm", "rad/rad", "rad/m".
        nominal: the value that a drawing would show; zero for a pure error.
        station: where it acts (see `chain`).
        twist: (6,) [v, ω] in the station's frame.
        prior: standard deviation expected before any measurement, in its unit.
        entry: of a scaled one, where its coefficient stands in the transmission's flat coefficients.
    """

    name: str
    unit: str
    nominal: float
    station: int
    twist: tuple[float, ...]
    prior: float
    entry: int | None = None


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """A nominal chain and p unknown errors, sorted by station.

    Attributes:
        chain: nominal.
        parameters: (p,) the unknowns.
        fixed: parameters of the same sets that are held at nominal.
    """

    chain: Chain
    parameters: tuple[Parameter, ...]
    fixed: tuple[Parameter, ...] = ()

    @cached_property
    def _geometry(self) -> int:
        """How many parameters, the first ones, are plain twists."""
        return sum(parameter.entry is None for parameter in self.parameters)

    @cached_property
    def _entries(self) -> Array:
        return np.array([p.entry for p in self.parameters if p.entry is not None], int)

    @property
    def is_driven(self) -> bool:
        """Whether its joints may miss their values."""
        return bool(self._entries.size) or self.chain.transmission is not None

    @cached_property
    def _twists(self) -> Array:
        return np.array([parameter.twist for parameter in self.parameters]).reshape(-1, 6)[: self._geometry]

    @cached_property
    def _stations(self) -> Array:
        return np.array([parameter.station for parameter in self.parameters], int)[: self._geometry]

    @cached_property
    def _bodies(self) -> Array:
        return bodies_at(self.chain, self._stations)

    @property
    def priors(self) -> Array:
        """Prior standard deviations (p,), each in its parameter's unit."""
        return np.array([parameter.prior for parameter in self.parameters])

    @cached_property
    def _slots(self) -> tuple[Array, Array, Array]:
        """Stations with unknowns (g,), and each parameter's place among them (p,) and at its station (p,)."""
        stations, group = np.unique(self._stations, return_inverse=True)
        return stations, group, np.arange(len(group)) - np.searchsorted(group, group)

    @cached_property
    def _most(self) -> int:
        """The most parameters at a station, at least one."""
        return int(self._slots[2].max(initial=0)) + 1

    @cached_property
    def _powers(self) -> tuple[Array, Array]:
        """Sizes of the rotations (p,), and the twists as matrices Ξ, Ξ²/|ω|², Ξ³/|ω|³ (p, 3, 16)."""
        twist = np.zeros((len(self._twists), 4, 4))
        twist[:, :3, :3], twist[:, :3, 3] = se3.skew(self._twists[:, 3:]), self._twists[:, :3]
        size = np.linalg.norm(self._twists[:, 3:], axis=1)
        unit = twist / np.where(size > 0, size, 1.0)[:, None, None]
        powers = np.stack([twist, unit @ unit, unit @ unit @ unit], 1)
        return size, powers.reshape(-1, 3, 16)

    def _factors(self, x: Array) -> Array:
        """The parameters' motions exp(xξ), in the order of their stations (g, most a station, 4, 4)."""
        size, powers = self._powers
        angle = size * x
        # exp(xξ) = I + xΞ + (1 - cos)(Ξ/|ω|)² + (angle - sin)(Ξ/|ω|)³, and I + xΞ for a translation.
        share = np.empty((len(x), 1, 3))
        share[:, 0, 0], share[:, 0, 1] = x, 2 * np.sin(0.5 * angle) ** 2
        share[:, 0, 2] = angle - np.sin(angle)
        motion = (share @ powers).reshape(-1, 4, 4) + _IDENTITY
        stations, group, place = self._slots
        out = np.empty((len(stations), self._most, 4, 4))
        out[:] = _IDENTITY
        out[group, place] = motion
        return out

    def at(self, x: Array) -> Chain:
        """The chain with errors x (p,) in SI; its joints yield to the nominal arm's masses."""
        factors = self._factors(np.asarray(x, float)[: self._geometry])
        every = self._every(functools.reduce(np.matmul, np.swapaxes(factors, 0, 1)))
        return self._driven(self.chain.moved(every), x)

    def _every(self, motions: Array) -> Array:
        """Motions of all stations (2k+4, 4, 4) from those of the stations with unknowns (g, 4, 4)."""
        every = np.empty((self.chain.tool_station + 1, 4, 4))
        every[:] = _IDENTITY
        every[self._slots[0]] = motions
        return every

    def _driven(self, chain: Chain, x: Array) -> Chain:
        """A chain with the transmission at x (p,)."""
        if not self._entries.size:
            return chain
        held = self._transmission.changed(self._entries, x[self._geometry :])
        return chain.driven(held)

    @cached_property
    def _transmission(self) -> Transmission:
        return self.chain.transmission or Transmission.ideal(self.chain.loads)

    def loaded(self, x: Array) -> ErrorModel:
        """The same unknowns, with joints that yield to the masses as they are placed at x."""
        held = replace(self._transmission, loads=self.at(x).loads)
        return replace(self, chain=self.chain.driven(held))

    def derivative(self, x: Array) -> tuple[Chain, Array, Array]:
        """The chain at x, and for each parameter the body (p,) and twist (p, 6) it moves there.

        The k-th factor at a station turns with those before it, seen from the station as it was before all of
        them. Entries of the transmission come last, numbered behind the bodies (see `Chain.tool_velocities`).
        """
        x = np.asarray(x, float)
        factors = self._factors(x[: self._geometry])
        _, group, place = self._slots
        before = np.empty((len(factors), self._most + 1, 4, 4))
        before[:, 0] = _IDENTITY
        for i in range(self._most):
            np.matmul(before[:, i], factors[:, i], out=before[:, i + 1])
        every = self._every(before[:, -1])
        chain = self._driven(self.chain.moved(every), x)
        frames = frames_before(self.chain, every, chain)[self._stations]
        twists = carry_twists(frames @ before[group, place], self._twists)
        bodies = self._bodies
        if not self._entries.size:
            return chain, bodies, twists
        entries = len(chain.moving) + 1 + self._entries
        return chain, np.concatenate([bodies, entries]), np.pad(twists, ((0, len(entries)), (0, 0)))

    def joined(self, parameters: Iterable[Parameter]) -> ErrorModel:
        """With more unknowns, each where it belongs: by station, entries of the transmission last."""
        both = (*self.parameters, *parameters)
        ordered = sorted(both, key=lambda p: (-1 if p.entry is None else p.entry, p.station))
        return replace(self, parameters=tuple(ordered))

    def frames(self) -> ErrorModel | None:
        """Base and tool alone, if any of them is unknown."""
        outside = (BASE, self.chain.tool_station)
        kept = tuple(p for p in self.parameters if p.station in outside)
        return replace(self, parameters=kept) if kept else None
