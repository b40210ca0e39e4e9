"""What the kinds that read nothing but where the tool point is have in common."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from .. import se3
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import Chain
from .base import (
    LENGTH_SIGMA,
    ZERO_PRIOR,
    InstrumentParameter,
    Measurement,
    Noise,
    columns_together,
    length_columns,
    stack_columns,
    validated_array,
    validated_sigma,
)


@dataclass(frozen=True, eq=False)
class PointReading:
    """A reading that depends on where the tool point is, in one or two configurations, and on nothing else.

    A kind derives from it and gives `model`; the rest follows.

    Attributes:
        q: (m, n) joint values, rad or m.
        values: (m, k) m.
        sigma: (m, k) standard deviations, m.
        rows: (m,) row numbers.
        has_stated_sigma: whether sigma is the instrument's own.
        instrument_parameters: (s,).
    """

    q: Array
    values: Array
    sigma: Array
    rows: Array
    has_stated_sigma: bool
    instrument_parameters: tuple[InstrumentParameter, ...]

    kind: ClassVar[str]
    residual_groups: ClassVar[Mapping[str, slice]]
    columns: ClassVar[Mapping[str, str]]
    required_columns: ClassVar[tuple[frozenset[str], ...]]
    configurations_per_row: ClassVar[int] = 1
    is_contact: ClassVar[bool] = False
    has_length_scale: ClassVar[bool] = True
    # Fields with an entry a sample.
    sample_fields: ClassVar[tuple[str, ...]] = ("q", "values", "sigma", "rows")

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Modelled reading (k, m) of tool points (c, 3, m), its derivatives (c, k, 3, m) and (s, k, m)."""
        raise NotImplementedError

    def value_columns(self) -> tuple[str, ...]:
        """The columns of the reading, as many as it has."""
        return tuple(name for name, what in self.columns.items() if what == "length" and "sigma" not in name)

    def to_columns(self) -> dict[str, Any]:
        """The reading's columns, and their sigmas where these are the instrument's own."""
        names = self.value_columns()
        out = {name: self.values[:, i] for i, name in enumerate(names)}
        if self.has_stated_sigma:
            out |= {f"sigma_{name}": self.sigma[:, i] for i, name in enumerate(names)}
        return out

    def configurations(self) -> Array:
        """As they are, (m, n)."""
        return self.q

    @property
    def residual_dim(self) -> int:
        """As many as the reading has columns."""
        return self.values.shape[1]

    @cached_property
    def _weights(self) -> Array:
        """One over sigma, (k, m)."""
        return 1 / np.ascontiguousarray(self.sigma.T)

    @cached_property
    def _values(self) -> Array:
        """(k, m), the samples last in memory."""
        return np.ascontiguousarray(self.values.T)

    def _points(self, frames: FrameBatch) -> Array:
        m = len(self.rows)
        return frames.tool[3].reshape(3, -1, m).transpose(1, 0, 2) if m else np.empty((1, 3, 0))

    def initialized(self, chain: Chain) -> Self:
        """Nothing to start."""
        return self

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """(k, m)."""
        return (self._values - self.model(self._points(frames), u)[0]) * self._weights

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """By what the reading depends on."""
        derivative = self.model(self._points(frames), u)[1].swapaxes(0, 1)
        row, end, axis = np.nonzero(derivative.any(-1))
        return ObservationMatrix(row, 6 * end + axis, derivative[row, end, axis] * self._weights[row])

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """(s, k, m)."""
        return self.model(self._points(frames), u)[2] * self._weights

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """The same rows: there is no rotation in them."""
        residual = self.residual(frames, u)
        return residual, self.observation_matrix(frames, u, residual)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """{group: (m, k)} in m."""
        return {
            name: (self.residual(frames, u) * self.sigma.T)[rows].T
            for name, rows in self.residual_groups.items()
        }

    def positions(self) -> Array:
        """None, (0, 3)."""
        return np.empty((0, 3))

    def rotations(self) -> Array:
        """None, (0, 3, 3)."""
        return np.empty((0, 3, 3))

    def with_scaled_sigma(self, scales: Mapping[str, float]) -> Self:
        """The same readings with sigmas multiplied."""
        (scale,) = scales.values()
        return replace(self, sigma=self.sigma * scale)

    def with_weights(self, weights: Array) -> Self:
        """The same readings with each sample counting for a weight (m,), by wider sigmas."""
        return replace(self, sigma=self.sigma / np.sqrt(weights)[:, None])

    def take(self, index: Array | slice) -> Self:
        """The samples of an index or mask."""
        return replace(self, **{name: getattr(self, name)[index] for name in self.sample_fields})


_AXES = ("x", "y", "z")


_SIGMAS = tuple(f"sigma_{name}" for name in _AXES)


# Rows and components of v + ω × offset.
_TARGET = (np.repeat([0, 1, 2], 3), np.array([0, 4, 5, 1, 3, 5, 2, 3, 4]))


