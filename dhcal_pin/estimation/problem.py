"""Least squares problems as chunks of whitened rows [J | r], reduced to one small triangle.

A chunk's rows become their triangle by QR wherever the chunk is, and triangles merge in any order, so
memory does not grow with the samples. Nothing here knows a kind of measurement or a set by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from .._kernels import error_triangles, mix_velocities
from .._kernels.types import Mixture, Motion, Sweep
from .._kernels.work_arrays import LongRows, scratch
from .._typing import Array
from ..measurements.base import Measurement, Unknown
from ..parallel import HERE, Workers
from ..robot.chain import Chain
from .error_model import ErrorModel
from .qr import Triangle, finished
from .scale_gauge import Ruler, count_in_arm

# Samples a chunk.
CHUNK = 2000


_Found = TypeVar("_Found")


@dataclass(frozen=True, eq=False)
class Problem:
    """What is unknown and what was measured.

    The unknowns x are the p errors of the robot, then the s unknowns of the instruments as differences
    from where they start; instruments share what they name alike.

    Attributes:
        errors: the nominal chain and its p errors.
        data: measurements, any mixture of kinds.
        weights: (p+s,) one over the prior's sigma; zero where there is none.
        known: values of instruments' unknowns, by name, that are no unknowns here.
        where: what the chunks are shared out to; their order, and so every digit, stays.
        bounds: (2, p+s) least and largest x; None where nothing is bounded.
    """

    errors: ErrorModel
    data: tuple[Measurement, ...]
    weights: Array
    known: Mapping[str, float] = field(default_factory=dict)
    where: Workers = HERE
    bounds: Array | None = None

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """The instruments' s unknowns, each once."""
        return tuple(u for u in shared_unknowns(self.data) if u.name not in self.known)

    def instruments(self, x: Array) -> dict[str, float]:
        """The values of all the instruments' unknowns at x, by name."""
        found = x[len(self.errors.parameters) :]
        return {u.name: u.nominal + float(v) for u, v in zip(self.unknowns, found, strict=True)} | dict(
            self.known
        )

    def values(self, item: Measurement, x: Array) -> Array:
        """The values u of a measurement's unknowns at x."""
        every = self.instruments(x)
        return np.array([every[unknown.name] for unknown in item.unknowns])

    def tangent(self, x: Array) -> Tangent:
        """The model at x (p+s,), ready for any chunk of data."""
        robot = len(self.errors.parameters)
        places = {unknown.name: robot + i for i, unknown in enumerate(self.unknowns)}
        model = self.errors.derivative(x[:robot])
        size, rates = 1.0, np.zeros((robot, 4))
        if self.ruler:
            size, rates = self.ruler.size(model[0]), self.ruler.rates(*model)
        return Tangent(*model, self.instruments(x), places, size, rates)

    @cached_property
    def ruler(self) -> Ruler | None:
        """What tells the arm's size, which readings without a length are counted in, if there are any."""
        plain = [item for item in self.data if not item.metric and len(item.rows)]
        if not plain or any(unknown.name in self.known for item in plain for unknown in item.unknowns):
            return None
        return Ruler.of(self.errors.chain, np.concatenate([item.q for item in plain]))

    def of(self, data: Sequence[Measurement]) -> Problem:
        """The same problem with some or other samples of the same measurements, or with other sigmas."""
        out = replace(self, data=tuple(data))
        vars(out)["ruler"] = self.ruler
        if "chunks" not in vars(self) or len(data) != len(self.data):
            return out
        pairs = list(zip(self.data, data, strict=True))
        if all(old is new for old, new in pairs):
            vars(out)["chunks"] = self.chunks
        elif all(old.configurations() is new.configurations() for old, new in pairs):
            for old, new in zip(self.chunks, out.chunks, strict=True):
                new.moves_like(old)
        return out

    @cached_property
    def chunks(self) -> tuple[Chunk, ...]:
        """The data in pieces of at most CHUNK samples."""
        return tuple(
            Chunk(item.take(np.s_[start : start + CHUNK]), self.errors.chain)
            for item in self.data
            for start in range(0, len(item.rows), CHUNK)
        )

    def held(self, weights: Array) -> Problem:
        """The same data with other priors."""
        out = replace(self, weights=weights)
        vars(out).update(chunks=self.chunks, ruler=self.ruler)
        return out

    def free(self, x: Array) -> Array:
        """Which unknowns (p+s,) are not pressed against a bound at x."""
        if self.bounds is None:
            return np.ones(len(x), bool)
        return ~np.any(np.abs(self.bounds - x) <= 1e-12, 0)

    def cost(self, x: Array) -> float:
        """Sum of squared whitened residuals and priors at x (p,)."""
        chain = self.errors.at(x[: len(self.errors.parameters)])
        size = self.ruler.size(chain) if self.ruler else 1.0
        costs = self.each(partial(_cost, chain, self.instruments(x), size))
        return sum(costs, float(np.sum((self.weights * x) ** 2)))

    def each(self, function: Callable[[Chunk], _Found]) -> Iterator[_Found]:
        """What a function finds in each chunk, in order."""
        return self.where.map(function, self.chunks)


