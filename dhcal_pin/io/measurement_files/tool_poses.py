"""Poses of the tip in place of joint values, for images of a robot of which only the flange pose is known.

The poses are turned into joint positions of the robot that reach them. For cameras and boards it does not
matter which of several solutions is found, as only the pose counts. Equal poses get equal joint positions, so
that their corners belong to one image.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ... import se3
from ..._typing import Array
from ...exceptions import FileFormatError
from ...robot.chain import Chain
from ...robot.inverse_kinematics import MAX_POSE_DIFFERENCE, reach_poses
from ..tables import DataTable
from .columns import QUATERNION, TOOL_POSE, joint_column_names


def solve_tool_poses(table: DataTable, chain: Chain, values: Mapping[str, Array]) -> Array:
    """Find joint positions that reach the poses in the rows of a table."""
    _require_no_joints(table, chain)
    arm = chain.with_base_and_tool(np.eye(4), np.eye(4))
    columns = np.stack([values[name] for name in TOOL_POSE], -1)
    _, first, number = np.unique(columns, axis=0, return_index=True, return_inverse=True)
    poses = se3.transform(se3.exp3(columns[first, 3:]), columns[first, :3])
    q, differences = reach_poses(arm, poses)
    missed = np.flatnonzero(differences > MAX_POSE_DIFFERENCE)
    if missed.size:
        worst = missed[np.argmin(first[missed])]
        nearest = arm.poses(q[worst][None])[0]
        are_inverse = bool(np.all(reach_poses(arm, se3.inverse(poses))[1] <= MAX_POSE_DIFFERENCE))
        raise FileFormatError(_missed_text(table, arm, int(first[worst]), poses[worst], nearest, are_inverse))
    return q[number.reshape(-1)]


def _require_no_joints(table: DataTable, chain: Chain) -> None:
    """Raise an error if a table with poses has the column of a joint."""
    present = [name for name in joint_column_names(chain.joint_names) if name in table.columns]
    if present:
        pose = [name for name in (*TOOL_POSE, *QUATERNION) if name in table.columns]
        raise FileFormatError(
            f"{table.header_location}: column {present[0]!r} does not go with {', '.join(pose)}; a file of "
            "kind camera has the values of all joints or the pose of the tip, not both"
        )


def _missed_text(
    table: DataTable, arm: Chain, row: int, pose: Array, nearest: Array, are_inverse: bool
) -> str:
    """Say that the robot does not reach the pose of a row, and how far the nearest one is."""
    distance = 1e3 * np.linalg.norm(nearest[:3, 3] - pose[:3, 3])
    angle = np.degrees(np.linalg.norm(se3.log3(nearest[:3, :3] @ pose[:3, :3].T)))
    inverse = "it reaches the inverse of all poses: invert them; " if are_inverse else ""
    return (
        f"{table.source}:{table.lines[row]}: this robot does not reach the pose, the nearest one is "
        f"{distance:.3g} mm and {angle:.3g} deg away; expected the pose of link {arm.tip} in the frame of "
        f"link {arm.root}; {inverse}the robot file flange.urdf reaches every pose"
    )
