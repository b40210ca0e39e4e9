"""Measuring without an instrument: touching points, planes and spheres, and known distances between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import Chain
from ..robot.inverse_kinematics import position_task, solve_within_limits
from .base import (
    LENGTH_SIGMA,
    POINT_PRIOR,
    InstrumentParameter,
    Noise,
    columns_together,
    length_columns,
    point_parameters,
    stack_columns,
    validated_array,
    validated_sigma,
)
from .position import PointReading, encode_labels
from .trilateration import anchors_of

_NOWHERE = np.zeros(3)


_SIGMAS = ("sigma_x", "sigma_y", "sigma_z")


def only_value(words: Sequence[str], what: str) -> str:
    """The one word that all of them are, or DhcalError."""
    if len(set(words)) != 1:
        raise DhcalError(f"{what}: {', '.join(sorted(set(words)))} in one file; give each a file of its own")
    return words[0]


@dataclass(frozen=True, eq=False)
class PointContact(PointReading):
    """The tool point at fixed but unknown points, each touched from many configurations: sockets, pins.

    Rows of one name are the same point (three unknowns `point_NAME.x, .y, .z` in the measuring frame).
    Sees nothing of where the robot stands, nor of its scale unless a distance between points is known.

    Attributes:
        label: (m,) which of the names.
        names: the points in order of first appearance.
    """

    label: Array = field(default_factory=lambda: np.empty(0, int))
    names: tuple[str, ...] = ()

    kind: ClassVar[str] = "point"
    is_contact: ClassVar[bool] = True
    has_length_scale: ClassVar[bool] = False
    residual_groups: ClassVar[Mapping[str, slice]] = {"position": slice(0, 3)}
    columns: ClassVar[Mapping[str, str]] = {"point": "text", **dict.fromkeys(_SIGMAS, "length")}
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together("point"),)
    sample_fields: ClassVar = (*PointReading.sample_fields, "label")

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> PointContact:
        """`point`, and sigmas."""
        return cls.from_arrays(q[0], values["point"], stack_columns(values, _SIGMAS))

    def to_columns(self) -> dict[str, Any]:
        """`point`, and sigmas."""
        out: dict[str, Any] = {"point": [self.names[i] for i in self.label]}
        return out | (
            {name: self.sigma[:, i] for i, name in enumerate(_SIGMAS)} if self.has_stated_sigma else {}
        )

    @classmethod
    def from_arrays(cls, q: ArrayLike, points: Sequence[str], sigma: ArrayLike | None = None) -> PointContact:
        """Checked contacts at joint values (m, n) with named points (m,); sigma in m."""
        q = validated_array(q, (None, None), "q")
        names, label = encode_labels(points, len(q), "points")
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, (len(q), 3), "sigma")
        rows, zero = np.arange(1, len(q) + 1), np.zeros((len(q), 3))
        unknowns = tuple(u for name in names for u in point_parameters(f"point_{name}", _NOWHERE))
        return cls(q, zero, sigmas, rows, sigma is not None, unknowns, label, names)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """P - point, which is read as zero."""
        m = points.shape[-1]
        mine = self.label[None] == np.arange(len(self.names))[:, None]
        own = -1.0 * mine[:, None, None, :] * np.eye(3)[None, :, :, None]
        at = u.reshape(-1, 3)[self.label].T
        return points[0] - at, np.tile(np.eye(3)[None, :, :, None], (1, 1, 1, m)), own.reshape(-1, 3, m)

    def initialized(self, chain: Chain) -> Self:
        """Each point where the chain touches it on average."""
        tool = chain.poses(self.q)[:, :3, 3]
        unknowns: list[InstrumentParameter] = []
        for i, name in enumerate(self.names):
            mine = tool[self.label == i]
            unknowns += point_parameters(f"point_{name}", mine.mean(0) if len(mine) else _NOWHERE)
        return replace(self, instrument_parameters=tuple(unknowns))

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> PointContact:
        """Configurations moved so that they touch four points near where they were."""
        q = chain.validated_q(q)
        at = chain.poses(q)[:4, :3, 3]
        label = np.arange(len(q)) % len(at)
        targets = at[label] + noise.position * rng.standard_normal((len(q), 3))
        q = solve_within_limits(chain, position_task(targets), q, rng)
        return cls.from_arrays(q, [f"p{i + 1}" for i in label], noise.position or None)


@dataclass(frozen=True, eq=False)
class PointDistance(PointReading):
    """Known distances (m, 1) between touched points: a two-socket tool, a gauge block.

    It says nothing by itself: the points must be touched too.

    Attributes:
        label: (m, 2) which of the names.
        names: the points in order of first appearance.
    """

    label: Array = field(default_factory=lambda: np.empty((0, 2), int))
    names: tuple[str, ...] = ()

    kind: ClassVar[str] = "point_distance"
    residual_groups: ClassVar[Mapping[str, slice]] = {"length": slice(0, 1)}
    columns: ClassVar[Mapping[str, str]] = {
        "point_a": "text",
        "point_b": "text",
        **length_columns("distance"),
    }
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (
        columns_together("point_a", "point_b", "distance"),
    )
    configurations_per_row: ClassVar[int] = 0
    sample_fields: ClassVar = (*PointReading.sample_fields, "label")

    @classmethod
    def from_arrays(
        cls, size: int, pairs: Sequence[tuple[str, str]], distance: ArrayLike, sigma: ArrayLike | None = None
    ) -> PointDistance:
        """Checked distances (m,) in m between named points (m, 2), for a chain of `size` joints."""
        distance = validated_array(distance, (len(pairs),), "distance")[:, None]
        names, label = encode_labels([name for pair in pairs for name in pair], 2 * len(pairs), "points")
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, distance.shape, "sigma")
        # Where the points are, those who touch them know.
        unknowns = tuple(u for name in names for u in point_parameters(f"point_{name}", np.full(3, np.nan)))
        q, rows = np.zeros((len(pairs), size)), np.arange(1, len(pairs) + 1)
        return cls(q, distance, sigmas, rows, sigma is not None, unknowns, label.reshape(-1, 2), names)

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> PointDistance:
        """`point_a`, `point_b`, `distance`, and its sigma."""
        sigma = values.get("sigma_distance")
        pairs = list(zip(values["point_a"], values["point_b"], strict=True))
        size = q[0].shape[1]
        return cls.from_arrays(size, pairs, values["distance"], None if sigma is None else sigma[:, None])

    def to_columns(self) -> dict[str, Any]:
        """`point_a`, `point_b`, `distance`, and its sigma."""
        ends = {f"point_{end}": [self.names[i] for i in self.label[:, j]] for j, end in enumerate("ab")}
        return ends | super().to_columns()

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """|point_b - point_a|."""
        at = u.reshape(-1, 3)
        reach = (at[self.label[:, 1]] - at[self.label[:, 0]]).T
        length = np.linalg.norm(reach, axis=0)
        direction = reach / np.maximum(length, 1e-12)
        ends = np.arange(len(self.names))[:, None]
        sign = (self.label[None, :, 1] == ends).astype(float) - (self.label[None, :, 0] == ends)
        own = (sign[:, None] * direction[None]).reshape(-1, 1, points.shape[-1])
        return length[None], np.zeros((1, 1, 3, points.shape[-1])), own

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> PointDistance:
        """Distances between four points of a rig of half a metre."""
        at = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.4, 0], [0, 0, 0.3]])
        pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
        length = np.array([np.linalg.norm(at[i] - at[j]) for i, j in pairs])
        length += noise.position * rng.standard_normal(len(pairs))
        named = [(f"p{i + 1}", f"p{j + 1}") for i, j in pairs]
        return cls.from_arrays(chain.n_joints, named, length, noise.position or None)


@dataclass(frozen=True, eq=False)
class PlaneContact(PointReading):
    """The tool point on an unknown plane: a surface plate, a wall. Three unknowns: two tilts and a height.

    Sees neither where the robot stands nor its scale: a robot and a height twice as large touch as well.

    With u = (s, t, h): (p - origin)·(normal + s·across + t·along) = h·|normal + s·across + t·along|.

    Attributes:
        name: of the plane; measurements with the same name touch the same plane only within one item.
        origin: (3,) a point near the plane, and axes: (3, 3) rows normal, across, along; the chart.
    """

    name: str = "1"
    origin: Array = field(default_factory=lambda: np.zeros(3))
    axes: Array = field(default_factory=lambda: np.eye(3))

    kind: ClassVar[str] = "plane"
    is_contact: ClassVar[bool] = True
    has_length_scale: ClassVar[bool] = False
    residual_groups: ClassVar[Mapping[str, slice]] = {"height": slice(0, 1)}
    columns: ClassVar[Mapping[str, str]] = {"plane": "text", "sigma_plane": "length"}
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together("plane"),)

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> PlaneContact:
        """`plane`, one name a file, and the sigma along its normal."""
        sigma = values.get("sigma_plane")
        return cls.from_arrays(
            q[0], None if sigma is None else sigma[:, None], only_value(values["plane"], "plane")
        )

    def to_columns(self) -> dict[str, Any]:
        """`plane`, and the sigma along its normal."""
        out: dict[str, Any] = {"plane": [self.name] * len(self.rows)}
        return out | ({"sigma_plane": self.sigma[:, 0]} if self.has_stated_sigma else {})

    @classmethod
    def from_arrays(cls, q: ArrayLike, sigma: ArrayLike | None = None, name: str = "1") -> PlaneContact:
        """Checked contacts at joint values (m, n) with the plane `name`; sigma along its normal in m."""
        q = validated_array(q, (None, None), "q")
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, (len(q), 1), "sigma")
        unknowns = (
            InstrumentParameter(f"plane_{name}.tilt_1", "rad", 0.0, POINT_PRIOR, is_local=True),
            InstrumentParameter(f"plane_{name}.tilt_2", "rad", 0.0, POINT_PRIOR, is_local=True),
            InstrumentParameter(f"plane_{name}.height", "m", 0.0, POINT_PRIOR, is_local=True),
        )
        rows = np.arange(1, len(q) + 1)
        return cls(q, np.zeros((len(q), 1)), sigmas, rows, sigma is not None, unknowns, name=name)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """The point's height over the plane, which is read as zero."""
        leaning = self.axes[0] + u[0] * self.axes[1] + u[1] * self.axes[2]
        size = np.linalg.norm(leaning)
        normal = leaning / size
        arm = points[0] - self.origin[:, None]
        height = normal @ arm
        m = points.shape[-1]
        tilts = (self.axes[1:] - np.outer(self.axes[1:] @ normal, normal)) / size @ arm
        own = np.concatenate([tilts, -np.ones((1, m))])[:, None]
        return (height - u[2])[None], np.tile(normal[None, None, :, None], (1, 1, 1, m)), own

    def initialized(self, chain: Chain) -> Self:
        """The plane that fits the chain's tool points best."""
        points = chain.poses(self.q)[:, :3, 3]
        origin = points.mean(0)
        axes = np.linalg.svd(points - origin)[2][::-1]
        return replace(self, origin=origin, axes=axes)

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> PlaneContact:
        """Configurations moved so that they touch a tilted plate through the middle of where they were."""
        q = chain.validated_q(q)
        middle = chain.poses(q)[:, :3, 3].mean(0)
        normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
        height = noise.position * rng.standard_normal(len(q))

        def gap(poses: Array, which: Array) -> tuple[Array, Array]:
            wide = (poses[:, :3, 3] - middle) @ normal - height[which]
            return wide[:, None], np.broadcast_to(normal, (len(poses), 1, 3))

        return cls.from_arrays(solve_within_limits(chain, gap, q, rng), noise.position or None)