@dataclass(frozen=True, eq=False)
class Chunk:
    """Some samples of one measurement, and their joints' motion, which every x shares.

    Attributes:
        data: the samples.
        nominal: the chain that they belong to; errors of it do not matter here.
    """

    data: Measurement
    nominal: Chain

    @cached_property
    def motion(self) -> Motion:
        """Of the samples' configurations."""
        return self.nominal.motion(self.data.configurations())

    def moves_like(self, other: Chunk) -> None:
        """Takes over the motion of a chunk at the same joint values, if that is known there."""
        if "motion" in vars(other):
            vars(self)["motion"] = other.motion

    def sweep(self, chain: Chain) -> Sweep:
        """A chain's frames at the samples, in memory that the next chunk's overwrite."""
        k, m = self.motion.values.shape
        return chain.sweep(self.motion, scratch("sweep", k + 2, 7, 3, m))

    def unknowns(self, instruments: Mapping[str, float]) -> Array:
        """The values u of the measurement's unknowns among all the instruments'."""
        return np.array([instruments[unknown.name] for unknown in self.data.unknowns])


@dataclass(frozen=True, eq=False)
class Tangent:
    """A problem's model at one x. It holds no data, so it goes to wherever a chunk of them is.

    Attributes:
        chain: with its errors at x.
        bodies, twists: (e,), (e, 6): what each of the e errors moves, as `Chain.tool_velocities` takes it.
        instruments: values of all the instruments' unknowns by name.
        places: where those of them that are unknown here stand in x.
        size, rates: of the arm, and how fast it grows and turns with each error (e, 4); see `scale`.
    """

    chain: Chain
    bodies: Array
    twists: Array
    instruments: Mapping[str, float]
    places: Mapping[str, int]
    size: float
    rates: Array

    def triangle(self, chunk: Chunk, small_angle: bool) -> Array:
        """Triangle (p+1, p+1) of a chunk's whitened rows [J | r]; exact or by the paper's rows."""
        data, sweep = chunk.data, chunk.sweep(self.chain)
        # Rows by twists are worked out on their way into the triangle, unless they are changed before.
        plain = int(np.searchsorted(self.bodies, len(sweep.frames))) if data.metric else 0
        given = scratch("given", data.size, self._columns - plain, len(data.rows)).swapaxes(0, 1)
        mixture = self._fill(given, chunk, sweep, small_angle)
        twists = self.twists[None, :plain]
        return error_triangles(sweep.frames, sweep.tool[3], self.bodies[:plain], twists, mixture, given)[0]

    def rows(self, chunk: Chunk) -> Array:
        """A chunk's whitened rows [J | r] (p+1, k, m)."""
        out = np.empty((self._columns, chunk.data.size, len(chunk.data.rows)))
        self._fill(out, chunk, chunk.sweep(self.chain), False)
        return out

    @property
    def _columns(self) -> int:
        return len(self.bodies) + len(self.places) + 1

    @LongRows()
    def _fill(self, block: Array, chunk: Chunk, sweep: Sweep, small_angle: bool) -> Mixture:
        """Fills in the last columns of the rows, as many as the block has; tells what makes the others."""
        data, u = chunk.data, chunk.unknowns(self.instruments)
        if small_angle:
            block[-1], mixture = data.small_angle(sweep, u)
        else:
            block[-1] = data.residual(sweep, u)
            mixture = data.mixture(sweep, u, block[-1])
        first = self._columns - len(block)
        errors = len(self.bodies) - first
        if errors:
            velocities = scratch("velocities", errors, 6, sweep.tool.shape[-1])
            self.chain.tool_velocities(sweep, self.bodies[first:], self.twists[first:], velocities)
            mix_velocities(velocities, mixture, block[:errors])
        block[errors:-1] = 0.0
        own = data.own(sweep, u) if data.unknowns else ()
        for unknown, rows in zip(data.unknowns, own, strict=True):
            if unknown.name in self.places:
                block[self.places[unknown.name] - first] = rows
        if not data.metric:
            count_in_arm(block, self.size, self.rates, data.groups.get("position"))
        return mixture


def residual_of(chain: Chain, instruments: Mapping[str, float], chunk: Chunk) -> Array:
    """A chunk's whitened residuals (k, m) for a chain and values of all the instruments' unknowns."""
    return chunk.data.residual(chunk.sweep(chain), chunk.unknowns(instruments))


def _cost(chain: Chain, instruments: Mapping[str, float], size: float, chunk: Chunk) -> float:
    residual = residual_of(chain, instruments, chunk)
    square = float(np.vdot(residual, residual))
    return square if chunk.data.metric else square / size**2


def _triangle(tangent: Tangent, small_angle: bool, chunk: Chunk) -> Array:
    return tangent.triangle(chunk, small_angle)


def shared_unknowns(data: Sequence[Measurement]) -> tuple[Unknown, ...]:
    """The unknowns of several measurements, each once; a start that is NaN gives way to one that is not."""
    found: dict[str, Unknown] = {}
    for item in data:
        for unknown in item.unknowns:
            if unknown.name not in found or math.isnan(found[unknown.name].nominal):
                found[unknown.name] = unknown
    return tuple(
        replace(unknown, nominal=0.0) if math.isnan(unknown.nominal) else unknown
        for unknown in found.values()
    )


def reduce(problem: Problem, x: Array, small_angle: bool) -> Triangle:
    """The data's triangle at x (p,), without the priors; exact or by the paper's rows."""
    return finished(problem.each(partial(_triangle, problem.tangent(x), small_angle)), len(x))
