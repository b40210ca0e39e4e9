"""Collisions of a robot with itself, the floor and obstacles, and line of sight, by Pinocchio and Coal.

The collision geometry of the URDF is checked pair by pair. Pairs of shapes on one link or on neighbouring
links are not checked. Pairs that collide both at the neutral configuration and in the middle of the joint
limits are not checked either: their shapes overlap in the robot description.

Floor and obstacles stand still in the frame of the root link. They are checked against the shapes that the
chain moves, with a clearance. A robot without collision geometry is represented by thin capsules between its
joints. The first link may stand on the floor or on an obstacle: such a pair is not checked if it collides at
the neutral configuration and in the middle of the limits. A line of sight is a thin capsule between
instrument and tool. The view of a camera is the convex hull of its centre and the corners that it sees.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from functools import cached_property
from typing import Any
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..exceptions import FileFormatError
from ..native_output import discard_native_messages
from ..ros_packages import MAX_MESH_BYTES, is_mesh_too_large, mesh_remedy
from .chain import Chain
from .urdf import Urdf
from .urdf_path import build_model

# Diameter of a line of sight [m].
SIGHT_DIAMETER = 5e-3
# Smallest distance of the robot from floor and obstacles [m]: calibration errors and the steps of the check.
CLEARANCE = 10e-3
# Radius of the capsules that represent a robot without collision geometry, and the mount of its tool [m].
_LINK_RADIUS, _TOOL_RADIUS = 20e-3, 5e-3
# Length of a capsule below which it is omitted [m].
_MIN_CAPSULE_LENGTH = 1e-3
# Name and size of the floor [m]. It is a box, because Coal finds collisions of meshes and half-spaces slowly.
FLOOR, _FLOOR_SIZE = "floor", (100.0, 100.0, 2.0)


@frozen(eq=False)
class Obstacle:
    """Body that stands still.

    Attributes:
        name: Name for messages.
        shape: Shape of Coal.
        placement: Pose of the shape in the frame of the root link, shape (4, 4) [m].
    """

    name: str
    shape: Any
    placement: Array

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike, name: str = "box") -> Obstacle:
        """Create a box whose edges are parallel to the axes of the root link.

        Args:
            low: Lowest x, y, z, shape (3,) [m].
            high: Highest x, y, z, shape (3,) [m].
            name: Name for messages.

        Returns:
            Obstacle.
        """
        low, high = np.asarray(low, float), np.asarray(high, float)
        return cls(name, coal.Box(*(high - low).tolist()), se3.transform(np.eye(3), 0.5 * (low + high)))

    @classmethod
    def floor(cls, height: float) -> Obstacle:
        """Create the floor from the height z of its surface in the frame of the root link [m]."""
        length, width, depth = _FLOOR_SIZE
        return cls.box(
            np.array([-length / 2, -width / 2, height - depth]),
            np.array([length / 2, width / 2, height]),
            FLOOR,
        )


@frozen(eq=False)
class CollisionChecker:
    """Collision checks of a robot."""

    chain: Chain  #: Kinematic chain of the robot.
    geometry: Any  #: Pinocchio's collision shapes and the pairs to check; None if there is nothing to check.
    note: str = ""  #: What is not checked and why, or an empty text.
    n_robot_shapes: int = 0  #: Number of shapes of the robot, which precede those of floor and obstacles.

    @classmethod
    def from_chain(cls, chain: Chain, obstacles: Sequence[Obstacle] = ()) -> CollisionChecker:
        """Load the collision geometry of a chain's URDF."""
        geometry, problem = _load_geometry(chain.urdf, chain.model)
        note = f"self-collision is not checked: {problem}" if problem else ""
        if geometry is not None:
            _add_self_collision_pairs(chain, geometry)
        if not obstacles:
            return cls(chain, geometry, note, geometry.ngeoms if geometry is not None else 0)
        if geometry is None:
            geometry = _links_as_capsules(chain)
            note = f"{note}; floor and obstacles are checked against straight lines between the joints"
        _add_tool(chain, geometry)
        n_robot_shapes = geometry.ngeoms
        _add_obstacles(chain, geometry, obstacles)
        return cls(chain, geometry, note, n_robot_shapes)

    @cached_property
    def _data(self) -> tuple[pin.Data, pin.GeometryData]:
        """Work data of the model and of the geometry."""
        shapes = pin.GeometryData(self.geometry)
        for pair, request in zip(self.geometry.collisionPairs, shapes.collisionRequests, strict=True):
            if max(pair.first, pair.second) >= self.n_robot_shapes:
                request.security_margin = CLEARANCE
        return self.chain.model.createData(), shapes

    def is_collision_free(self, q: Array) -> bool:
        """Return whether no two shapes collide; True if there is nothing to check."""
        return self.are_collision_free(q[None])

    def are_collision_free(self, q: Array) -> bool:
        """Return whether no two shapes collide at any of the joint positions (m, n), the first ones first."""
        if self.geometry is None:
            return True
        model, (data, shapes) = self.chain.model, self._data
        return not any(
            pin.computeCollisions(model, data, self.geometry, shapes, configuration, True)
            for configuration in self.chain.configurations(q)
        )

    def has_line_of_sight(self, q: Array, eye: Array, point: Array) -> bool:
        """Return whether robot and obstacles leave the line between two points free."""
        # The points are in the frame of the first link. The links behind the last moving joint are ignored,
        # because the measured point is on them, and so is the floor, because it may end before the
        # instrument.
        return self.shapes_on_line(q, eye, point) <= self.shapes_on_end(True)

    def shapes_on_end(self, is_tip: bool) -> frozenset[int]:
        """Return the shapes of the robot that no joint of the chain moves against its tip, or its begin."""
        if self.geometry is None:
            return frozenset()
        chain, model = self.chain, self.chain.model
        moving = {model.getJointId(name) for name in chain.moving_joints}
        link = chain.tip if is_tip else chain.root
        joint = model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint
        movers = moving & set(model.supports[joint])
        items = self.geometry.geometryObjects[: self.n_robot_shapes]
        return frozenset(
            i for i, item in enumerate(items) if moving & set(model.supports[item.parentJoint]) == movers
        )

    def shapes_on_line(self, q: Array, start: Array, end: Array) -> frozenset[int]:
        """Return the shapes on the line between two points in the frame of the first link of the chain."""
        length = float(np.linalg.norm(end - start))
        rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (end - start) / length).matrix()
        line = coal.Capsule(SIGHT_DIAMETER / 2, length)
        return self._touched(q, line, se3.transform(rotation, (start + end) / 2))

    def is_view_free(self, q: Array, eye: Array, points: Array, ignored: frozenset[int]) -> bool:
        """Return whether nothing but ignored shapes blocks the view from a point to the hull of others."""
        # The floor is ignored, because a board may lie on it.
        if self.geometry is None:
            return True
        hull = _convex_hull(np.concatenate([eye[None], points]))
        return self._touched(q, hull, np.eye(4)) <= ignored

    def _touched(self, q: Array, shape: Any, pose: Array) -> frozenset[int]:
        """Return the shapes but the floor that touch a shape at a pose (4, 4) in the first link's frame."""
        if self.geometry is None:
            return frozenset()
        data, shapes = self._data
        model = self.chain.model
        pin.updateGeometryPlacements(
            model, data, self.geometry, shapes, self.chain.configurations(q[None])[0]
        )
        frame = model.frames[model.getFrameId(self.chain.root, pin.FrameType.BODY)]
        shape_pose = (data.oMi[frame.parentJoint] * frame.placement).homogeneous @ pose
        coal_pose = coal.Transform3s(shape_pose[:3, :3], shape_pose[:3, 3])
        return frozenset(
            i
            for i, item in enumerate(self.geometry.geometryObjects)
            if item.name != FLOOR
            and coal.collide(
                shape,
                coal_pose,
                item.geometry,
                coal.Transform3s(shapes.oMg[i].rotation, shapes.oMg[i].translation),
                coal.CollisionRequest(),
                coal.CollisionResult(),
            )
        )


