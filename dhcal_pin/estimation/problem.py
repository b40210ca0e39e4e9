"""Least-squares problem: error model, measurements and priors.

The unknowns x are the p errors of the robot, followed by the s instrument parameters as differences from
their initial values. The cost is

    F(x) = Σ_i ‖r_i(x)‖² + ‖W·x‖²

with the whitened residuals r_i of sample i and the prior weights W = diag(1/σ).

The samples are processed in chunks. `Linearization` holds everything that a chunk needs at one x, and no
data; it is sent to whatever process works on the chunk. There the whitened rows [J | r] are reduced by QR to
one R factor of shape (p+s+1, p+s+1), and the R factors of all chunks are merged (module `qr`). Memory
therefore does not grow with the number of samples, and every executor yields the same digits, as the order of
merging is fixed.

Nothing here depends on the kind of a measurement or on a parameter set.

Shapes: m samples of k residuals each, p robot errors, s instrument parameters. Arrays over samples have the
samples as their last axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property, partial, reduce
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np

from .._frozen import frozen
from .._kernels import apply_observation_matrix, factor_jacobian
from .._kernels.types import FrameBatch, ObservationMatrix, twists_before
from .._kernels.work_arrays import work_array
from .._typing import Array
from ..measurements.base import InstrumentParameter, Measurement, instrument_values, residual_of
from ..measurements.groups import POSITION
from ..parallel import SERIAL, TaskExecutor
from ..robot.chain import Chain
from ..robot.conditions import SampleState
from .contacts.scale_gauge import ScaleGauge, normalize_by_scale
from .error_model import ErrorModel, ErrorParameter
from .normal_equations import NormalEquations
from .qr import (
    TriangularSystem,
    blocked_r_factor,
    combine_r_factors,
    independent_columns,
    right_singular_vectors,
    sum_of_squares,
)

# Largest number of samples in a chunk.
CHUNK_SIZE = 2000
# Number of columns above which the rows of a small chunk are merged without a factorization of their own.
MANY_COLUMNS = 200
# Distance [m or rad] to a bound below which the bound is active.
ACTIVE_BOUND_TOL = 1e-12

_Output = TypeVar("_Output")


@frozen(eq=False)
class Problem:
    """Least-squares problem in p robot errors and s instrument parameters.

    Measurements share the instrument parameters that have the same name.
    """

    errors: ErrorModel  #: Nominal chain and its p errors.
    data: tuple[Measurement, ...]  #: Measurements of any kinds.
    #: Weights √T/σ of the prior rows, with the prior standard deviations σ and the temperature T, shape
    #: (p+s,); zero without a prior.
    weights: Array
    #: Values of instrument parameters that are not estimated, by name [m or rad].
    known: Mapping[str, float] = field(default_factory=dict)
    executor: TaskExecutor = SERIAL  #: Executes the work on the chunks. The result does not depend on it.
    #: Smallest and largest x, shape (2, p+s) [m and rad]; None if nothing is bounded.
    bounds: Array | None = None
    #: Factor T by which correlation of the residuals enlarges their variance, so that N samples count as N/T
    #: independent ones against the priors. The whitened rows do not contain it.
    temperature: float = 1.0

    @property
    def prior_weights(self) -> Array:
        """Reciprocal prior standard deviations 1/σ of shape (p+s,); zero without a prior."""
        return self.weights / np.sqrt(self.temperature)

    @cached_property
    def instrument_parameters(self) -> tuple[InstrumentParameter, ...]:
        """Unknown instrument parameters, each once, length s."""
        return tuple(u for u in merge_instrument_parameters(self.data) if u.name not in self.known)

    @property
    def parameters(self) -> tuple[ErrorParameter | InstrumentParameter, ...]:
        """Unknowns, length p+s."""
        return (*self.errors.parameters, *self.instrument_parameters)

    def chain(self, x: Array) -> Chain:
        """Build the chain with the errors at x."""
        return self.errors.at(x[: len(self.errors.parameters)])

    def instruments(self, x: Array) -> dict[str, float]:
        """Compute the values of all instrument parameters, known and unknown."""
        differences = x[len(self.errors.parameters) :]
        return {
            u.name: u.nominal + float(v) for u, v in zip(self.instrument_parameters, differences, strict=True)
        } | dict(self.known)

    def instrument_values_of(self, item: Measurement, x: Array) -> Array:
        """Compute the instrument parameters of one measurement."""
        return instrument_values(item, self.instruments(x))

    def instrument_start(self, first: Mapping[str, float]) -> Array:
        """Return the start (s,) of the instruments: first values by name, such as a distortion."""
        return np.array([first.get(p.name, p.nominal) - p.nominal for p in self.instrument_parameters])

    def residuals(self, x: Array, data: Sequence[Measurement]) -> list[Array]:
        """Compute the whitened residuals (k, m) of each of other measurements with the same unknowns."""
        chain, values = self.chain(x), self.instruments(x)
        return [residual_of(item, chain, values) for item in data]

    def linearize(self, x: Array) -> Linearization:
        """Linearize the model."""
        n_robot = len(self.errors.parameters)
        columns = {parameter.name: n_robot + i for i, parameter in enumerate(self.instrument_parameters)}
        model = self.errors.derivative(x[:n_robot])
        size, rates = 1.0, np.zeros((n_robot, 4))
        if self.scale_gauge:
            size, rates = self.scale_gauge.size_and_rates(*model)
        n_coefficients = self.errors.n_coefficients
        return Linearization(*model, self.instruments(x), columns, size, rates, n_coefficients)

    @cached_property
    def scale_gauge(self) -> ScaleGauge | None:
        """Gauge of the measurements without a length; None if there are none, or their objects are known."""
        scale_free = [item for item in self.data if not item.has_length_scale and len(item.rows)]
        if not scale_free or any(
            parameter.name in self.known for item in scale_free for parameter in item.instrument_parameters
        ):
            return None
        return ScaleGauge.from_configurations(
            self.errors.chain, np.concatenate([item.q for item in scale_free])
        )

    @cached_property
    def shown(self) -> Problem:
        """The problem whose rows show what was measured: without motions of base and tool beside contacts."""
        # A motion that was estimated from contacts is no length: it grows with the robot, as their misses do.
        data = [_unmoved(item) for item in self.data] if self.scale_gauge else self.data
        data = [item.at_largest_noise() for item in data]
        is_same = all(new is old for new, old in zip(data, self.data, strict=True))
        return self if is_same else self.with_data(data)

    def with_data(self, data: Sequence[Measurement]) -> Problem:
        """Return the problem with other samples or standard deviations of the same measurements."""
        out = replace(self, data=tuple(data))
        vars(out)["scale_gauge"] = self.scale_gauge
        if "chunks" not in vars(self) or len(data) != len(self.data):
            return out
        pairs = list(zip(self.data, data, strict=True))
        if all(old is new for old, new in pairs):
            vars(out)["chunks"] = self.chunks
        elif all(
            old.configurations() is new.configurations() and old.recorded is new.recorded
            for old, new in pairs
        ):
            for old, new in zip(self.chunks, out.chunks, strict=True):
                new.reuse_joint_state(old)
        return out

    @cached_property
    def chunks(self) -> tuple[Chunk, ...]:
        """Data in pieces of at most CHUNK_SIZE samples, each of one measurement."""
        return tuple(
            Chunk(item.take(np.s_[start : start + CHUNK_SIZE]), self.errors.chain)
            for item in self.data
            for start in range(0, len(item.rows), CHUNK_SIZE)
        )

    def with_prior_weights(self, weights: Array) -> Problem:
        """Return the problem with other priors."""
        return self._with_same_rows(weights=weights)

    def _with_same_rows(self, **changes: Any) -> Problem:
        """Return the problem with changes that do not concern its rows, with the same chunks."""
        out = replace(self, **changes)
        vars(out).update(chunks=self.chunks, scale_gauge=self.scale_gauge)
        return out

    def at_temperature(self, temperature: float) -> Problem:
        """Return the problem with the same priors at another temperature of the residuals."""
        weights = self.prior_weights * np.sqrt(temperature)
        return self._with_same_rows(weights=weights, temperature=temperature)

    def is_interior(self, x: Array) -> Array:
        """Find the unknowns whose bounds are not active."""
        if self.bounds is None:
            return np.ones(len(x), bool)
        return ~np.any(np.abs(self.bounds - x) <= ACTIVE_BOUND_TOL, 0)

    def cost(self, x: Array) -> float:
        """Compute the sum of squared whitened residuals and priors."""
        chain = self.chain(x)
        size = self.scale_gauge.size(chain) if self.scale_gauge else 1.0
        costs = self.map_chunks(partial(_chunk_cost, chain, self.instruments(x), size))
        return sum(costs, float(np.sum((self.weights * x) ** 2)))

    def map_chunks(self, function: Callable[[Chunk], _Output]) -> Iterator[_Output]:
        """Apply a function to each chunk."""
        return self.executor.map(function, self.chunks)


@frozen(eq=False)
class Chunk:
    """Some samples of one measurement, with the joint state that is the same at every x."""

    data: Measurement  # Samples
    nominal: Chain  # Nominal chain; its geometric errors do not affect the joint state

    @cached_property
    def joint_state(self) -> SampleState:
        """Joint state at the configurations of the samples."""
        return self.nominal.joint_state(self.data.conditions())

    def reuse_joint_state(self, other: Chunk) -> None:
        """Take over the joint state of a chunk, if it has been computed."""
        if "joint_state" in vars(other):
            vars(self)["joint_state"] = other.joint_state

    def frames(self, chain: Chain) -> FrameBatch:
        """Compute the frames of a chain at the samples."""
        k, m = self.joint_state.positions.shape
        return chain.forward_kinematics(self.joint_state, work_array("frames", k + 2, 7, 3, m))


@frozen(eq=False)
class Linearization:
    """Model of a problem at one x, without data, so that it can be sent to the process that holds a chunk."""

    chain: Chain  # Chain with the errors at x
    bodies: Array  # Body that each of the p robot errors moves, shape (p,); see `Chain.tool_jacobian`
    twists: Array  # Twists of those bodies, shape (p, 6)
    instruments: Mapping[str, float]  # Values of all instrument parameters by name [m or rad]
    instrument_columns: Mapping[str, int]  # Column of each unknown instrument parameter in J, by name
    arm_scale: float  # Size of the chain; see `scale_gauge`
    gauge_rates: Array  # Rates of growth and rotation per unit of each robot error, shape (p, 4)
    n_coefficients: int  # Number of robot errors that are transmission coefficients

    def r_factor(self, chunk: Chunk, small_angle: bool) -> Array:
        """Compute the R factor of a chunk's whitened rows [J | r]."""
        n_rows = chunk.data.residual_dim * len(chunk.data.rows)
        if MANY_COLUMNS < self._n_columns > n_rows and not small_angle:
            return self.rows(chunk).reshape(self._n_columns, -1).T
        if self._has_structure(chunk) and not small_angle:
            return self.structured_rows(chunk).r_factor()
        data, frames = chunk.data, chunk.frames(self.chain)
        # The kernel computes the columns of geometric errors while it factors them; they are never stored.
        # All other columns, and all columns of measurements that are normalized by scale, are filled before.
        n_geometric = int(np.searchsorted(self.bodies, len(frames.columns))) if data.has_length_scale else 0
        filled = work_array(
            "filled columns", data.residual_dim, self._n_columns - n_geometric, len(data.rows)
        ).swapaxes(0, 1)
        observation = self._fill(filled, chunk, frames, small_angle)
        bodies = self.bodies[:n_geometric]
        twists = twists_before(observation.body, bodies, self.twists[None, :n_geometric])
        return factor_jacobian(frames.columns, frames.tool[3], bodies, twists, observation, filled)[0]

    def structured_rows(self, chunk: Chunk) -> StructuredRows:
        """Compute the whitened rows [J | r] of a chunk, the transmission columns as products."""
        frames = chunk.frames(self.chain)
        first = int(np.searchsorted(self.bodies, len(frames.columns)))
        entries = self.bodies[first:] - len(frames.columns)
        columns = {name: column - len(entries) for name, column in self.instrument_columns.items()}
        other = replace(
            self,
            bodies=self.bodies[:first],
            twists=self.twists[:first],
            instrument_columns=columns,
            gauge_rates=self.gauge_rates[:first],
            n_coefficients=0,
        )
        residual_dim, m = chunk.data.residual_dim, len(chunk.data.rows)
        dense = np.empty((other._n_columns, residual_dim, m))
        observation = other._fill(dense, chunk, frames, False)
        joints, terms = self.chain.transmission_terms(frames, entries)
        motions = self.chain.motions(frames, joints, observation.body)
        joint_rows = np.empty((len(motions), residual_dim, m))
        apply_observation_matrix(motions, observation, joint_rows)
        return StructuredRows.of(dense, joint_rows, joints, terms, first)

    def rows(self, chunk: Chunk) -> Array:
        """Compute the whitened rows [J | r] of a chunk."""
        if self._has_structure(chunk):
            return self.structured_rows(chunk).multiplied_out()
        out = np.empty((self._n_columns, chunk.data.residual_dim, len(chunk.data.rows)))
        self._fill(out, chunk, chunk.frames(self.chain), False)
        return out

    def _has_structure(self, chunk: Chunk) -> bool:
        """Check whether most columns of a chunk are those of joints times terms."""
        is_large = self.n_coefficients > MANY_COLUMNS and not self.instrument_columns
        return is_large and _is_structured(chunk.data)

    @property
    def _n_columns(self) -> int:
        """Number of columns of [J | r]."""
        return len(self.bodies) + len(self.instrument_columns) + 1

    def _fill(self, block: Array, chunk: Chunk, frames: FrameBatch, small_angle: bool) -> ObservationMatrix:
        """Fill a block (c, k, m) with the last c columns of [J | r]; return the observation matrix."""
        data, u = chunk.data, instrument_values(chunk.data, self.instruments)
        if small_angle:
            block[-1], observation = data.small_angle(frames, u)
        else:
            block[-1] = data.residual(frames, u)
            observation = data.observation_matrix(frames, u, block[-1])
        first = self._n_columns - len(block)
        n_errors = len(self.bodies) - first
        if n_errors:
            jacobian = work_array("filled jacobian", n_errors, 6, frames.tool.shape[-1])
            bodies, twists = self.bodies[first:], self.twists[first:]
            self.chain.tool_jacobian(frames, bodies, twists, jacobian, observation.body)
            apply_observation_matrix(jacobian, observation, block[:n_errors])
        block[n_errors:-1] = 0.0
        instrument_rows = data.instrument_jacobian(frames, u) if data.instrument_parameters else ()
        for parameter, rows in zip(data.instrument_parameters, instrument_rows, strict=True):
            if parameter.name in self.instrument_columns:
                block[self.instrument_columns[parameter.name] - first] = rows
        if not data.has_length_scale:
            for group in data.residual_groups.values():
                if group.unit == "m":  # the size of a robot does not change angles
                    rows = block[:, group.rows]
                    normalize_by_scale(rows, self.arm_scale, self.gauge_rates, group is POSITION)
        return observation


