"""Positions of the tool point, and what all kinds that depend on the tool point have in common.

The position p of the tool point in the measuring frame is all that a `PointMeasurement` depends on, in one or
two configurations: z = h(p, u) + noise. A kind gives h and its derivatives in `model`; residuals and
Jacobians follow. The tool point moves with the linear velocity v of the tool, so the observation matrix is
(∂h/∂p) / sigma.

`Position` is h = p, `PositionComponents` some coordinates of p. `MultiTargetPosition` has several targets at
constant offsets t from the tool point in the tool frame: h = p + R·t, which moves with v + ω × (R·t).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from .base import LENGTH_SIGMA, OFFSET_PRIOR, InstrumentParameter, Measurement, Noise
from .columns import Column, length_columns, text_column
from .groups import LENGTHS, POSITION, Group
from .validation import encode_labels, validated_array, validated_joint_positions, validated_sigma

_AXES = ("x", "y", "z")
# Rows and velocity components of the terms of v + ω × offset.
_TARGET_TERMS = (np.repeat([0, 1, 2], 3), np.array([0, 4, 5, 1, 3, 5, 2, 3, 4]))


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PointMeasurement(Measurement):
    """Base of the kinds that depend on the position of the tool point alone."""

    values: Array  #: Measured values, (m, k) [m]
    sigma: Array  #: Standard deviations, (m, k) [m]

    sample_fields = (*Measurement.sample_fields, "values", "sigma")

    def __init__(
        self,
        q: Array,
        values: Array,
        sigma: ArrayLike | None,
        instrument_parameters: tuple[InstrumentParameter, ...] = (),
    ) -> None:
        """Set the common attributes, whose values are checked."""
        where = f"{type(self).__name__}: sigma"
        self._initialize(
            q=q,
            values=values,
            sigma=validated_sigma(LENGTH_SIGMA if sigma is None else sigma, (len(q), values.shape[1]), where),
            has_stated_sigma=sigma is not None,
            instrument_parameters=instrument_parameters,
        )

    @abstractmethod
    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the predicted values and their derivatives.

        Args:
            points: Tool points, (c, 3, m) [m].
            u: Values of the instrument parameters, (s,).

        Returns:
            Predicted values (k, m), derivatives by the tool points (c, k, 3, m) and by u (s, k, m).
        """

    def value_columns(self) -> tuple[Column, ...]:
        """Return the column of each of the k measured values."""
        return tuple(column for column in self.COLUMNS if column.is_numeric)

    def text_values(self) -> dict[str, Sequence[str]]:
        """Return the columns with text, (m,) each."""
        return {}

    def _columns_and_sigmas(self) -> tuple[dict[str, Any], dict[str, Any]]:
        columns = self.value_columns()
        values = {c.name: self.values[:, i] for i, c in enumerate(columns) if not c.is_implied}
        return values | self.text_values(), {c.sigma_name: self.sigma[:, i] for i, c in enumerate(columns)}

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [self._sigma_text((self.sigma, 1e3, "mm"))]

    @property
    def residual_dim(self) -> int:
        """Number k of measured values per sample."""
        return self.values.shape[1]

    @cached_property
    def _values(self) -> Array:
        """Measured values, (k, m), contiguous along the samples."""
        return np.ascontiguousarray(self.values.T)

    def _points(self, frames: FrameBatch) -> Array:
        """Return the tool points (c, 3, m) of all configurations."""
        m = len(self.rows)
        return frames.tool[3].reshape(3, -1, m).transpose(1, 0, 2) if m else np.empty((1, 3, 0))

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (k, m)."""
        return (self._values - self.model(self._points(frames), u)[0]) * self._weights

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the derivatives by the tool point; terms that vanish for all samples are left out."""
        derivative = self.model(self._points(frames), u)[1].swapaxes(0, 1)
        row, end, axis = np.nonzero(derivative.any(-1))
        return ObservationMatrix(row, 6 * end + axis, derivative[row, end, axis] * self._weights[row])

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivatives (s, k, m) of the whitened model with respect to u."""
        return self.model(self._points(frames), u)[2] * self._weights

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return measured minus modelled values (m, ·) by residual group [m]."""
        return {
            name: (self.residual(frames, u) * self.sigma.T)[group.rows].T
            for name, group in self.residual_groups.items()
        }


@dataclass(frozen=True, eq=False, init=False, repr=False)
class NamedPointMeasurement(PointMeasurement):
    """Measurements of points with names, which the column `label_column` states.

    Attributes:
        label: Number of each sample's name in `names`, (m,).
        names: Names of the points.
    """

    label: Array
    names: tuple[str, ...]

    sample_fields = (*PointMeasurement.sample_fields, "label")

    def text_values(self) -> dict[str, Sequence[str]]:
        """Return the name of each sample."""
        return {self.label_column: [self.names[i] for i in self.label]}

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names that the samples state."""
        return self.names

    @property
    def label_numbers(self) -> Array:
        """Number of the name of each sample, (m,)."""
        return self.label

    def with_label(self, number: int) -> Self:
        """Return the same samples with one name."""
        return self.replace(label=np.full(len(self.rows), number))

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [f"{len(self.names)} {self.label_column}s", *super().description()]


def _noisy_positions(chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Array:
    """Return positions of the chain's tool point (m, 3) with normal noise on each axis."""
    points = chain.forward_kinematics(conditions).tool[3].T
    return points + noise.position * rng.standard_normal(points.shape)