@dataclass(frozen=True, eq=False)
class Position(PointReading):
    """Positions (m, 3) of the tool point in the measuring frame: laser tracker, CMM, trilaterated wires.

    Sees the tool's point but not its rotation: one axis' zero and the tool's rotation stay unseen.
    """

    kind: ClassVar[str] = "position"
    residual_groups: ClassVar[Mapping[str, slice]] = {"position": slice(0, 3)}
    columns: ClassVar[Mapping[str, str]] = length_columns(*_AXES)
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together(*_AXES),)

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> Position:
        """x, y, z and their sigmas."""
        return cls.from_arrays(q[0], stack_columns(values, _AXES), stack_columns(values, _SIGMAS))

    @classmethod
    def from_arrays(cls, q: Array, position: Array, sigma: Array | float | None = None) -> Position:
        """Checked positions (m, 3) in m at joint values (m, n).

        sigma is one number or (m, 3); without it, it is estimated with the fit.
        """
        q = validated_array(q, (None, None), "q")
        m = len(q)
        position = validated_array(position, (m, 3), "position")
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, (m, 3), "sigma")
        return cls(q, position, sigmas, np.arange(1, m + 1), sigma is not None, ())

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """The point itself."""
        m = points.shape[-1]
        return points[0], np.tile(np.eye(3)[None, :, :, None], (1, 1, 1, m)), np.empty((0, 3, m))

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Each axis by its own."""
        return ObservationMatrix(np.arange(3), np.arange(3), self._weights)

    def positions(self) -> Array:
        """As measured, (m, 3)."""
        return self.values

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Position:
        """Positions of a chain's tool with normal noise an axis."""
        q = chain.validated_q(q)
        position = chain.forward_kinematics(q).tool[3].T + noise.position * rng.standard_normal((len(q), 3))
        return cls.from_arrays(q, position, noise.position or None)


@dataclass(frozen=True, eq=False)
class PositionComponents(PointReading):
    """Some of x, y, z of the tool point in the measuring frame: dial gauges, a height gauge.

    Attributes:
        axes: which of 0, 1, 2, as many as the reading has columns.
    """

    axes: tuple[int, ...] = (0, 1, 2)

    kind: ClassVar[str] = "axes"
    residual_groups: ClassVar[Mapping[str, slice]] = {"axes": slice(None)}
    columns: ClassVar[Mapping[str, str]] = length_columns(*_AXES)
    required_columns: ClassVar[tuple[frozenset[str], ...]] = tuple(columns_together(axis) for axis in _AXES)

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> PositionComponents:
        """One or two of x, y, z, and their sigmas."""
        axes = [i for i, axis in enumerate(_AXES) if axis in values]
        names = [_AXES[i] for i in axes]
        reading = stack_columns(values, names)
        return cls.from_arrays(
            q[0], reading, axes, stack_columns(values, [f"sigma_{name}" for name in names])
        )

    def value_columns(self) -> tuple[str, ...]:
        """The chosen ones of x, y, z."""
        return tuple(_AXES[i] for i in self.axes)

    @classmethod
    def from_arrays(
        cls, q: Array, values: Array, axes: Sequence[int], sigma: Array | float | None = None
    ) -> PositionComponents:
        """Checked readings (m, k) in m along k of the axes 0, 1, 2."""
        q = validated_array(q, (None, None), "q")
        shape = (len(q), len(axes))
        if not axes or not set(axes) <= {0, 1, 2} or len(set(axes)) != len(axes):
            raise DhcalError(f"axes {tuple(axes)}: choose some of 0, 1, 2, each once")
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, shape, "sigma")
        rows = np.arange(1, len(q) + 1)
        return cls(
            q, validated_array(values, shape, "values"), sigmas, rows, sigma is not None, (), tuple(axes)
        )

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """The chosen coordinates."""
        m, axes = points.shape[-1], list(self.axes)
        return (
            points[0][axes],
            np.tile(np.eye(3)[axes][None, :, :, None], (1, 1, 1, m)),
            np.empty((0, len(axes), m)),
        )

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> PositionComponents:
        """X and z of a chain's tool with normal noise."""
        q = chain.validated_q(q)
        position = chain.forward_kinematics(q).tool[3].T + noise.position * rng.standard_normal((len(q), 3))
        return cls.from_arrays(q, position[:, [0, 2]], (0, 2), noise.position or None)