def _unmoved(item: Measurement) -> Measurement:
    """Return samples without a length as if base and tool had not moved, others as they are."""
    known = item.recorded
    if item.has_length_scale or known is None or (known.base_motion is None and known.tool_motion is None):
        return item
    return item.replace(recorded=known.of_arm)


@frozen(eq=False)
class StructuredRows:
    """Whitened rows [J | r] of m samples of k residuals, whose transmission columns are not multiplied out.

    A transmission coefficient moves one joint, in proportion to a term of the configuration. Its column is
    the column of that joint times the term.
    """

    dense: Array  # The c other columns, the last one r, shape (c, k, m)
    joint_rows: Array  # Columns of the motion of each joint, shape (n, k, m)
    terms: Array  # Term of each of the e coefficients, sorted by joint, shape (e, m)
    blocks: tuple[tuple[int, slice], ...]  # Each joint that coefficients move, with its part of the terms
    columns: Array  # Column of [J | r] of each dense column, then of each coefficient, shape (c+e,)

    @classmethod
    def of(
        cls, dense: Array, joint_rows: Array, joints: Sequence[int], terms: Sequence[Array], first: int
    ) -> StructuredRows:
        """Sort the coefficients, which are the columns of [J | r] from a first one on, by their joints."""
        by_joint = np.argsort(joints, kind="stable")
        numbers, starts = np.unique(np.sort(joints), return_index=True)
        ends = [*starts.tolist(), len(joints)][1:]
        blocks = tuple(
            (joint, slice(start, end))
            for joint, start, end in zip(numbers.tolist(), starts.tolist(), ends, strict=True)
        )
        dense_columns = np.delete(np.arange(len(dense) + len(joints)), first + np.arange(len(joints)))
        columns = np.concatenate([dense_columns, first + by_joint])
        return cls(dense, joint_rows, np.array([terms[i] for i in by_joint]), blocks, columns)

    def take(self, index: Array) -> StructuredRows:
        """Return the rows of some samples, given by a mask or an index."""
        parts = (self.dense[..., index], self.joint_rows[..., index], self.terms[:, index])
        return StructuredRows(*parts, self.blocks, self.columns)

    def multiplied_out(self) -> Array:
        """Compute all columns of [J | r], shape (c+e, k, m)."""
        n_dense = len(self.dense)
        out = np.empty((len(self.columns), *self.dense.shape[1:]))
        out[self.columns[:n_dense]] = self.dense
        for joint, block in self.blocks:
            for column, term in zip(self.columns[n_dense:][block], self.terms[block], strict=True):
                np.multiply(self.joint_rows[joint], term, out=out[column])
        return out

    def r_factor(self) -> Array:
        """Compute the R factor of the rows, shape (c+e, c+e)."""
        # Over a short range of a joint, many of its terms are combinations of others up to rounding. Only the
        # columns of the others are factored.
        found = [independent_columns(self.terms[block].T) for _, block in self.blocks]
        kept = [
            block.start + independent for (_, block), (independent, _) in zip(self.blocks, found, strict=True)
        ]
        ends = np.cumsum([0, *map(len, kept)]).tolist()
        blocks = tuple(
            (joint, slice(*pair)) for (joint, _), pair in zip(self.blocks, pairwise(ends), strict=True)
        )
        c, n = len(self.dense) - 1, len(self.columns)
        # Other columns, terms and r, in this order.
        order = np.concatenate([np.arange(c), [c + ends[-1]], c + np.arange(ends[-1])])
        reduced = StructuredRows(self.dense, self.joint_rows, self.terms[np.concatenate(kept)], blocks, order)
        factor = blocked_r_factor(reduced.multiplied_out())
        rows = np.empty((len(factor) - 1, n))
        rows[:, self.columns[: c + 1]] = factor[:-1, [*range(c), -1]]
        rows[:, self.columns[c + 1 :]] = np.concatenate(
            [
                factor[:-1, c + block.start : c + block.stop] @ coefficients
                for (_, block), (_, coefficients) in zip(blocks, found, strict=True)
            ],
            1,
        )
        out = np.zeros((n, n))
        out[: len(rows)], out[-1, -1] = np.linalg.qr(rows, mode="r"), factor[-1, -1]
        return out

    def products(self) -> Array:
        """Compute the inner products [J | r]ᵀ·[J | r], shape (c+e, c+e)."""
        c, m, n = len(self.dense), self.dense.shape[-1], len(self.columns)
        out, scaled = work_array("products", n, n), work_array("scaled columns", n, m)
        flat = self.dense.reshape(c, -1)
        out[:c, :c] = flat @ flat.T
        for i, (joint, block) in enumerate(self.blocks):
            terms, own = self.terms[block], slice(c + block.start, c + block.stop)
            # All columns before those of this joint, times the motion of the joint.
            np.einsum("ckm,km->cm", self.dense, self.joint_rows[joint], out=scaled[:c])
            common = np.einsum("jkm,km->jm", self.joint_rows, self.joint_rows[joint])
            for other_joint, other in self.blocks[:i]:
                np.multiply(self.terms[other], common[other_joint], out=scaled[c:][other])
            beside = scaled[: own.start] @ terms.T
            out[: own.start, own], out[own, : own.start] = beside, beside.T
            weighted = np.multiply(terms, np.sqrt(common[joint]), out=scaled[own])
            out[own, own] = weighted @ weighted.T
        return _reordered(out, np.argsort(self.columns))

    def covariances(self, covariance: Array) -> Array:
        """Compute the covariance of the rows of each sample that uncertain unknowns cause."""
        c, dense = len(self.dense) - 1, self.dense[:-1]
        covariance = _reordered(covariance, np.delete(self.columns, c))
        of_dense, beside, of_terms = covariance[:c, :c], covariance[:c, c:], covariance[c:, c:]
        out = np.einsum("ckm,clm->mkl", dense, np.tensordot(of_dense, dense, 1))
        for i, (joint, block) in enumerate(self.blocks):
            terms = self.terms[block]
            # Half of the effect of this joint together with the dense columns and the joints before it.
            half = np.einsum("ckm,cm->km", dense, beside[:, block] @ terms)
            for other_joint, other in self.blocks[: i + 1]:
                share = np.einsum("em,em->m", terms, of_terms[block, other] @ self.terms[other])
                half += (0.5 if other == block else 1.0) * share * self.joint_rows[other_joint]
            product = np.einsum("km,lm->mkl", half, self.joint_rows[joint])
            out += product + product.swapaxes(1, 2)
        return out


