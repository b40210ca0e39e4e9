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

from .._kernels import apply_observation_matrix, factor_jacobian
from .._kernels.types import FrameBatch, JointState, ObservationMatrix
from .._kernels.work_arrays import UnbufferedRows, work_array
from .._typing import Array
from ..measurements.base import InstrumentParameter, Measurement
from ..parallel import SERIAL, TaskExecutor
from ..robot.chain import Chain
from .error_model import ErrorModel
from .qr import TriangularSystem, combine_r_factors
from .scale_gauge import ScaleGauge, normalize_by_scale

# Samples a chunk.
CHUNK_SIZE = 2000


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
        executor: what the chunks are shared out to; their order, and so every digit, stays.
        bounds: (2, p+s) least and largest x; None where nothing is bounded.
    """

    errors: ErrorModel
    data: tuple[Measurement, ...]
    weights: Array
    known: Mapping[str, float] = field(default_factory=dict)
    executor: TaskExecutor = SERIAL
    bounds: Array | None = None

    @cached_property
    def instrument_parameters(self) -> tuple[InstrumentParameter, ...]:
        """The instruments' s unknowns, each once."""
        return tuple(u for u in merge_instrument_parameters(self.data) if u.name not in self.known)

    def instruments(self, x: Array) -> dict[str, float]:
        """The values of all the instruments' unknowns at x, by name."""
        found = x[len(self.errors.parameters) :]
        return {
            u.name: u.nominal + float(v) for u, v in zip(self.instrument_parameters, found, strict=True)
        } | dict(self.known)

    def instrument_values_of(self, item: Measurement, x: Array) -> Array:
        """The values u of a measurement's unknowns at x."""
        every = self.instruments(x)
        return np.array([every[unknown.name] for unknown in item.instrument_parameters])

    def linearize(self, x: Array) -> Linearization:
        """The model at x (p+s,), ready for any chunk of data."""
        robot = len(self.errors.parameters)
        places = {unknown.name: robot + i for i, unknown in enumerate(self.instrument_parameters)}
        model = self.errors.derivative(x[:robot])
        size, rates = 1.0, np.zeros((robot, 4))
        if self.scale_gauge:
            size, rates = self.scale_gauge.size(model[0]), self.scale_gauge.rates(*model)
        return Linearization(*model, self.instruments(x), places, size, rates)

    @cached_property
    def scale_gauge(self) -> ScaleGauge | None:
        """What tells the arm's size, which readings without a length are counted in, if there are any."""
        plain = [item for item in self.data if not item.has_length_scale and len(item.rows)]
        if not plain or any(
            unknown.name in self.known for item in plain for unknown in item.instrument_parameters
        ):
            return None
        return ScaleGauge.from_configurations(self.errors.chain, np.concatenate([item.q for item in plain]))

    def with_data(self, data: Sequence[Measurement]) -> Problem:
        """The same problem with some or other samples of the same measurements, or with other sigmas."""
        out = replace(self, data=tuple(data))
        vars(out)["scale_gauge"] = self.scale_gauge
        if "chunks" not in vars(self) or len(data) != len(self.data):
            return out
        pairs = list(zip(self.data, data, strict=True))
        if all(old is new for old, new in pairs):
            vars(out)["chunks"] = self.chunks
        elif all(old.configurations() is new.configurations() for old, new in pairs):
            for old, new in zip(self.chunks, out.chunks, strict=True):
                new.reuse_joint_state(old)
        return out

    @cached_property
    def chunks(self) -> tuple[Chunk, ...]:
        """The data in pieces of at most CHUNK samples."""
        return tuple(
            Chunk(item.take(np.s_[start : start + CHUNK_SIZE]), self.errors.chain)
            for item in self.data
            for start in range(0, len(item.rows), CHUNK_SIZE)
        )

    def with_prior_weights(self, weights: Array) -> Problem:
        """The same data with other priors."""
        out = replace(self, weights=weights)
        vars(out).update(chunks=self.chunks, scale_gauge=self.scale_gauge)
        return out

    def is_interior(self, x: Array) -> Array:
        """Which unknowns (p+s,) are not pressed against a bound at x."""
        if self.bounds is None:
            return np.ones(len(x), bool)
        return ~np.any(np.abs(self.bounds - x) <= 1e-12, 0)

    def cost(self, x: Array) -> float:
        """Sum of squared whitened residuals and priors at x (p,)."""
        chain = self.errors.at(x[: len(self.errors.parameters)])
        size = self.scale_gauge.size(chain) if self.scale_gauge else 1.0
        costs = self.map_chunks(partial(_cost, chain, self.instruments(x), size))
        return sum(costs, float(np.sum((self.weights * x) ** 2)))

    def map_chunks(self, function: Callable[[Chunk], _Found]) -> Iterator[_Found]:
        """What a function finds in each chunk, in order."""
        return self.executor.map(function, self.chunks)


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
    def joint_state(self) -> JointState:
        """Of the samples' configurations."""
        return self.nominal.joint_state(self.data.configurations())

    def reuse_joint_state(self, other: Chunk) -> None:
        """Takes over the motion of a chunk at the same joint values, if that is known there."""
        if "joint_state" in vars(other):
            vars(self)["joint_state"] = other.joint_state

    def frames(self, chain: Chain) -> FrameBatch:
        """A chain's frames at the samples, in memory that the next chunk's overwrite."""
        k, m = self.joint_state.positions.shape
        return chain.forward_kinematics(self.joint_state, work_array("sweep", k + 2, 7, 3, m))

    def instrument_values(self, instruments: Mapping[str, float]) -> Array:
        """The values u of the measurement's unknowns among all the instruments'."""
        return np.array([instruments[unknown.name] for unknown in self.data.instrument_parameters])