@dataclass(frozen=True, eq=False)
class MultiTargetPosition(PointReading):
    """Positions (m, 3) of several reflectors on the tool, each at an unknown place.

    The first name's place is the tool point itself; the others have three unknowns each, in the tool's
    frame. Two of them show the tool's rotation about all axes but their line, three all of it.

    Attributes:
        label: (m,) which of the names.
        names: reflectors in the order of first appearance.
    """

    label: Array = None  # pyright: ignore[reportAssignmentType]
    names: tuple[str, ...] = ()

    kind: ClassVar[str] = "targets"
    residual_groups: ClassVar[Mapping[str, slice]] = {"position": slice(0, 3)}
    columns: ClassVar[Mapping[str, str]] = length_columns(*_AXES) | {"target": "text"}
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together(*_AXES, "target"),)
    sample_fields: ClassVar = (*PointReading.sample_fields, "label")

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> MultiTargetPosition:
        """x, y, z, target, and sigmas."""
        return cls.from_arrays(
            q[0], stack_columns(values, _AXES), values["target"], stack_columns(values, _SIGMAS)
        )

    def to_columns(self) -> dict[str, Any]:
        """x, y, z, target, and sigmas."""
        return super().to_columns() | {"target": [self.names[i] for i in self.label]}

    @classmethod
    def from_arrays(
        cls, q: Array, position: Array, targets: Sequence[str], sigma: Array | float | None = None
    ) -> MultiTargetPosition:
        """Checked positions (m, 3) in m of named targets (m,)."""
        plain = Position.from_arrays(q, position, sigma)
        names, label = encode_labels(targets, len(plain.q), "targets")
        unknowns = tuple(
            InstrumentParameter(f"target_{name}.{axis}", "m", 0.0, ZERO_PRIOR)
            for name in names[1:]
            for axis in _AXES
        )
        return cls(
            plain.q, plain.values, plain.sigma, plain.rows, plain.has_stated_sigma, unknowns, label, names
        )

    def initialized(self, chain: Chain) -> MultiTargetPosition:
        """Each further target where the chain's tool has it on average.

        From zero the first steps would turn the tool, which only the offsets between the targets see, and
        the way back bends.
        """
        into = se3.inverse(chain.poses(self.q))
        local = into[:, :3, 3] + (into[:, :3, :3] @ self.values[..., None])[..., 0]
        unknowns = []
        for unknown, (i, axis) in zip(
            self.instrument_parameters, np.ndindex(len(self.names) - 1, 3), strict=True
        ):
            mine = local[self.label == i + 1, axis]
            unknowns.append(replace(unknown, nominal=float(mine.mean()) if len(mine) else float("nan")))
        return replace(self, instrument_parameters=tuple(unknowns))

    def _target_offsets(self, frames: FrameBatch, u: Array) -> Array:
        """Each sample's target relative to the tool point, (3, m) in axes of the measuring frame."""
        local = np.concatenate([np.zeros((1, 3)), u.reshape(-1, 3)])[self.label]
        return np.sum(frames.tool[:3] * local.T[:, None], 0)

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """(3, m)."""
        return (self._values - frames.tool[3] - self._target_offsets(frames, u)) * self._weights

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """The target's velocity v + ω × offset."""
        x, y, z = self._target_offsets(frames, u)
        one = np.ones_like(x)
        shares = np.stack([one, z, -y, one, -z, x, one, y, -x])
        return ObservationMatrix(*_TARGET, shares * np.repeat(self._weights, 3, 0))

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """(s, 3, m): the tool's axes where the sample is of that target."""
        mine = self.label[None] == np.arange(1, len(self.names))[:, None]
        out = mine[:, None, None, :] * frames.tool[:3]
        return out.reshape(-1, 3, out.shape[-1]) * self._weights

    def positions(self) -> Array:
        """As measured, (m, 3): good enough to find the instrument by, as reflectors sit close together."""
        return self.values

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> MultiTargetPosition:
        """Three targets within 5 cm of each other, in turn."""
        q = chain.validated_q(q)
        label = np.arange(len(q)) % 3
        places = np.array([[0, 0, 0], [0.05, 0, 0.01], [0, 0.04, -0.02]])[label]
        pose = chain.poses(q)
        position = pose[:, :3, 3] + np.einsum("mij,mj->mi", pose[:, :3, :3], places)
        position += noise.position * rng.standard_normal(position.shape)
        return cls.from_arrays(q, position, [f"t{i + 1}" for i in label], noise.position or None)


def require_common_reference_target(data: Mapping[str, Measurement], known: Container[str] = ()) -> None:
    """Complains where files count their targets from different ones.

    Args:
        data: measurements by file.
        known: names of unknowns of instruments that were found before.

    Raises:
        DhcalError: they do not begin with the same one, or with a known further one.
    """
    begun = {path: item.names[0] for path, item in data.items() if isinstance(item, MultiTargetPosition)}
    for path, name in begun.items():
        other, first = next(iter(begun.items()))
        if f"target_{name}.x" in known:
            other, first = "what was found before", "another"
        if name != first:
            raise DhcalError(
                f"{path}: begins with target {name!r}, from which the others are counted, and {other} with "
                f"{first!r}; begin every file with a row of the same target, or put them into one"
            )


def encode_labels(words: Sequence[str], count: int, what: str) -> tuple[tuple[str, ...], Array]:
    """Distinct words in order of appearance, and which one each sample has (m,)."""
    if len(words) != count:
        raise DhcalError(f"{what}: {len(words)} names for {count} samples")
    names = tuple(dict.fromkeys(words))
    place = {name: i for i, name in enumerate(names)}
    return names, np.array([place[word] for word in words], int)