def _reordered(matrix: Array, order: Array) -> Array:
    """Return a symmetric matrix with its rows and columns in another order."""
    rows = np.take(matrix, order, 0, work_array("reordered rows", *matrix.shape), mode="clip")
    return np.take(rows, order, 1, mode="clip")


def chunk_residual(chain: Chain, instruments: Mapping[str, float], chunk: Chunk) -> Array:
    """Compute the whitened residuals of a chunk."""
    return chunk.data.residual(chunk.frames(chain), instrument_values(chunk.data, instruments))


def _chunk_cost(chain: Chain, instruments: Mapping[str, float], size: float, chunk: Chunk) -> float:
    """Compute the sum of squared whitened residuals of a chunk, for a chain of a given size."""
    residual = chunk_residual(chain, instruments, chunk)
    if chunk.data.has_length_scale:
        return sum_of_squares(residual)
    return sum(
        sum_of_squares(residual[group.rows]) / (size**2 if group.unit == "m" else 1.0)
        for group in chunk.data.residual_groups.values()
    )


def _chunk_r_factor(linearization: Linearization, small_angle: bool, chunk: Chunk) -> Array:
    """Compute the R factor of a chunk; a module-level function can be sent to another process."""
    return linearization.r_factor(chunk, small_angle)


def merge_instrument_parameters(data: Sequence[Measurement]) -> tuple[InstrumentParameter, ...]:
    """Collect the instrument parameters of several measurements."""
    merged: dict[str, InstrumentParameter] = {}
    for item in data:
        for parameter in item.instrument_parameters:
            if parameter.name not in merged or math.isnan(merged[parameter.name].nominal):
                merged[parameter.name] = parameter
    return tuple(
        replace(parameter, nominal=0.0) if math.isnan(parameter.nominal) else parameter
        for parameter in merged.values()
    )