@dataclass(frozen=True, eq=False)
class Linearization:
    """A problem's model at one x. It holds no data, so it goes to wherever a chunk of them is.

    Attributes:
        chain: with its errors at x.
        bodies, twists: (e,), (e, 6): what each of the e errors moves, as `Chain.tool_velocities` takes it.
        instruments: values of all the instruments' unknowns by name.
        instrument_columns: where those of them that are unknown here stand in x.
        arm_scale, gauge_rates: of the arm, and how fast it grows and turns with each error (e, 4); see `scale`.
    """

    chain: Chain
    bodies: Array
    twists: Array
    instruments: Mapping[str, float]
    instrument_columns: Mapping[str, int]
    arm_scale: float
    gauge_rates: Array

    def r_factor(self, chunk: Chunk, small_angle: bool) -> Array:
        """Triangle (p+1, p+1) of a chunk's whitened rows [J | r]; exact or by the paper's rows."""
        data, frames = chunk.data, chunk.frames(self.chain)
        # Rows by twists are worked out on their way into the triangle, unless they are changed before.
        plain = int(np.searchsorted(self.bodies, len(frames.columns))) if data.has_length_scale else 0
        given = work_array("given", data.residual_dim, self._columns - plain, len(data.rows)).swapaxes(0, 1)
        mixture = self._fill(given, chunk, frames, small_angle)
        twists = self.twists[None, :plain]
        return factor_jacobian(frames.columns, frames.tool[3], self.bodies[:plain], twists, mixture, given)[0]

    def rows(self, chunk: Chunk) -> Array:
        """A chunk's whitened rows [J | r] (p+1, k, m)."""
        out = np.empty((self._columns, chunk.data.residual_dim, len(chunk.data.rows)))
        self._fill(out, chunk, chunk.frames(self.chain), False)
        return out

    @property
    def _columns(self) -> int:
        return len(self.bodies) + len(self.instrument_columns) + 1

    @UnbufferedRows()
    def _fill(self, block: Array, chunk: Chunk, frames: FrameBatch, small_angle: bool) -> ObservationMatrix:
        """Fills in the last columns of the rows, as many as the block has; tells what makes the others."""
        data, u = chunk.data, chunk.instrument_values(self.instruments)
        if small_angle:
            block[-1], mixture = data.small_angle(frames, u)
        else:
            block[-1] = data.residual(frames, u)
            mixture = data.observation_matrix(frames, u, block[-1])
        first = self._columns - len(block)
        errors = len(self.bodies) - first
        if errors:
            velocities = work_array("velocities", errors, 6, frames.tool.shape[-1])
            self.chain.tool_jacobian(frames, self.bodies[first:], self.twists[first:], velocities)
            apply_observation_matrix(velocities, mixture, block[:errors])
        block[errors:-1] = 0.0
        own = data.instrument_jacobian(frames, u) if data.instrument_parameters else ()
        for unknown, rows in zip(data.instrument_parameters, own, strict=True):
            if unknown.name in self.instrument_columns:
                block[self.instrument_columns[unknown.name] - first] = rows
        if not data.has_length_scale:
            normalize_by_scale(block, self.arm_scale, self.gauge_rates, data.residual_groups.get("position"))
        return mixture


def chunk_residual(chain: Chain, instruments: Mapping[str, float], chunk: Chunk) -> Array:
    """A chunk's whitened residuals (k, m) for a chain and values of all the instruments' unknowns."""
    return chunk.data.residual(chunk.frames(chain), chunk.instrument_values(instruments))


def _cost(chain: Chain, instruments: Mapping[str, float], size: float, chunk: Chunk) -> float:
    residual = chunk_residual(chain, instruments, chunk)
    square = float(np.vdot(residual, residual))
    return square if chunk.data.has_length_scale else square / size**2


def _chunk_r_factor(tangent: Linearization, small_angle: bool, chunk: Chunk) -> Array:
    return tangent.r_factor(chunk, small_angle)


def merge_instrument_parameters(data: Sequence[Measurement]) -> tuple[InstrumentParameter, ...]:
    """The unknowns of several measurements, each once; a start that is NaN gives way to one that is not."""
    found: dict[str, InstrumentParameter] = {}
    for item in data:
        for unknown in item.instrument_parameters:
            if unknown.name not in found or math.isnan(found[unknown.name].nominal):
                found[unknown.name] = unknown
    return tuple(
        replace(unknown, nominal=0.0) if math.isnan(unknown.nominal) else unknown
        for unknown in found.values()
    )


def linearize_and_factor(problem: Problem, x: Array, small_angle: bool) -> TriangularSystem:
    """The data's triangle at x (p,), without the priors; exact or by the paper's rows."""
    return combine_r_factors(
        problem.map_chunks(partial(_chunk_r_factor, problem.linearize(x), small_angle)), len(x)
    )
