"""Least squares problems as chunks of whitened rows [J | r], reduced to one small triangle.

A chunk's rows become their triangle by QR wherever the chunk is, and triangles merge in any order, so
memory does not grow with the samples. Nothing here knows a kind of measurement or a set by name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from .chain import Chain, Motion
from .measurements import Measurement, Unknown
from .parameters import ErrorModel
from .se3 import Array

CHUNK = 4096


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
    """

    errors: ErrorModel
    data: tuple[Measurement, ...]
    weights: Array
    known: Mapping[str, float] = field(default_factory=dict)

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
        return Tangent(*self.errors.derivative(x[:robot]), self.instruments(x), places)

    @cached_property
    def chunks(self) -> tuple[Chunk, ...]:
        """The data in pieces of at most CHUNK samples."""
        return tuple(
            Chunk(item.take(np.s_[start : start + CHUNK]), self.errors.chain)
            for item in self.data
            for start in range(0, len(item.rows), CHUNK)
        )

    def cost(self, x: Array) -> float:
        """Sum of squared whitened residuals and priors at x (p,)."""
        chain = self.errors.at(x[: len(self.errors.parameters)])
        total = float(np.sum((self.weights * x) ** 2))
        for chunk in self.chunks:
            residual = chunk.data.residual(chain.sweep(chunk.motion), self.values(chunk.data, x))
            total += float(np.sum(residual**2))
        return total


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


@dataclass(frozen=True, eq=False)
class Tangent:
    """A problem's model at one x. It holds no data, so it goes to wherever a chunk of them is.

    Attributes:
        chain: with its errors at x.
        bodies, twists: (e,), (e, 6): what each of the e errors moves, as `Chain.tool_velocities` takes it.
        instruments: values of all the instruments' unknowns by name.
        places: where those of them that are unknown here stand in x.
    """

    chain: Chain
    bodies: Array
    twists: Array
    instruments: Mapping[str, float]
    places: Mapping[str, int]

    def triangle(self, chunk: Chunk, small_angle: bool) -> Array:
        """Triangle (p+1, p+1) of a chunk's whitened rows [J | r]; exact or by the paper's rows."""
        data, errors = chunk.data, len(self.bodies)
        p = errors + len(self.places)
        sweep = self.chain.sweep(chunk.motion)
        u = np.array([self.instruments[unknown.name] for unknown in data.unknowns])
        velocities = self.chain.tool_velocities(sweep, self.bodies, self.twists)
        if small_angle:
            residual, rows = data.small_angle(sweep, velocities, u)
        else:
            residual, rows = data.residual(sweep, u), data.whiten(sweep, velocities, u)
        block = np.zeros((p + 1, residual.size))
        block[:errors] = rows.reshape(errors, residual.size)
        for unknown, row in zip(data.unknowns, data.own(sweep, u), strict=True):
            if unknown.name in self.places:
                block[self.places[unknown.name]] = row.reshape(-1)
        block[p] = residual.reshape(-1)
        return qr(block)


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


@dataclass(frozen=True, eq=False)
class Triangle:
    """QR of the whitened [J | r] at one x: ‖J·δ - r‖² = ‖R·δ - z‖² + rest.

    Attributes:
        r: (p, p) upper triangular, of the data alone.
        z: (p,) right-hand side.
        rest: the part of the cost that no step removes.
    """

    r: Array
    z: Array
    rest: float


def qr(rows: Array) -> Array:
    """Upper triangle (c, c) of rows (c, k), a C-order array that LAPACK sees as (k, c)."""
    columns, count = rows.shape
    out = np.zeros((columns, columns))
    if count == 0:
        return out
    packed = lapack.dgeqrf(rows.T, overwrite_a=1)[0]
    top = min(columns, count)
    out[:top] = np.triu(packed[:top])
    return out


def merge(first: Array, second: Array) -> Array:
    """The triangle (c, c) of the rows of two triangles (c, c), which may come from anywhere."""
    return qr(np.concatenate([first, second]).T.copy())


def reduce(problem: Problem, x: Array, small_angle: bool) -> Triangle:
    """The data's triangle at x (p,), without the priors; exact or by the paper's rows."""
    tangent = problem.tangent(x)
    return finished((tangent.triangle(chunk, small_angle) for chunk in problem.chunks), len(x))


def finished(triangles: Iterable[Array], p: int) -> Triangle:
    """All chunks' triangles (p+1, p+1) in one; memory holds one of them and the one that comes next."""
    merged = None
    for triangle in triangles:
        merged = triangle if merged is None else merge(merged, triangle)
    if merged is None:
        merged = np.zeros((p + 1, p + 1))
    return Triangle(merged[:p, :p], merged[:p, p], float(merged[p, p] ** 2))
