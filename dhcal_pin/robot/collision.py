"""Whether a robot meets itself, or stands in the way of an instrument: Coal, through Pinocchio."""

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

# A line of sight is as thick as a pencil.
SIGHT_DIAMETER = 5e-3


@dataclass(frozen=True, eq=False)
class CollisionChecker:
    """A robot's collision geometry.

    Attributes:
        chain: the robot.
        geometry: its collision shapes and the pairs that are looked at; None without shapes.
        note: what is not looked at and why, or nothing.
    """

    chain: Chain
    geometry: Any
    note: str = ""

    @classmethod
    def from_chain(
        cls, chain: Chain, package_dirs: Sequence[str | os.PathLike[str]] | None = None
    ) -> CollisionChecker:
        """The collision geometry of a chain's URDF.

        Pairs on one link or on neighbours are left out, and those that meet both at neutral and in the middle
        of the joints' limits: their shapes overlap.

        Args:
            chain: the robot.
            package_dirs: where to look for meshes; the folders above the URDF without it.
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
        out = cls(chain, geometry)
        low, high = (np.clip(limit, -np.pi, np.pi) for limit in (chain.lower, chain.upper))
        middle = chain.configurations((low + high)[None] / 2)[0]
        neutral = pin.neutral(chain.model)
        for pair in out._colliding_pairs(neutral) & out._colliding_pairs(middle):
            geometry.removeCollisionPair(pin.CollisionPair(*pair))
        return out

    @cached_property
    def _data(self) -> tuple[pin.Data, pin.GeometryData]:
        return self.chain.model.createData(), pin.GeometryData(self.geometry)

    def _colliding_pairs(self, configuration: Array) -> set[tuple[int, int]]:
        """Pairs of shapes that meet."""
        data = pin.GeometryData(self.geometry)
        model = self.chain.model
        pin.computeCollisions(model, model.createData(), self.geometry, data, configuration, False)
        return {
            (pair.first, pair.second)
            for pair, result in zip(self.geometry.collisionPairs, data.collisionResults, strict=True)
            if result.isCollision()
        }

    def is_collision_free(self, q: Array) -> bool:
        """Whether no two shapes meet at joint values q (n,); True where there are no shapes."""
        if self.geometry is None:
            return True
        data, shapes = self._data
        configuration = self.chain.configurations(q[None])[0]
        return not pin.computeCollisions(self.chain.model, data, self.geometry, shapes, configuration, True)

    def has_line_of_sight(self, q: Array, eye: Array, point: Array) -> bool:
        """Whether nothing of the robot but its last link stands between two points at joint values q (n,).

        Args:
            q: (n,) rad or m.
            eye: (3,) the instrument, m, in the frame of the base link.
            point: (3,) what it looks at.
        """
        if self.geometry is None:
            return True
        data, shapes = self._data
        model = self.chain.model
        pin.updateGeometryPlacements(
            model, data, self.geometry, shapes, self.chain.configurations(q[None])[0]
        )
        last = model.getJointId(self.chain.moving_joints[-1])
        away = point - eye
        length = float(np.linalg.norm(away))
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), away / length).matrix()
        line = coal.Capsule(SIGHT_DIAMETER / 2, length)
        place = coal.Transform3s(turn, (eye + point) / 2)
        return not any(
            coal.collide(
                line,
                place,
                item.geometry,
                coal.Transform3s(shapes.oMg[i].rotation, shapes.oMg[i].translation),
                coal.CollisionRequest(),
                coal.CollisionResult(),
            )
            for i, item in enumerate(self.geometry.geometryObjects)
            if item.parentJoint < last
        )
