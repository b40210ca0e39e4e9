"""Joint origins: pose of each joint in its parent link, and their CSV file.

A chain keeps one origin for each moving joint: the product of the origins of all fixed joints before it and
of its own. A URDF has an origin for each joint. `joint_origins` distributes the changes of a chain over the
joints of its URDF; `origins_text` writes all of them as a table, for robots that are maintained as xacro.
`origin_table` shows what a calibration changed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..formatting import Table
from ..robot.chain import Chain
from ..robot.urdf import UrdfJoint
from ..robot.urdf_path import path_between
from .robot_format import ConvertedRobot, RobotSource

# Components of an origin, in the order of `se3.to_xyz_rpy`: metres, then radians.
ORIGIN_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")

# Largest distance [m] and angle [rad] by which an origin may move and still count as unmoved, far below what
# any instrument measures. Where base and first joint are redundant, the ratio of their prior variances,
# (1 mm)² to (10 m)², leaves 1e-8 of the correction of the base to the joint.
MIN_MOVE = 1e-8


def without_negligible_moves(chain: Chain, min_move: float = MIN_MOVE) -> Chain:
    """Return a chain with exactly nominal translations and rotations of origins that hardly moved."""
    nominal = chain.nominal().origins
    origins = chain.origins.copy()
    change = se3.inverse(nominal) @ origins
    same_position = np.linalg.norm(change[:, :3, 3], axis=1) <= min_move
    same_rotation = np.linalg.norm(se3.log3(change[:, :3, :3]), axis=1) <= min_move
    origins[same_position, :3, 3] = nominal[same_position, :3, 3]
    origins[same_rotation, :3, :3] = nominal[same_rotation, :3, :3]
    return replace(chain, origins=origins)


def joint_origins(chain: Chain) -> tuple[dict[str, Array], Array]:
    """Compute the changed origin of each joint of the URDF, and the remaining tool pose."""
    nominal = chain.nominal()
    changed: dict[str, Array] = {}
    # The origins of fixed joints before a moving joint stay; that of the moving joint takes up the change.
    pairs = zip(chain.moving_joints, chain.joint_placements, nominal.joint_placements, strict=True)
    for name, new, old in pairs:
        if not np.array_equal(new, old):
            parent, _ = _fixed_part(chain, chain.urdf.joint(name).parent)
            changed[name] = _changed_origin(chain.urdf.joint(name), parent, new, old)
    new, old = chain.origins[-1], nominal.origins[-1]
    if np.array_equal(new, old) or chain.n_reversed == len(chain.moving_joints):
        return changed, chain.tool
    # A change of the tip goes to the last fixed joint after the last moving joint whose origin the file can
    # hold. Without such a joint, it goes to the tool.
    _, last_fixed = _fixed_part(chain, chain.tip)
    if last_fixed is None:
        return changed, se3.inverse(old) @ new @ chain.tool
    parent, _ = _fixed_part(chain, last_fixed.parent)
    changed[last_fixed.name] = _changed_origin(last_fixed, parent, new, old)
    return changed, chain.tool


def _fixed_part(chain: Chain, link: str) -> tuple[Array, UrdfJoint | None]:
    """Return the pose of a link in the moving joint before it, and the last fixed joint between them."""
    pose, last = np.eye(4), None
    for joint in chain.urdf.path(link):
        if joint.type == "fixed":
            pose = pose @ joint.origin
            last = last if joint.name in chain.urdf.fixed_origins else joint
        else:
            pose, last = np.eye(4), None
    return pose, last


def _changed_origin(joint: UrdfJoint, parent: Array, new: Array, old: Array) -> Array:
    """Compute the origin that gives a joint the pose `new` (4, 4) [m]; an unchanged part stays exactly."""
    origin = se3.inverse(parent) @ new
    if np.array_equal(new[:3, 3], old[:3, 3]):
        origin[:3, 3] = joint.origin[:3, 3]
    if np.array_equal(new[:3, :3], old[:3, :3]):
        origin[:3, :3] = joint.origin[:3, :3]
    return origin


def origin_table(chain: Chain) -> Table:
    """Make a table of the origins of all joints that moved, before and after, as the URDF has them."""
    changed, _ = joint_origins(without_negligible_moves(chain.urdf_alone))
    rows = []
    for joint, _ in path_between(chain.urdf, chain.root, chain.tip):
        if joint.name not in changed:
            continue
        old, new = joint.origin, changed[joint.name]
        distance = float(np.linalg.norm(new[:3, 3] - old[:3, 3]))
        angle = float(np.linalg.norm(se3.log3(old[:3, :3].T @ new[:3, :3])))
        rows += [
            [joint.name, "xyz", _numbers(old[:3, 3]), _numbers(new[:3, 3]), f"{1e3 * distance:.3f} mm"],
            [joint.name, "rpy", _numbers(joint.rpy), _numbers(_rpy(joint, new)), f"{np.degrees(angle):.4f}°"],
        ]
    return Table(["joint", "origin", "before", "after", "moved"], rows, n_text_columns=4)


def _rpy(joint: UrdfJoint, origin: Array) -> Array:
    """Return the angles of a new origin of a joint that are nearest to those of the file, shape (3,)."""
    return se3.nearest_rpy(origin[:3, :3], joint.rpy)


def _numbers(values: Array) -> str:
    """Format numbers with six decimals (1 µm, 1 µrad) at most."""
    return " ".join(f"{round(value, 6) + 0.0:.6f}".rstrip("0").rstrip(".") for value in values.tolist())


def origins_text(chain: Chain) -> str:
    """Return the CSV text of the origins of all joints on the path to the tip."""
    changed, _ = joint_origins(without_negligible_moves(chain.urdf_alone))
    lines = ["joint," + ",".join(f"{key}[{'m' if key in 'xyz' else 'rad'}]" for key in ORIGIN_KEYS)]
    for joint, _ in path_between(chain.urdf, chain.root, chain.tip):
        origin = changed.get(joint.name, joint.origin)
        numbers = (*origin[:3, 3], *_rpy(joint, origin))
        lines.append(",".join([joint.name, *(repr(float(value) + 0.0) for value in numbers)]))
    return "\n".join(lines) + "\n"


def convert_to_origins(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a robot to a table of joint origins."""
    return ConvertedRobot(origins_text(robot.chain))
