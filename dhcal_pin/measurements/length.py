"""Instruments that read lengths: wires from anchors, the three-wire device, bars between two poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import Chain
from .base import (
    LENGTH_SIGMA,
    ZERO_PRIOR,
    InstrumentParameter,
    Noise,
    columns_together,
    length_columns,
    point_parameters,
    stack_columns,
    validated_array,
    validated_sigma,
)
from .position import PointReading
from .trilateration import anchors_of

MAX_WIRES = 9


@dataclass(frozen=True, eq=False)
class Wires(PointReading):
    """Lengths (m, w) of w wires from anchors in the measuring frame to the tool point; draw-wire sensors.

    One wire is a draw-wire, three are the paper's device with its raw L1, L2, L3 (40). An anchor that is
    not given has three unknowns; a zero that is not given adds one, the length being |p - anchor| + zero.
    Anchors and base together can move as one: with both unknown six directions stay unseen. One wire
    sees distances from its anchor only.

    Attributes:
        anchors: (w, 3) m, NaN where unknown.
        offsets: (w,) m, NaN where unknown.
    """

    anchors: Array = field(default_factory=lambda: np.empty((0, 3)))
    offsets: Array = field(default_factory=lambda: np.empty(0))

    kind: ClassVar[str] = "wires"
    residual_groups: ClassVar[Mapping[str, slice]] = {"length": slice(None)}
    columns: ClassVar[Mapping[str, str]] = length_columns(
        "length", *(f"L{i}" for i in range(1, MAX_WIRES + 1))
    )
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (
        columns_together("length"),
        columns_together("L1"),
    )

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> Wires:
        """`length`, or L1, L2, … in a row, and sigmas; anchors unknown, zeros zero."""
        names = ["length"] if "length" in values else [n for n in cls.columns if n[0] == "L" and n in values]
        if names != ["length"] and names != [f"L{i + 1}" for i in range(len(names))]:
            raise DhcalError(f"wires {', '.join(names)}: number them L1, L2, … without a gap")
        return cls.from_arrays(
            q[0], stack_columns(values, names), stack_columns(values, [f"sigma_{name}" for name in names])
        )

    def value_columns(self) -> tuple[str, ...]:
        """`length` for one wire, L1, L2, … for more."""
        count = self.values.shape[1]
        return ("length",) if count == 1 else tuple(f"L{i + 1}" for i in range(count))

    @classmethod
    def from_arrays(
        cls,
        q: ArrayLike,
        length: ArrayLike,
        sigma: ArrayLike | None = None,
        anchors: ArrayLike | None = None,
        zeros: ArrayLike | None = 0.0,
    ) -> Wires:
        """Checked lengths (m, w) in m at joint values (m, n); anchors (w, 3), None where unknown.

        zeros is a number, (w,), or None to have them estimated.
        """
        q = validated_array(q, (None, None), "q")
        length = validated_array(length, (len(q), None), "length")
        w = length.shape[1]
        anchors = np.full((w, 3), np.nan) if anchors is None else validated_array(anchors, (w, 3), "anchors")
        zeros = np.full(w, np.nan) if zeros is None else np.broadcast_to(np.asarray(zeros, float), w).copy()
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, length.shape, "sigma")
        rows = np.arange(1, len(q) + 1)
        return cls(
            q,
            length,
            sigmas,
            rows,
            sigma is not None,
            _wire_unknowns(anchors, zeros, np.zeros((w, 3))),
            anchors,
            zeros,
        )

    def _instrument(self, u: Array) -> tuple[Array, Array]:
        """Anchors (w, 3) and zeros (w,) with the unknowns filled in."""
        anchors, zeros = self.anchors.copy(), self.offsets.copy()
        free = np.isnan(anchors[:, 0])
        count = 3 * int(free.sum())
        anchors[free] = u[:count].reshape(-1, 3)
        zeros[np.isnan(zeros)] = u[count:]
        return anchors, zeros

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """|p - anchor| + zero of each wire."""
        anchors, zeros = self._instrument(u)
        reach = points[0][None] - anchors[:, :, None]
        length = np.linalg.norm(reach, axis=1)
        direction = reach / np.maximum(length, 1e-12)[:, None]
        w, m = length.shape
        free = np.flatnonzero(np.isnan(self.anchors[:, 0]))
        loose = np.flatnonzero(np.isnan(self.offsets))
        own = np.zeros((3 * len(free) + len(loose), w, m))
        for i, wire in enumerate(free):
            own[3 * i : 3 * i + 3, wire] = -direction[wire]
        for i, wire in enumerate(loose):
            own[3 * len(free) + i, wire] = 1.0
        return length + zeros[:, None], direction[None], own

    def initialized(self, chain: Chain) -> Self:
        """Unknown anchors where spheres about the chain's tool points meet best."""
        points = chain.poses(self.q)[:, :3, 3]
        found = np.stack([anchors_of(points, length - np.nan_to_num(zero))
                          for length, zero in zip(self.values.T, self.offsets, strict=True)])  # fmt: skip
        return replace(self, instrument_parameters=_wire_unknowns(self.anchors, self.offsets, found))

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Wires:
        """The three-wire device, an equilateral rig of 300 mm a metre and a half away; raw lengths."""
        q = chain.validated_q(q)
        points = chain.forward_kinematics(q).tool[3].T
        anchors = (
            points.mean(0) + [-1.5, 0, 0] + 0.3 * np.array([[0, 0, 1], [0, 0.866, -0.5], [0, -0.866, -0.5]])
        )
        length = np.linalg.norm(points[:, None] - anchors, axis=2)
        length += noise.position * rng.standard_normal(length.shape)
        return cls.from_arrays(q, length, noise.position or None)


