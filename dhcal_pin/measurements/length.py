"""Lengths: wires from anchors to the tool point, and distances between two positions of the tool point.

    wire          h = |p - anchor| + offset      anchor and offset are unknown unless given
    distance      h = |p_b - p_a|                two configurations a and b

The derivative by p is the unit vector along the wire or from p_a to p_b.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..formatting import format_count
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from .base import OFFSET_PRIOR, InstrumentParameter, Noise, point_parameters
from .columns import Column, displacement_range, instrument_range, length_columns
from .groups import LENGTHS, Group
from .position import PointMeasurement
from .trilateration import locate_point, mirror_images, norm_and_direction
from .validation import validated_array, validated_joint_positions

# Largest number of wires of a device in a file; columns L1 to L9.
MAX_WIRES = 9


def images_of_point(prefix: str, points: Array, values: Mapping[str, float]) -> list[dict[str, float]]:
    """Return mirror images of a point among the instrument parameters, from tool points (m, 3)."""
    names = [f"{prefix}.{axis}" for axis in "xyz"]
    images = mirror_images(points, [values[name] for name in names])
    return [dict(zip(names, image.tolist(), strict=True)) for image in images]


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Wires(PointMeasurement):
    """Lengths of w wires from anchors in the measuring frame to the tool point, by draw-wire sensors.

    One wire is a draw-wire sensor, three are the paper's device with its lengths L1, L2, L3 (40). An unknown
    anchor i has three instrument parameters `wire<i>.x, .y, .z`, an unknown offset one, `wire<i>.zero`. If
    anchors and base are all unknown, they can move together: six directions are not observable.

    Attributes:
        anchors: Anchors, (w, 3) [m]; NaN if unknown.
        offsets: Constants that the measured lengths contain, (w,) [m]; NaN if unknown.
    """

    anchors: Array
    offsets: Array

    kind = "wires"
    shows_changes = True
    residual_groups: ClassVar = {"length": Group.of(LENGTHS, slice(None))}
    simulated_instrument = "three wires from a triangle of radius 0.3 m, 1.5 m from the tool points"
    COLUMNS = length_columns(
        "lengths", "length", *(f"L{i}" for i in range(1, MAX_WIRES + 1)), plausible_range=instrument_range
    )
    required_columns = (frozenset(["length"]), frozenset(["L1"]))

    def __init__(
        self,
        q: ArrayLike,
        lengths: ArrayLike,
        sigma: ArrayLike | None = None,
        anchors: ArrayLike | None = None,
        offsets: ArrayLike | None = None,
    ) -> None:
        """Check and store measured lengths.

        Args:
            q: Joint positions, (m, n) [rad or m].
            lengths: Measured lengths, (m, w), or (m,) for one wire [m].
            sigma: Standard deviations, one number or (m, w) [m]; estimated with the fit if None.
            anchors: Anchors, (w, 3) [m]; estimated with the fit if None.
            offsets: Constants that the lengths contain, one number or (w,) [m]; estimated if None.

        Raises:
            InvalidArgumentError: The offsets are neither one number nor one per wire.
        """
        q = validated_joint_positions(q, "Wires")
        if np.ndim(lengths) == 1:
            lengths = np.asarray(lengths)[:, None]
        lengths = validated_array(lengths, (len(q), None), "Wires: lengths")
        w = lengths.shape[1]
        if anchors is None:
            anchors = np.full((w, 3), np.nan)
        else:
            anchors = validated_array(anchors, (w, 3), "Wires: anchors", "anchor", per="wire")
        offsets = np.asarray(np.nan if offsets is None else offsets, float)
        if offsets.shape not in ((), (1,), (w,)):
            raise InvalidArgumentError(
                f"Wires: offsets has shape {offsets.shape}; expected one number or one per wire, ({w},)"
            )
        offsets = np.broadcast_to(offsets, w).copy()
        super().__init__(q, lengths, sigma, _wire_parameters(anchors, offsets, np.zeros((w, 3))))
        self.__dict__.update(anchors=anchors, offsets=offsets)

    @classmethod
    def present_columns(cls, values: Mapping[str, Any]) -> tuple[Column, ...]:
        """Return the columns `length` or L1, L2, ... of a file, which are numbered without a gap."""
        single, *numbered = cls.COLUMNS
        if single.name in values:
            return (single,)
        present = [column for column in numbered if column.name in values]
        if present != numbered[: len(present)]:
            names = ", ".join(column.name for column in present)
            raise InvalidArgumentError(f"wires: the columns are {names}; expected L1, L2, ... without a gap")
        return tuple(present)

    def value_columns(self) -> tuple[Column, ...]:
        """Return `length` for one wire, L1, L2, ... for several."""
        count = self.values.shape[1]
        return self.COLUMNS[:1] if count == 1 else self.COLUMNS[1 : count + 1]

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [format_count(self.values.shape[1], "wire"), *super().description()]

    def _instrument_values(self, u: Array) -> tuple[Array, Array]:
        """Return anchors (w, 3) and offsets (w,) with the unknown ones taken from u."""
        anchors, offsets = self.anchors.copy(), self.offsets.copy()
        is_unknown = np.isnan(anchors[:, 0])
        count = 3 * int(is_unknown.sum())
        anchors[is_unknown] = u[:count].reshape(-1, 3)
        offsets[np.isnan(offsets)] = u[count:]
        return anchors, offsets

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the lengths |p - anchor| + offset and their derivatives."""
        anchors, offsets = self._instrument_values(u)
        length, direction = norm_and_direction(points[0][None] - anchors[:, :, None], 1)
        w, m = length.shape
        unknown_anchors = np.flatnonzero(np.isnan(self.anchors[:, 0]))
        unknown_offsets = np.flatnonzero(np.isnan(self.offsets))
        jacobian = np.zeros((3 * len(unknown_anchors) + len(unknown_offsets), w, m))
        for i, wire in enumerate(unknown_anchors):
            jacobian[3 * i : 3 * i + 3, wire] = -direction[wire]
        for i, wire in enumerate(unknown_offsets):
            jacobian[3 * len(unknown_anchors) + i, wire] = 1.0
        return length + offsets[:, None], direction[None], jacobian

    def initialized(self, chain: Chain) -> Self:
        """Return a copy whose unknown anchors fit the lengths best at the chain's tool points."""
        points = chain.poses(self.conditions())[:, :3, 3]
        anchors = np.stack(
            [
                locate_point(points, length - np.nan_to_num(offset))
                for length, offset in zip(self.values.T, self.offsets, strict=True)
            ]
        )
        return self.replace(instrument_parameters=_wire_parameters(self.anchors, self.offsets, anchors))

    def mirror_images(self, chain: Chain, values: Mapping[str, float]) -> list[dict[str, float]]:
        """Return the mirror images of each unknown anchor."""
        points = chain.poses(self.conditions())[:, :3, 3]
        names = (f"wire{i + 1}" for i in np.flatnonzero(np.isnan(self.anchors[:, 0])))
        return [image for name in names for image in images_of_point(name, points, values)]

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Wires:
        """Return lengths of a three-wire device: a triangle of radius 0.3 m, 1.5 m from the tool points."""
        q = conditions.q
        points = chain.forward_kinematics(conditions).tool[3].T
        anchors = (
            points.mean(0) + [-1.5, 0, 0] + 0.3 * np.array([[0, 0, 1], [0, 0.866, -0.5], [0, -0.866, -0.5]])
        )
        lengths = np.linalg.norm(points[:, None] - anchors, axis=2)
        lengths += noise.position * rng.standard_normal(lengths.shape)
        return cls(q, lengths, noise.position or None)


