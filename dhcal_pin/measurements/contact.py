"""Contacts of the tool point with points, planes and spheres, which need no measuring instrument.

    point          h = p - point                 measured value 0, (3,)
    plane          h = distance from the plane   measured value 0
    sphere         h = |p - centre|              measured value: the known radius
    distance       h = |point_b - point_a|       measured value: the known distance; it does not depend on p

The touched objects are instrument parameters. Points and planes alone do not determine the scale of the
robot.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from ..robot.inverse_kinematics import position_task, solve_within_limits
from .base import POINT_PRIOR, InstrumentParameter, Measurement, Noise, point_parameters
from .columns import instrument_range, length_columns, point_distance_range, text_column
from .groups import LENGTHS, POSITION, Group
from .length import images_of_point
from .mounting import MountedRig
from .position import NamedPointMeasurement, PointMeasurement
from .trilateration import MIN_DIVISOR, locate_point, norm_and_direction
from .validation import encode_labels, validated_array, validated_joint_positions

# Initial position of a touched point before `initialized` [m].
_ORIGIN = np.zeros(3)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PointContact(NamedPointMeasurement):
    """Contacts of the tool point with fixed unknown points, such as sockets or pins.

    Each point is touched in many configurations. Samples with the same name touch the same point, which has
    three instrument parameters `point_NAME.x, .y, .z` in the measuring frame. The pose of the base is not
    observable, and neither is the scale of the robot unless a `PointDistance` is known.

    The names are in the order of first appearance.
    """

    kind = "point"
    is_contact = True
    shows_changes = True
    has_length_scale = False
    label_column = "point"
    residual_groups: ClassVar = {"position": POSITION}
    COLUMNS = text_column("points", "point") + length_columns("", "x", "y", "z", is_implied=True)

    def __init__(self, q: ArrayLike, points: Sequence[str], sigma: ArrayLike | None = None) -> None:
        """Check and store contacts with named points."""
        q = validated_joint_positions(q, "PointContact")
        names, label = encode_labels(points, len(q), "PointContact: points")
        parameters = tuple(u for name in names for u in point_parameters(f"point_{name}", _ORIGIN))
        super().__init__(q, np.zeros((len(q), 3)), sigma, parameters)
        self.__dict__.update(label=label, names=names)

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the tool points relative to the touched points, and their derivatives."""
        by_tool = np.broadcast_to(np.eye(3)[None, :, :, None], (1, 3, 3, points.shape[-1]))
        return points[0] - u.reshape(-1, 3)[self.label].T, by_tool, self._by_touched_points

    @cached_property
    def _by_touched_points(self) -> Array:
        """Derivatives (s, 3, m) of the model by the coordinates of the touched points."""
        is_touched = self.label == np.arange(len(self.names))[:, None]
        return -np.einsum("pm,ij->pijm", is_touched, np.eye(3)).reshape(-1, 3, len(self.label))

    def initialized(self, chain: Chain) -> Self:
        """Return a copy in which each point starts at the mean of the chain's tool points that touch it."""
        tool = chain.poses(self.conditions())[:, :3, 3]
        parameters: list[InstrumentParameter] = []
        for i, name in enumerate(self.names):
            contacts = tool[self.label == i]
            parameters += point_parameters(f"point_{name}", contacts.mean(0) if len(contacts) else _ORIGIN)
        return self.replace(instrument_parameters=tuple(parameters))

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return contacts with the first four tool points, in configurations moved onto them in turn."""
        q = conditions.q
        points = _simulated_points(chain, q)
        label = np.arange(len(q)) % len(points)
        targets = points[label] + noise.position * rng.standard_normal((len(q), 3))
        q = solve_within_limits(chain, position_task(targets), q, rng)
        return cls(q, [f"p{i + 1}" for i in label], noise.position or None)


def _simulated_points(chain: Chain, q: Array) -> Array:
    """Return the points that simulated contacts touch: the first four tool points."""
    return chain.poses(q)[:4, :3, 3]


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PointDistance(PointMeasurement):
    """Known distances between touched points, such as a tool with two sockets or a gauge block.

    They carry no information about the robot alone: the points must be touched too (`PointContact`).

    Attributes:
        label: Indices of the two points in `names`, (m, 2).
        names: Names of the points in order of first appearance.
    """

    label: Array
    names: tuple[str, ...]

    kind = "point_distance"
    residual_groups: ClassVar = {"length": Group.of(LENGTHS, slice(0, 1))}
    COLUMNS = (
        *text_column("point_a", "point_a"),
        *text_column("point_b", "point_b"),
        *length_columns("distances", "distance", plausible_range=point_distance_range),
    )
    configurations_per_row = 0
    has_length_scale = True
    sample_fields = (*PointMeasurement.sample_fields, "label")

    def __init__(
        self,
        n_joints: int,
        pairs: Sequence[tuple[str, str]],
        distances: ArrayLike,
        sigma: ArrayLike | None = None,
    ) -> None:
        """Check and store known distances.

        Args:
            n_joints: Number n of joints of the robot whose measurements are used together with the distances.
            pairs: Names of the two points of each distance, (m, 2).
            distances: Distances, (m,) [m].
            sigma: Standard deviations, one number or (m,) [m]; estimated with the fit if None.
        """
        m = len(pairs)
        distances = validated_array(distances, (m,), "PointDistance: distances", "number")[:, None]
        ends = [name for pair in pairs for name in pair]
        names, label = encode_labels(ends, 2 * m, "PointDistance: pairs")
        # NaN: the kind that touches the points provides their initial positions.
        unknown = np.full(3, np.nan)
        parameters = tuple(u for name in names for u in point_parameters(f"point_{name}", unknown))
        super().__init__(np.zeros((m, n_joints)), distances, sigma, parameters)
        self.__dict__.update(label=label.reshape(-1, 2), names=names)

    @classmethod
    def from_columns(
        cls, q: Sequence[Array], values: Mapping[str, Any], rig: MountedRig | None = None
    ) -> Self:
        """Return the distances of a file."""
        arguments = cls._arguments(values)
        pairs = list(zip(arguments.pop("point_a"), arguments.pop("point_b"), strict=True))
        return cls(q[0].shape[1], pairs, **arguments)

    def text_values(self) -> dict[str, Sequence[str]]:
        """Return the names of both points."""
        return {f"point_{end}": [self.names[i] for i in self.label[:, j]] for j, end in enumerate("ab")}

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the distances |point_b - point_a|, and their derivatives."""
        m = points.shape[-1]
        touched = u.reshape(-1, 3)
        length, direction = norm_and_direction((touched[self.label[:, 1]] - touched[self.label[:, 0]]).T, 0)
        index = np.arange(len(self.names))[:, None]
        sign = (self.label[None, :, 1] == index).astype(float) - (self.label[None, :, 0] == index)
        jacobian = (sign[:, None] * direction[None]).reshape(-1, 1, m)
        return length[None], np.zeros((1, 1, 3, m)), jacobian

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return the distances between the points that `PointContact` touches with these configurations."""
        points = _simulated_points(chain, conditions.q)
        pairs = [(i, j) for i in range(len(points)) for j in range(i + 1, len(points))]
        if not pairs:
            raise InvalidArgumentError("one sample has no pair of points; expected 2 samples or more")
        distances = np.array([np.linalg.norm(points[i] - points[j]) for i, j in pairs])
        distances += noise.position * rng.standard_normal(len(pairs))
        names = [(f"p{i + 1}", f"p{j + 1}") for i, j in pairs]
        return cls(chain.n_joints, names, distances, noise.position or None)


def require_touched_points(data: Sequence[Measurement], known: Container[str] = ()) -> None:
    """Raise an error if a distance beside other measurements is between points that none of them touches."""
    if all(isinstance(item, PointDistance) for item in data):
        return
    touched = sorted({name for item in data if isinstance(item, PointContact) for name in item.names})
    choice = f"choose from {', '.join(touched)}" if touched else "expected measurements of kind point"
    for item in data:
        for name in item.names if isinstance(item, PointDistance) else ():
            if name not in touched and f"point_{name}.x" not in known:
                where = item.source or item.kind
                raise UnknownNameError(f"{where}: no measurement touches the point {name!r}; {choice}")


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PlaneContact(PointMeasurement):
    """Contacts of the tool point with an unknown plane, such as a surface plate or a wall.

    The plane has three instrument parameters u = (s, t, h), two tilts and a height, relative to a chart that
    `initialized` lays through the tool points:

        (p - origin)·(normal + s·across + t·along) = h·|normal + s·across + t·along|

    Neither the pose of the base nor the scale of the robot is observable: a scaled robot touches a scaled
    plane.

    Attributes:
        name: Name of the plane. The parameters are local: objects do not share a plane of the same name.
        origin: Point near the plane, (3,) [m].
        axes: Rows normal, across and along of the chart, (3, 3).
    """

    name: str
    origin: Array
    axes: Array

    kind = "plane"
    is_contact = True
    has_length_scale = False
    residual_groups: ClassVar = {"height": Group.of(LENGTHS, slice(0, 1))}
    COLUMNS = text_column("name", "plane", is_common=True) + length_columns("", "plane", is_implied=True)

    def __init__(self, q: ArrayLike, sigma: ArrayLike | None = None, name: str = "1") -> None:
        """Check and store contacts with a plane."""
        q = validated_joint_positions(q, "PlaneContact")
        parameters = tuple(
            InstrumentParameter(f"plane_{name}.{parameter}", unit, 0.0, POINT_PRIOR, is_local=True)
            for parameter, unit in (("tilt_1", "rad"), ("tilt_2", "rad"), ("height", "m"))
        )
        super().__init__(q, np.zeros((len(q), 1)), sigma, parameters)
        self.__dict__.update(name=name, origin=np.zeros(3), axes=np.eye(3))

    def text_values(self) -> dict[str, Sequence[str]]:
        """Return the name of the plane for each sample."""
        return {"plane": [self.name] * len(self.rows)}

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the heights of the tool points above the plane, and their derivatives."""
        tilted = self.axes[0] + u[0] * self.axes[1] + u[1] * self.axes[2]
        norm = np.linalg.norm(tilted)
        normal = tilted / norm
        arm = points[0] - self.origin[:, None]
        height = normal @ arm
        m = points.shape[-1]
        tilts = (self.axes[1:] - np.outer(self.axes[1:] @ normal, normal)) / norm @ arm
        jacobian = np.concatenate([tilts, -np.ones((1, m))])[:, None]
        return (height - u[2])[None], np.tile(normal[None, None, :, None], (1, 1, 1, m)), jacobian

    def initialized(self, chain: Chain) -> Self:
        """Return a copy whose chart is the plane that fits the chain's tool points best."""
        points = chain.poses(self.conditions())[:, :3, 3]
        origin = points.mean(0)
        return self.replace(origin=origin, axes=np.linalg.svd(points - origin)[2][::-1])

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return contacts with a tilted plane amid the tool points, in configurations moved onto it."""
        q = conditions.q
        centre = chain.poses(q)[:, :3, 3].mean(0)
        normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
        height = noise.position * rng.standard_normal(len(q))

        def task(poses: Array, index: Array) -> tuple[Array, Array]:
            error = (poses[:, :3, 3] - centre) @ normal - height[index]
            return error[:, None], np.broadcast_to(normal, (len(poses), 1, 3))

        return cls(solve_within_limits(chain, task, q, rng), noise.position or None)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class SphereContact(PointMeasurement):
    """Contacts of the tool point with a sphere of known radius and unknown centre.

    The centre has three instrument parameters `sphere_NAME.x, .y, .z` in the measuring frame.

    Attributes:
        name: Name of the sphere.
    """

    name: str

    kind = "sphere"
    is_contact = True
    residual_groups: ClassVar = {"radius": Group.of(LENGTHS, slice(0, 1))}
    COLUMNS = text_column("name", "sphere", is_common=True) + length_columns(
        "radius", "radius", plausible_range=instrument_range
    )

    def __init__(
        self, q: ArrayLike, radius: ArrayLike, sigma: ArrayLike | None = None, name: str = "1"
    ) -> None:
        """Check and store contacts with a sphere.

        Args:
            q: Joint positions, (m, n) [rad or m].
            radius: Radius at the tool point, one number or (m,) [m].
            sigma: Standard deviations of the radius, one number or (m,) [m]; estimated with the fit if None.
            name: Name of the sphere.
        """
        q = validated_joint_positions(q, "SphereContact")
        if np.ndim(radius) == 0:
            radius = np.full(len(q), radius)
        values = validated_array(radius, (len(q),), "SphereContact: radius", "number")[:, None]
        super().__init__(q, values, sigma, point_parameters(f"sphere_{name}", _ORIGIN))
        self.__dict__.update(name=name)

    def text_values(self) -> dict[str, Sequence[str]]:
        """Return the name of the sphere for each sample."""
        return {"sphere": [self.name] * len(self.rows)}

    def model(self, points: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the distances |p - centre|, and their derivatives."""
        length, direction = norm_and_direction(points[0] - u[:, None], 0)
        return length[None], direction[None, None], -direction[:, None]

    def initialized(self, chain: Chain) -> Self:
        """Return a copy whose centre fits the chain's tool points best."""
        centre = locate_point(chain.poses(self.conditions())[:, :3, 3], self.values[:, 0])
        return self.replace(instrument_parameters=point_parameters(f"sphere_{self.name}", centre))

    def mirror_images(self, chain: Chain, values: Mapping[str, float]) -> list[dict[str, float]]:
        """Return the mirror images of the centre."""
        points = chain.poses(self.conditions())[:, :3, 3]
        return images_of_point(f"sphere_{self.name}", points, values)

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return contacts with a sphere of radius 150 mm, in configurations moved onto it."""
        q = conditions.q
        centre = chain.poses(q)[0, :3, 3]
        radius = 0.15
        noisy_radius = radius + noise.position * rng.standard_normal(len(q))

        def task(poses: Array, index: Array) -> tuple[Array, Array]:
            arm = poses[:, :3, 3] - centre
            length = np.linalg.norm(arm, axis=1)
            direction = arm / np.maximum(length, MIN_DIVISOR)[:, None]
            return (length - noisy_radius[index])[:, None], direction[:, None]

        return cls(solve_within_limits(chain, task, q, rng), radius, noise.position or None)