def _wire_unknowns(anchors: Array, zeros: Array, start: Array) -> tuple[InstrumentParameter, ...]:
    out: list[InstrumentParameter] = []
    for i in np.flatnonzero(np.isnan(anchors[:, 0])):
        out += point_parameters(f"wire{i + 1}", start[i])
    for i in np.flatnonzero(np.isnan(zeros)):
        out.append(InstrumentParameter(f"wire{i + 1}.zero", "m", 0.0, ZERO_PRIOR))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Distance(PointReading):
    """Distances (m, 1) of the tool point between two configurations: ballbar, scale bar, interferometer.

    Sees nothing of the base, which moves both ends alike: six directions stay unseen, and so does the
    tool's rotation.

    Attributes:
        q_to: (m, n) joint values at the other end.
    """

    q_to: Array = field(default_factory=lambda: np.empty((0, 0)))

    kind: ClassVar[str] = "distance"
    residual_groups: ClassVar[Mapping[str, slice]] = {"length": slice(0, 1)}
    columns: ClassVar[Mapping[str, str]] = length_columns("distance")
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together("distance"),)
    configurations_per_row: ClassVar[int] = 2
    sample_fields: ClassVar = (*PointReading.sample_fields, "q_to")

    @classmethod
    def from_arrays(
        cls, q: ArrayLike, q_to: ArrayLike, distance: ArrayLike, sigma: ArrayLike | None = None
    ) -> Distance:
        """Checked distances (m,) in m between configurations (m, n) and (m, n)."""
        q = validated_array(q, (None, None), "q")
        q_to = validated_array(q_to, q.shape, "q_to")
        distance = validated_array(distance, (len(q),), "distance")[:, None]
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, distance.shape, "sigma")
        return cls(q, distance, sigmas, np.arange(1, len(q) + 1), sigma is not None, (), q_to)

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> Distance:
        """`distance` between the configurations JOINT and to:JOINT."""
        sigma = values.get("sigma_distance")
        return cls.from_arrays(q[0], q[1], values["distance"], None if sigma is None else sigma[:, None])

    def configurations(self) -> Array:
        """First ends, then other ends, (2m, n)."""
        return np.concatenate([self.q, self.q_to])

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """|p_to - p|."""
        reach = points[1] - points[0]
        length = np.linalg.norm(reach, axis=0)
        direction = (reach / np.maximum(length, 1e-12))[None]
        return length[None], np.stack([-direction, direction]), np.empty((0, 1, points.shape[-1]))

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Distance:
        """Distances between each configuration and the next, the last and the first."""
        q = chain.validated_q(q)
        points = chain.forward_kinematics(q).tool[3].T
        other = np.roll(np.arange(len(q)), -1)
        length = np.linalg.norm(points[other] - points, axis=1) + noise.position * rng.standard_normal(len(q))
        return cls.from_arrays(q, q[other], length, noise.position or None)
