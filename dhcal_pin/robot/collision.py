"""Self-collision and line of sight, by Pinocchio and Coal.

The collision geometry of the URDF is checked pair by pair. Pairs of shapes on one link or on neighbouring
links are not checked. Pairs that collide both at the neutral configuration and in the middle of the joint
limits are not checked either: their shapes overlap in the robot description. A line of sight is a thin
capsule between instrument and tool.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from .._typing import Array
from .chain import Chain

# Diameter of a line of sight [m].
SIGHT_DIAMETER = 5e-3


@dataclass(frozen=True, eq=False)
class CollisionChecker:
    """Collision checks of a robot.

    Attributes:
        chain: Kinematic chain of the robot.
        geometry: Pinocchio's collision shapes and the pairs to check; None if the robot has no usable shapes.
        note: What is not checked and why, or an empty text.
    """

    chain: Chain
    geometry: Any
    note: str = ""

    @classmethod
    def from_chain(
        cls, chain: Chain, package_dirs: Sequence[str | os.PathLike[str]] | None = None
    ) -> CollisionChecker:
        """Load the collision geometry of a chain's URDF.

        Args:
            chain: Kinematic chain of the robot.
            package_dirs: Folders with the packages of the meshes; the folders above the URDF by default.

        Returns:
            Checker; without geometry if a mesh is missing or the URDF has no collision shapes.
        """
        if package_dirs is None:
            package_dirs = list(Path(chain.urdf.source).absolute().parents)
        text = chain.urdf.data.decode("utf-8-sig")
        folders = [os.fspath(path) for path in package_dirs]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                geometry = pin.buildGeomFromUrdfString(
                    chain.model, text, pin.GeometryType.COLLISION, package_dirs=folders
                )
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            return cls(chain, None, f"self-collision is not checked: a mesh is missing: {reason}")
        if not geometry.ngeoms:
            return cls(chain, None, "self-collision is not checked: the URDF has no collision geometry")
        joints = [item.parentJoint for item in geometry.geometryObjects]
        parents = chain.model.parents
        for second, b in enumerate(joints):
            for first, a in enumerate(joints[:second]):
                if a != b and parents[a] != b and parents[b] != a:
                    geometry.addCollisionPair(pin.CollisionPair(first, second))
        checker = cls(chain, geometry)
        low, high = (np.clip(limit, -np.pi, np.pi) for limit in (chain.lower, chain.upper))
        middle = chain.configurations((low + high)[None] / 2)[0]
        neutral = pin.neutral(chain.model)
        for pair in checker._colliding_pairs(neutral) & checker._colliding_pairs(middle):
            geometry.removeCollisionPair(pin.CollisionPair(*pair))
        return checker

    @cached_property
    def _data(self) -> tuple[pin.Data, pin.GeometryData]:
        """Work data of the model and of the geometry."""
        return self.chain.model.createData(), pin.GeometryData(self.geometry)

    def _colliding_pairs(self, configuration: Array) -> set[tuple[int, int]]:
        """Return the indices of the pairs of shapes that collide."""
        data = pin.GeometryData(self.geometry)
        model = self.chain.model
        pin.computeCollisions(model, model.createData(), self.geometry, data, configuration, False)
        return {
            (pair.first, pair.second)
            for pair, result in zip(self.geometry.collisionPairs, data.collisionResults, strict=True)
            if result.isCollision()
        }

    def is_collision_free(self, q: Array) -> bool:
        """Return whether no two shapes collide; True if the robot has no geometry.

        Args:
            q: Joint positions, shape (n,) [rad or m].

        Returns:
            Whether the configuration is free of collisions.
        """
        if self.geometry is None:
            return True
        data, shapes = self._data
        configuration = self.chain.configurations(q[None])[0]
        return not pin.computeCollisions(self.chain.model, data, self.geometry, shapes, configuration, True)

    def has_line_of_sight(self, q: Array, eye: Array, point: Array) -> bool:
        """Return whether the robot leaves the line between two points free.

        The links behind the last moving joint are ignored, because the measured point is on them.

        Args:
            q: Joint positions, shape (n,) [rad or m].
            eye: Position of the instrument in the frame of the base link, shape (3,) [m].
            point: Position of the measured point in the frame of the base link, shape (3,) [m].

        Returns:
            Whether the line is free; True if the robot has no geometry.
        """
        if self.geometry is None:
            return True
        data, shapes = self._data
        model = self.chain.model
        pin.updateGeometryPlacements(
            model, data, self.geometry, shapes, self.chain.configurations(q[None])[0]
        )
        last_joint = model.getJointId(self.chain.moving_joints[-1])
        direction = point - eye
        length = float(np.linalg.norm(direction))
        rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction / length).matrix()
        line = coal.Capsule(SIGHT_DIAMETER / 2, length)
        line_pose = coal.Transform3s(rotation, (eye + point) / 2)
        return not any(
            coal.collide(
                line,
                line_pose,
                item.geometry,
                coal.Transform3s(shapes.oMg[i].rotation, shapes.oMg[i].translation),
                coal.CollisionRequest(),
                coal.CollisionResult(),
            )
            for i, item in enumerate(self.geometry.geometryObjects)
            if item.parentJoint < last_joint
        )