def _convex_hull(points: Array) -> Any:
    """Create the convex hull of points (c, 3), each as thick as a line of sight, so that it has a volume."""
    axes = SIGHT_DIAMETER / 2 * np.concatenate([np.eye(3), -np.eye(3)])
    vertices = coal.StdVec_Vec3s()
    for point in (points[:, None] + axes).reshape(-1, 3):
        vertices.append(point)
    return coal.ConvexBase.convexHull(vertices, True, "Qt")


def obstacles_from_urdf(urdf: Urdf) -> list[Obstacle]:
    """Read the collision shapes of a scene, whose root is that of the robot, at neutral joint positions."""
    model = build_model(urdf)
    geometry, problem = _load_geometry(urdf, model)
    if geometry is None:
        raise FileFormatError(f"{urdf.source}: {problem}; expected obstacles as <collision> elements")
    data, shapes = model.createData(), pin.GeometryData(geometry)
    pin.updateGeometryPlacements(model, data, geometry, shapes, pin.neutral(model))
    return [
        Obstacle(model.frames[item.parentFrame].name, item.geometry, placement.homogeneous)
        for item, placement in zip(geometry.geometryObjects, shapes.oMg, strict=True)
    ]


def _load_geometry(urdf: Urdf, model: pin.Model) -> tuple[Any, str]:
    """Load the collision shapes of a URDF; None with the reason if there are none."""
    text, folders = urdf.data.decode("utf-8-sig"), urdf.mesh_folders()
    for mesh in ElementTree.fromstring(text).iterfind("link/collision/geometry/mesh"):
        if is_mesh_too_large(name := mesh.get("filename", ""), folders):
            return None, f"the mesh {name} is larger than {MAX_MESH_BYTES >> 20} MiB"
    try:
        with warnings.catch_warnings(), discard_native_messages():
            warnings.simplefilter("ignore")
            geometry = pin.buildGeomFromUrdfString(
                model, text, pin.GeometryType.COLLISION, package_dirs=folders
            )
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        # Pinocchio names the mesh in its sentence.
        mesh = re.search(r"Mesh (.*) could not be found", reason)
        remedy = f"; {mesh_remedy(mesh[1])}" if mesh else ""
        return None, f"a mesh is missing: {reason}{remedy}"
    if not geometry.ngeoms:
        return None, "the URDF has no collision geometry"
    return geometry, ""