@dataclass(frozen=True, eq=False)
class SphereContact(PointReading):
    """The tool point on a sphere of known radius and unknown centre (`sphere_NAME.x, .y, .z`).

    The reading is the radius.

    Attributes:
        name: of the sphere.
    """

    name: str = "1"

    kind: ClassVar[str] = "sphere"
    is_contact: ClassVar[bool] = True
    residual_groups: ClassVar[Mapping[str, slice]] = {"radius": slice(0, 1)}
    columns: ClassVar[Mapping[str, str]] = {"sphere": "text", **length_columns("radius")}
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together("sphere", "radius"),)

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> SphereContact:
        """`sphere`, one name a file, `radius`, and its sigma."""
        sigma = values.get("sigma_radius")
        name = only_value(values["sphere"], "sphere")
        return cls.from_arrays(q[0], values["radius"], None if sigma is None else sigma[:, None], name)

    def to_columns(self) -> dict[str, Any]:
        """`sphere`, `radius`, and its sigma."""
        return {"sphere": [self.name] * len(self.rows)} | super().to_columns()

    @classmethod
    def from_arrays(
        cls, q: ArrayLike, radius: ArrayLike, sigma: ArrayLike | None = None, name: str = "1"
    ) -> SphereContact:
        """Checked contacts at joint values (m, n) with a sphere of radius m, one number or (m,)."""
        q = validated_array(q, (None, None), "q")
        reading = validated_array(np.broadcast_to(np.asarray(radius, float), len(q)), (len(q),), "radius")[
            :, None
        ]
        sigmas = validated_sigma(LENGTH_SIGMA if sigma is None else sigma, reading.shape, "sigma")
        rows = np.arange(1, len(q) + 1)
        unknowns = point_parameters(f"sphere_{name}", _NOWHERE)
        return cls(q, reading.copy(), sigmas, rows, sigma is not None, unknowns, name)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """|p - centre|."""
        reach = points[0] - u[:, None]
        length = np.linalg.norm(reach, axis=0)
        direction = reach / np.maximum(length, 1e-12)
        return length[None], direction[None, None], -direction[:, None]

    def initialized(self, chain: Chain) -> Self:
        """The centre that fits the chain's tool points best."""
        points = chain.poses(self.q)[:, :3, 3]
        return replace(
            self,
            instrument_parameters=point_parameters(
                f"sphere_{self.name}", anchors_of(points, self.values[:, 0])
            ),
        )

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> SphereContact:
        """Configurations moved so that they touch a sphere of 150 mm about where they were."""
        q = chain.validated_q(q)
        centre = chain.poses(q)[0, :3, 3]
        radius = 0.15
        length = radius + noise.position * rng.standard_normal(len(q))

        def gap(poses: Array, which: Array) -> tuple[Array, Array]:
            reach = poses[:, :3, 3] - centre
            size = np.linalg.norm(reach, axis=1)
            return (size - length[which])[:, None], (reach / np.maximum(size, 1e-12)[:, None])[:, None]

        return cls.from_arrays(solve_within_limits(chain, gap, q, rng), radius, noise.position or None)