class Position(PointMeasurement):
    """Positions of the tool point in the measuring frame, by a laser tracker, a CMM or trilateration.

    Positions do not depend on the rotation of the tool: the offset of the last joint, if it turns about the
    tool point, and the rotation of the tool frame are not observable.
    """

    kind = "position"
    shows_changes = True
    residual_groups: ClassVar = {"position": POSITION}
    COLUMNS = length_columns("positions", *_AXES)

    def __init__(self, q: ArrayLike, positions: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Check and store measured positions.

        Args:
            q: Joint positions, (m, n) [rad or m].
            positions: Measured positions, (m, 3) [m].
            sigma: Standard deviations, one number or (m, 3) [m]; estimated with the fit if None.
        """
        q = validated_joint_positions(q, "Position")
        super().__init__(q, validated_array(positions, (len(q), 3), "Position: positions", "position"), sigma)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the tool points; their derivative by themselves is the identity."""
        m = points.shape[-1]
        return points[0], np.tile(np.eye(3)[None, :, :, None], (1, 1, 1, m)), np.empty((0, 3, m))

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the weights: each coordinate changes with its own velocity alone."""
        return ObservationMatrix(np.arange(3), np.arange(3), self._weights)

    def positions(self) -> Array:
        """Return the measured positions (m, 3) [m]."""
        return self.values

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return positions of the chain's tool point with normal noise on each axis."""
        return cls(conditions.q, _noisy_positions(chain, conditions, noise, rng), noise.position or None)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PositionComponents(PointMeasurement):
    """Some of the coordinates x, y, z of the tool point in the measuring frame, by dial or height gauges.

    Attributes:
        axes: Which coordinates are measured, k of 0, 1, 2.
    """

    axes: tuple[int, ...]

    kind = "axes"
    residual_groups: ClassVar = {"axes": Group.of(LENGTHS, slice(None))}
    COLUMNS = length_columns("values", *_AXES)
    required_columns = tuple(frozenset([axis]) for axis in _AXES)
    simulated_instrument = "x and z of each position are measured; one of them alone says far less"

    def __init__(
        self, q: ArrayLike, values: ArrayLike, axes: Sequence[int], sigma: ArrayLike | None = None
    ) -> None:
        """Check and store measured coordinates.

        Args:
            q: Joint positions, (m, n) [rad or m].
            values: Measured coordinates, (m, k), or (m,) for one axis [m].
            axes: Which coordinates are measured, k of 0, 1, 2.
            sigma: Standard deviations, one number or (m, k) [m]; estimated with the fit if None.

        Raises:
            InvalidArgumentError: The axes are not distinct numbers from 0, 1, 2.
        """
        q = validated_joint_positions(q, "PositionComponents")
        if not axes or not set(axes) <= {0, 1, 2} or len(set(axes)) != len(axes):
            raise InvalidArgumentError(
                f"PositionComponents: axes are {tuple(axes)}; expected some of 0, 1, 2, each once"
            )
        if np.ndim(values) == 1 and len(axes) == 1:
            values = np.asarray(values)[:, None]
        shape, where = (len(q), len(axes)), "PositionComponents: values"
        super().__init__(q, validated_array(values, shape, where), sigma)
        self.__dict__.update(axes=tuple(axes))

    @classmethod
    def _arguments(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        axes = [i for i, axis in enumerate(_AXES) if axis in values]
        return super()._arguments(values) | {"axes": axes}

    @property
    def residual_names(self) -> tuple[str, ...]:
        """Names of the k residuals of a sample: those of a position for the measured axes."""
        return tuple(f"position_{_AXES[i]}" for i in self.axes)

    def value_columns(self) -> tuple[Column, ...]:
        """Return the columns of the measured axes."""
        return tuple(self.COLUMNS[i] for i in self.axes)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the measured coordinates of the tool points."""
        m, axes = points.shape[-1], list(self.axes)
        return (
            points[0][axes],
            np.tile(np.eye(3)[axes][None, :, :, None], (1, 1, 1, m)),
            np.empty((0, len(axes), m)),
        )

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return the coordinates x and z of the chain's tool point with normal noise."""
        positions = _noisy_positions(chain, conditions, noise, rng)
        return cls(conditions.q, positions[:, [0, 2]], (0, 2), noise.position or None)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class MultiTargetPosition(NamedPointMeasurement):
    """Positions of several targets (reflectors) on the tool in the measuring frame.

    The first target in alphabetical order is the tool point itself, whatever the order of the samples is.
    Each other target has three instrument parameters `target_NAME.x, .y, .z`: its position in the tool frame
    relative to the first target. Two targets make the rotation of the tool observable except about the line
    through them, three make all of it observable.
    The names are in alphabetical order.
    """

    kind = "targets"
    shows_changes = True
    label_column = "target"
    residual_groups: ClassVar = {"position": POSITION}
    COLUMNS = length_columns("positions", *_AXES) + text_column("targets", "target")

    def __init__(
        self, q: ArrayLike, positions: ArrayLike, targets: Sequence[str], sigma: ArrayLike | None = None
    ) -> None:
        """Check and store measured positions of targets.

        Args:
            q: Joint positions, (m, n) [rad or m].
            positions: Measured positions, (m, 3) [m].
            targets: Name of each sample's target, (m,).
            sigma: Standard deviations, one number or (m, 3) [m]; estimated with the fit if None.
        """
        q = validated_joint_positions(q, "MultiTargetPosition")
        values = validated_array(positions, (len(q), 3), "MultiTargetPosition: positions", "position")
        found, label = encode_labels(targets, len(q), "MultiTargetPosition: targets")
        names = tuple(sorted(found))
        label = np.array([names.index(name) for name in found], int)[label]
        parameters = tuple(
            InstrumentParameter(f"target_{name}.{axis}", "m", 0.0, OFFSET_PRIOR)
            for name in names[1:]
            for axis in _AXES
        )
        super().__init__(q, values, sigma, parameters)
        self.__dict__.update(label=label, names=names)

    def initialized(self, chain: Chain) -> Self:
        """Return a copy in which each further target starts at its mean position in the chain's tool frame.

        Starting from zero offsets, the first iterations would rotate the tool instead of moving the targets.
        The solver would then have to return along a curved valley, which takes many iterations.
        """
        tool_from_measuring = se3.inverse(chain.poses(self.conditions()))
        rotated = (tool_from_measuring[:, :3, :3] @ self.values[..., None])[..., 0]
        local = tool_from_measuring[:, :3, 3] + rotated
        parameters = []
        for parameter, (i, axis) in zip(
            self.instrument_parameters, np.ndindex(len(self.names) - 1, 3), strict=True
        ):
            values = local[self.label == i + 1, axis]
            nominal = float(values.mean()) if len(values) else float("nan")
            parameters.append(replace(parameter, nominal=nominal))
        return self.replace(instrument_parameters=tuple(parameters))

    def _target_offsets(self, frames: FrameBatch, u: Array) -> Array:
        """Return the offset R·t of each sample's target, (3, m), in axes of the measuring frame."""
        local = np.concatenate([np.zeros((1, 3)), u.reshape(-1, 3)])[self.label]
        return np.sum(frames.tool[:3] * local.T[:, None], 0)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Raise an error: the position of a target also depends on the rotation of the tool."""
        raise NotImplementedError("the position of a target is not a function of the tool point alone")

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (3, m)."""
        return (self._values - frames.tool[3] - self._target_offsets(frames, u)) * self._weights

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the terms of the velocity of the target, v + ω × offset."""
        x, y, z = self._target_offsets(frames, u)
        one = np.ones_like(x)
        coefficients = np.stack([one, z, -y, one, -z, x, one, y, -x])
        return ObservationMatrix(*_TARGET_TERMS, coefficients * np.repeat(self._weights, 3, 0))

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return the axes of the tool (s, 3, m) for the samples of each target, zeros for the others."""
        is_target = self.label[None] == np.arange(1, len(self.names))[:, None]
        out = is_target[:, None, None, :] * frames.tool[:3]
        return out.reshape(-1, 3, out.shape[-1]) * self._weights

    def positions(self) -> Array:
        """Return the measured positions (m, 3) of the targets [m].

        They are good enough to find base and tool, as targets are much closer together than the robot is
        large.
        """
        return self.values

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return positions of three targets within 5 cm of each other, measured in turn."""
        q = conditions.q
        label = np.arange(len(q)) % 3
        offsets = np.array([[0, 0, 0], [0.05, 0, 0.01], [0, 0.04, -0.02]])[label]
        pose = chain.poses(conditions)
        positions = pose[:, :3, 3] + np.einsum("mij,mj->mi", pose[:, :3, :3], offsets)
        positions += noise.position * rng.standard_normal(positions.shape)
        return cls(q, positions, [f"t{i + 1}" for i in label], noise.position or None)


def require_common_reference_target(data: Mapping[str, Measurement], known: Container[str] = ()) -> None:
    """Raise an error if files measure their targets relative to different ones."""
    first_targets = {
        path: item.names[0] for path, item in data.items() if isinstance(item, MultiTargetPosition)
    }
    for path, name in first_targets.items():
        other, first = next(iter(first_targets.items()))
        if f"target_{name}.x" in known:
            problem = "which in the known instrument parameters is not the first one"
        elif name != first:
            problem = f"but in {other} it is {first!r}"
        else:
            continue
        raise InvalidArgumentError(
            f"{path}: the first target in alphabetical order is {name!r}, {problem}; expected the same first "
            "target everywhere, as the others are relative to it: join the files, or rename the targets"
        )
