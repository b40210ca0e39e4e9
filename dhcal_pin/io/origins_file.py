"""Joint origins: pose of each joint in its parent link, and their CSV file.

A chain keeps one origin for each moving joint: the product of the origins of all fixed joints before it and
of its own. A URDF has an origin for each joint. `joint_origins` distributes the changes of a chain over the
joints of its URDF; `origins_text` writes all of them as a table, for robots that are maintained as xacro.
"""

from __future__ import annotations

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..robot.chain import Chain
from .robot_format import ConvertedRobot, RobotSource

# Components of an origin, in the order of `se3.to_xyz_rpy`: metres, then radians.
ORIGIN_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def joint_origins(chain: Chain) -> tuple[dict[str, Array], Array]:
    """Compute the changed origin of each joint of the URDF, and the remaining tool pose.

    The origins of fixed joints before a moving joint stay; the origin of the moving joint takes up the whole
    change. A change of the tip goes to the last fixed joint after the last moving joint. Without such a joint
    it goes to the tool.

    Args:
        chain: Chain whose origins may differ from those of its URDF.

    Returns:
        Origin in the parent link by joint name, shape (4, 4) each [m], for changed joints only; and the tool
        pose in the tip frame, shape (4, 4) [m].
    """
    nominal = Chain.from_urdf(chain.urdf, chain.tip)
    changed: dict[str, Array] = {}
    # Pose of the joint's parent link in the link of the previous moving joint.
    parent, moving_index, last_fixed = np.eye(4), 0, None
    for joint in chain.urdf.path(chain.tip):
        if joint.type != "fixed":
            if not np.array_equal(chain.origins[moving_index], nominal.origins[moving_index]):
                changed[joint.name] = se3.inverse(parent) @ chain.origins[moving_index]
            parent, moving_index, last_fixed = np.eye(4), moving_index + 1, None
        else:
            last_fixed = joint.name, parent
            parent = parent @ joint.origin
    if np.array_equal(chain.origins[-1], nominal.origins[-1]):
        return changed, chain.tool
    if last_fixed is None:
        return changed, se3.inverse(nominal.origins[-1]) @ chain.origins[-1] @ chain.tool
    name, parent = last_fixed
    changed[name] = se3.inverse(parent) @ chain.origins[-1]
    return changed, chain.tool


def origins_text(chain: Chain) -> str:
    """Return the CSV text of the origins of all joints on the path to the tip.

    Args:
        chain: Chain whose origins are written.

    Returns:
        One row per joint: its name, then x, y, z [m] and roll, pitch, yaw [rad] in its parent link.
    """
    changed, _ = joint_origins(chain)
    lines = ["joint," + ",".join(f"{key}[{'m' if key in 'xyz' else 'rad'}]" for key in ORIGIN_KEYS)]
    for joint in chain.urdf.path(chain.tip):
        origin = changed.get(joint.name, joint.origin)
        lines.append(",".join([joint.name, *map(repr, se3.to_xyz_rpy(origin))]))
    return "\n".join(lines) + "\n"


def convert_to_origins(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a robot to a table of joint origins.

    Args:
        robot: Robot to convert.
        path: Path of the file.

    Returns:
        Text of the file.
    """
    return ConvertedRobot(origins_text(robot.chain))
