"""Kinematics of one robot file in another one: a template whose joint origins take up those of a robot.

Both files describe one robot with the same names of joints, but their joint frames may differ, as those of
a URDF and an MJCF often do. The forward kinematics of a chain follow from the poses of its joint axes and of
its tip at zero joint positions. A joint frame of the template therefore becomes

- that of the robot, if both are nearly equal: then all links have the same poses in both files,
- otherwise the frame of the template after the smallest motion that puts its axis onto that of the robot:
  shapes stay where they are in the template, up to this motion.

The tip becomes that of the robot. Where the template cannot move its tip in the last link, as without a fixed
joint or a site, the frame of the last joint follows from it.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import InvalidArgumentError
from ..messages import quote
from ..robot.chain import Chain
from .origins_file import joint_origins, without_negligible_moves


class _Size(NamedTuple):
    """Size of a motion."""

    distance: float  # [m]
    angle: float  # [rad]

    def exceeds(self, limit: _Size) -> bool:
        """Return whether the distance or the angle is larger than a limit."""
        return self.distance > limit.distance or self.angle > limit.angle

    def __str__(self) -> str:
        return f"{1e3 * self.distance:.3g} mm and {math.degrees(self.angle):.3g}°"


# Largest motion of a frame that counts as the same frame before and after a calibration.
SAME_FRAME = _Size(0.01, 0.05)
# Largest motion of an axis or a tip; beyond it the files describe different robots. A calibration of a
# low-cost arm turns axes by up to 8 degrees.
SAME_ROBOT = _Size(0.05, 0.2)
# Largest difference of axes in the same frame.
_AXIS_TOL = 1e-9
# Motions that are rounding errors [m or rad].
_ROUNDING = 1e-14


def with_kinematics(template: Chain, robot: Chain, path: PathLike) -> Chain:
    """Return a template with joint origins that give its tip the poses of the tip of a robot."""
    source = os.fspath(path)
    if template.moving_joints != robot.moving_joints or not np.array_equal(
        template.prismatic, robot.prismatic
    ):
        raise InvalidArgumentError(
            f"{source}: the joints up to {quote(template.tip)} are {', '.join(template.moving_joints)}; "
            f"expected those of {robot.urdf.source}: {', '.join(robot.moving_joints)}"
        )
    old, given = np.array(_frames(template)), np.array(_frames(robot))
    _require_same_place(template, robot, old, given, source)
    new = [
        _joint_frame(source, name, old[j], template.axes[j], given[j], robot.axes[j], template.prismatic[j])
        for j, name in enumerate(template.moving_joints)
    ]
    motion = _size(se3.inverse(given[-1]) @ old[-1])
    if motion.exceeds(SAME_ROBOT):
        raise InvalidArgumentError(
            f"{source}: {quote(template.tip)} is {motion} from {quote(robot.tip)} of {robot.urdf.source}; "
            "name the same frame with --tip and --template-tip"
        )
    filled = _with_frames(template, [*new, given[-1]])
    if np.array_equal(joint_origins(filled)[1], np.eye(4)):
        return filled
    return _with_frames(template, [*new[:-1], given[-1] @ se3.inverse(template.origins[-1]), given[-1]])


def _require_same_place(template: Chain, robot: Chain, old: Array, given: Array, source: str) -> None:
    """Require that a robot is not that of the template at another place in its first link."""
    moved = given[-1] @ se3.inverse(old[-1])
    if _has_axes(template, old, robot, given) or not _has_axes(template, moved @ old, robot, given):
        return
    raise InvalidArgumentError(
        f"{source}: the whole robot of {robot.urdf.source} is moved by {_size(moved)} in {robot.root}, as "
        "by `dhcal calibrate --world-joint`, which writes the pose of the base into the URDF; calibrate "
        "without it, so that the pose is in the sidecar only"
    )


def _has_axes(template: Chain, old: Array, robot: Chain, given: Array) -> bool:
    """Return whether a template with these joint frames has the axes of a robot, but for a calibration."""
    axes = [
        _axis_motion(old[j], template.axes[j], given[j], robot.axes[j], template.prismatic[j])[0]
        for j in range(len(template.moving_joints))
    ]
    return not any(each.exceeds(SAME_ROBOT) for each in axes)


def _frames(chain: Chain) -> list[Array]:
    """Return the poses of the joints and of the tip at zero joint positions, in the first link."""
    poses = [np.eye(4)]
    for origin in chain.origins:
        poses.append(poses[-1] @ origin)
    return poses[1:]


def _with_frames(template: Chain, frames: list[Array]) -> Chain:
    """Return a chain with other poses of the joints and of the tip at zero joint positions."""
    before = [np.eye(4), *frames[:-1]]
    origins = [se3.inverse(a) @ b for a, b in zip(before, frames, strict=True)]
    return without_negligible_moves(replace(template, origins=np.array(origins)), _ROUNDING)


def _joint_frame(
    source: str, name: str, old: Array, axis: Array, given: Array, given_axis: Array, is_prismatic: bool
) -> Array:
    """Compute the frame of a joint of the template from that of the robot, shape (4, 4)."""
    has_same_axis = np.abs(axis - given_axis).max() <= _AXIS_TOL
    if has_same_axis and not _size(se3.inverse(given) @ old).exceeds(SAME_FRAME):
        return given
    motion, shift, normal = _axis_motion(old, axis, given, given_axis, is_prismatic)
    if motion.exceeds(SAME_ROBOT):
        raise InvalidArgumentError(
            f"{source}: the axis of joint {quote(name)} is {motion} from that of the robot; expected the "
            "same robot with the same root, zero position and directions of its joints"
        )
    sine = float(np.linalg.norm(normal))
    turn = se3.exp3(normal * (motion.angle / sine)) if sine else np.eye(3)
    return se3.transform(turn @ old[:3, :3], old[:3, 3] + shift)


def _axis_motion(
    old: Array, axis: Array, given: Array, given_axis: Array, is_prismatic: bool
) -> tuple[_Size, Array, Array]:
    """Return the smallest motion that puts an axis onto another one: size, shift, and normal of the turn."""
    a, b = old[:3, :3] @ axis, given[:3, :3] @ given_axis
    normal, shift = np.cross(a, b), np.zeros(3)
    if not is_prismatic:
        shift = given[:3, 3] - old[:3, 3]
        shift -= (shift @ b) * b
    angle = math.atan2(float(np.linalg.norm(normal)), a @ b)
    return _Size(float(np.linalg.norm(shift)), angle), shift, normal


def _size(motion: Array) -> _Size:
    """Return the size of a motion, shape (4, 4)."""
    return _Size(float(np.linalg.norm(motion[:3, 3])), float(np.linalg.norm(se3.log3(motion[:3, :3]))))