def linearize_and_factor(problem: Problem, x: Array, small_angle: bool) -> TriangularSystem:
    """Compute the triangular system of all data, without priors."""
    return factor(problem, problem.linearize(x), len(x), small_angle)


def factor(
    problem: Problem, linearization: Linearization, n_unknowns: int, small_angle: bool = False
) -> TriangularSystem:
    """Compute the triangular system of all data, without priors, of a model that is linearized already."""
    factors = problem.map_chunks(partial(_chunk_r_factor, linearization, small_angle))
    return combine_r_factors(factors, n_unknowns)


class UnfactoredSystem(NormalEquations):
    """Normal equations of all data, with the R factor of the rows, which is computed when it is first needed.

    Rank and null space of the data, without priors, need that R factor.
    """

    problem: Problem  # Problem in p robot errors and s instrument parameters
    x: Array  # Unknowns of shape (p+s,)

    def __init__(self, equations: NormalEquations, problem: Problem, x: Array):
        """Store the normal equations and the problem."""
        super().__init__(equations.products)
        vars(self).update(problem=problem, x=x)

    @cached_property
    def rows(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """[R z; 0 ρ], upper triangular, shape (p+s+1, p+s+1)."""
        return linearize_and_factor(self.problem, self.x, small_angle=False).rows

    @cached_property
    def _right_singular_vectors(self) -> tuple[Array, Array]:
        """Singular values and right singular vectors of R; most such systems have a null space."""
        return right_singular_vectors(self.r)

    @cached_property
    def singular_values(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Singular values of R, those of the Jacobian, largest first."""
        return self._right_singular_vectors[0]

    @cached_property
    def null_space(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Orthonormal basis of the directions that the data do not determine."""
        return self._right_singular_vectors[1][self.rank :].T


def uses_normal_equations(problem: Problem) -> bool:
    """Check whether normal equations take much less time than the R factor of the rows."""
    # They are accurate if all unknowns have priors.
    return (
        problem.errors.n_coefficients > MANY_COLUMNS
        and not problem.instrument_parameters
        and bool(problem.weights.all())
        and all(map(_is_structured, problem.data))
    )


def _is_structured(item: Measurement) -> bool:
    """Check whether transmission columns of a measurement are those of joints times terms."""
    return item.configurations_per_row == 1 and item.has_length_scale


def linear_system(problem: Problem, x: Array) -> TriangularSystem:
    """Compute the system of all data, without priors, in the form that takes less time."""
    if uses_normal_equations(problem):
        return normal_equations(problem, x)
    return linearize_and_factor(problem, x, small_angle=False)


def normal_equations(problem: Problem, x: Array) -> NormalEquations:
    """Compute the normal equations of all data, without priors."""
    parts = problem.map_chunks(partial(_chunk_products, problem.linearize(x)))
    return NormalEquations(reduce(np.add, parts))


def _chunk_products(linearization: Linearization, chunk: Chunk) -> Array:
    """Compute the inner products of a chunk; a module-level function can be sent to another process."""
    return linearization.structured_rows(chunk).products()


def normal_equations_by_part(
    problem: Problem, x: Array, labels: Sequence[Array], count: int
) -> list[NormalEquations]:
    """Compute the normal equations of the samples of each label below a count; labels (m,) by measurement."""
    of_chunks = [
        label[start : start + CHUNK_SIZE] for label in labels for start in range(0, len(label), CHUNK_SIZE)
    ]
    function = partial(_chunk_products_by_part, problem.linearize(x), count)
    products = problem.executor.map(function, zip(problem.chunks, of_chunks, strict=True))
    return [NormalEquations(reduce(np.add, parts)) for parts in zip(*products, strict=True)]


def _chunk_products_by_part(
    linearization: Linearization, count: int, labelled: tuple[Chunk, Array]
) -> list[Array]:
    """Compute the inner products of the samples of each label of a chunk."""
    chunk, label = labelled
    rows = linearization.structured_rows(chunk)
    return [rows.take(np.flatnonzero(label == i)).products() for i in range(count)]


def whitened_residuals(problem: Problem, x: Array) -> Iterator[Array]:
    """Yield the whitened residuals of each measurement."""
    chunks = problem.map_chunks(partial(chunk_residual, problem.chain(x), problem.instruments(x)))
    for item in problem.data:
        parts = [next(chunks) for _ in range(0, len(item.rows), CHUNK_SIZE)]
        yield np.concatenate([np.empty((item.residual_dim, 0)), *parts], 1)