def _add_self_collision_pairs(chain: Chain, geometry: Any) -> None:
    """Add all pairs of shapes on links that are not neighbours, but those that overlap in the URDF."""
    joints = [item.parentJoint for item in geometry.geometryObjects]
    parents = chain.model.parents
    for second, b in enumerate(joints):
        for first, a in enumerate(joints[:second]):
            if a != b and parents[a] != b and parents[b] != a:
                geometry.addCollisionPair(pin.CollisionPair(first, second))
    for pair in _always_colliding_pairs(chain, geometry):
        geometry.removeCollisionPair(pin.CollisionPair(*pair))


def _always_colliding_pairs(chain: Chain, geometry: Any, margin: float = 0.0) -> set[tuple[int, int]]:
    """Return the pairs that collide at the neutral configuration and in the middle of the joint limits."""
    # Joints with wider or without limits count with the turn about zero, or the one nearest to it.
    low = np.maximum(chain.lower, np.minimum(-np.pi, chain.upper - 2 * np.pi))
    high = np.minimum(chain.upper, np.maximum(np.pi, chain.lower + 2 * np.pi))
    middle = chain.configurations((low + high)[None] / 2)[0]
    found = []
    for configuration in (pin.neutral(chain.model), middle):
        data = pin.GeometryData(geometry)
        for request in data.collisionRequests:
            request.security_margin = margin
        pin.computeCollisions(chain.model, chain.model.createData(), geometry, data, configuration, False)
        found.append(
            {
                (pair.first, pair.second)
                for pair, result in zip(geometry.collisionPairs, data.collisionResults, strict=True)
                if result.isCollision()
            }
        )
    return found[0] & found[1]


def _links_as_capsules(chain: Chain) -> Any:
    """Represent the links between the moving joints of a chain by capsules."""
    geometry = pin.GeometryModel()
    for name, origin in zip(chain.moving_joints, chain.origins[1:], strict=True):
        _add_capsule(geometry, chain, name, np.zeros(3), origin[:3, 3], _LINK_RADIUS)
    return geometry


def _add_tool(chain: Chain, geometry: Any) -> None:
    """Add a capsule from the tip to the tool, which no URDF contains."""
    tip = chain.origins[-1]
    _add_capsule(
        geometry, chain, chain.moving_joints[-1], tip[:3, 3], (tip @ chain.tool)[:3, 3], _TOOL_RADIUS
    )


def _add_capsule(geometry: Any, chain: Chain, joint: str, start: Array, end: Array, radius: float) -> None:
    """Add a capsule between two points (3,) in the frame of a moving joint."""
    length = float(np.linalg.norm(end - start))
    if length < _MIN_CAPSULE_LENGTH:
        return
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (end - start) / length).matrix()
    placement, index = pin.SE3(rotation, 0.5 * (start + end)), chain.model.getJointId(joint)
    name = f"capsule {geometry.ngeoms} of {joint}"
    geometry.addGeometryObject(pin.GeometryObject(name, index, 0, placement, coal.Capsule(radius, length)))


def _add_obstacles(chain: Chain, geometry: Any, obstacles: Sequence[Obstacle]) -> None:
    """Add obstacles and their pairs with all shapes that the chain moves."""
    model = chain.model
    moving = [model.getJointId(name) for name in chain.moving_joints]
    # Moving joints of the chain that move each shape.
    movers = [set(model.supports[item.parentJoint]) & set(moving) for item in geometry.geometryObjects]
    on_first_joint = pin.GeometryModel(geometry)
    for pair in list(on_first_joint.collisionPairs):
        on_first_joint.removeCollisionPair(pair)
    for number, obstacle in enumerate(obstacles):
        name = obstacle.name if obstacle.name == FLOOR else f"obstacle {number} {obstacle.name}"
        item = pin.GeometryObject(name, 0, 0, pin.SE3(obstacle.placement), obstacle.shape)
        for target in (geometry, on_first_joint):
            index = target.addGeometryObject(item)
        for shape, joints in enumerate(movers):
            if joints == {moving[0]}:
                on_first_joint.addCollisionPair(pin.CollisionPair(shape, index))
            if joints:
                geometry.addCollisionPair(pin.CollisionPair(shape, index))
    for pair in _always_colliding_pairs(chain, on_first_joint, CLEARANCE):
        geometry.removeCollisionPair(pin.CollisionPair(*pair))