def _wire_parameters(anchors: Array, offsets: Array, start: Array) -> tuple[InstrumentParameter, ...]:
    """Return the parameters of the anchors and offsets that are NaN; anchors start at `start`, (w, 3)."""
    out: list[InstrumentParameter] = []
    for i in np.flatnonzero(np.isnan(anchors[:, 0])):
        out += point_parameters(f"wire{i + 1}", start[i])
    for i in np.flatnonzero(np.isnan(offsets)):
        out.append(InstrumentParameter(f"wire{i + 1}.zero", "m", 0.0, OFFSET_PRIOR))
    return tuple(out)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Distance(PointMeasurement):
    """Distances of the tool point between two configurations, by a ballbar, scale bar or interferometer.

    They do not depend on the base, which moves both positions, nor on the rotation of the tool frame: these
    are not observable.

    Attributes:
        q_to: Joint positions of the second configuration, (m, n) [rad or m].
    """

    q_to: Array

    kind = "distance"
    residual_groups: ClassVar = {"length": Group.of(LENGTHS, slice(0, 1))}
    COLUMNS = length_columns("distances", "distance", plausible_range=displacement_range)
    configurations_per_row = 2
    sample_fields = (*PointMeasurement.sample_fields, "q_to")

    def __init__(
        self, q: ArrayLike, q_to: ArrayLike, distances: ArrayLike, sigma: ArrayLike | None = None
    ) -> None:
        """Check and store measured distances.

        Args:
            q: Joint positions of the first configuration, (m, n) [rad or m].
            q_to: Joint positions of the second configuration, (m, n) [rad or m].
            distances: Measured distances, (m,) [m].
            sigma: Standard deviations, one number or (m,) [m]; estimated with the fit if None.
        """
        q = validated_joint_positions(q, "Distance")
        q_to = validated_array(q_to, q.shape, "Distance: q_to", "row of joint positions")
        values = validated_array(distances, (len(q),), "Distance: distances", "number")[:, None]
        super().__init__(q, values, sigma)
        self.__dict__.update(q_to=q_to)

    def configurations(self) -> Array:
        """Return the joint positions (2m, n): first configurations, then second ones."""
        return np.concatenate([self.q, self.q_to])

    def resample(self, q: Array) -> Self:
        """Return the same measurement at other joint positions (2m, n), first configurations, then second."""
        first, second = np.split(q, 2)
        return self.replace(q=first, q_to=second)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the distances |p_b - p_a| and their derivatives."""
        length, direction = norm_and_direction(points[1] - points[0], 0)
        direction = direction[None]
        return length[None], np.stack([-direction, direction]), np.empty((0, 1, points.shape[-1]))

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return distances between each configuration and the next one, and the last and the first."""
        q = conditions.q
        points = chain.forward_kinematics(q).tool[3].T
        following = np.roll(np.arange(len(q)), -1)
        distances = np.linalg.norm(points[following] - points, axis=1)
        distances += noise.position * rng.standard_normal(len(q))
        return cls(q, q[following], distances, noise.position or None)
