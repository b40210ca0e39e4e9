"""Poses of the tip in place of joint values, for images of a robot of which only the flange pose is known.

The poses are turned into joint positions of the robot that reach them. For cameras and boards it does not
matter which of several solutions is found, as only the pose counts. Equal poses get equal joint positions, so
that their corners belong to one image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ... import se3
from ..._typing import Array
from ...exceptions import FileFormatError
from ...robot.chain import Chain
from ...robot.inverse_kinematics import (
    characteristic_length,
    pose_task,
    reach_within_limits,
    solve_ik,
    without_rotary_limits,
    wrap_into_limits,
)
from ...robot.sampling import joint_range
from ..tables import DataTable
from .columns import QUATERNION, TOOL_POSE, joint_column_names

# Largest difference of the solution from a pose [m]; rotations by the characteristic length of the robot.
_MAX_DIFFERENCE = 5e-7
# Damping of the last steps [m²]; smaller values make the system singular in double precision.
_MIN_DAMPING = 1e-14
# Largest distance of the first start from the middle of the joint limits [rad and m].
_MAX_START = 0.5


def solve_tool_poses(table: DataTable, chain: Chain, values: Mapping[str, Array]) -> Array:
    """Find joint positions that reach the poses in the rows of a table."""
    _require_no_joints(table, chain)
    arm = replace(chain, base=np.eye(4), tool=np.eye(4))
    columns = np.stack([values[name] for name in TOOL_POSE], -1)
    _, first, number = np.unique(columns, axis=0, return_index=True, return_inverse=True)
    poses = se3.transform(se3.exp3(columns[first, 3:]), columns[first, :3])
    rng = np.random.default_rng(0)
    # In the middle of the limits many arms are singular.
    start = np.mean(joint_range(arm), 0) + rng.uniform(-_MAX_START, _MAX_START, arm.n_joints)
    task = pose_task(poses, characteristic_length(arm))
    q, differences = reach_within_limits(arm, task, np.tile(start, (len(first), 1)), rng)
    # Near a singularity, stronger damping leaves a small error.
    q, differences = solve_ik(without_rotary_limits(arm), task, q, min_damping=_MIN_DAMPING)
    q = wrap_into_limits(arm, q)[0]
    missed = np.flatnonzero(differences > _MAX_DIFFERENCE)
    if missed.size:
        worst = missed[np.argmin(first[missed])]
        nearest = arm.poses(q[worst][None])[0]
        raise FileFormatError(_missed_text(table, arm, int(first[worst]), poses[worst], nearest))
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


def _missed_text(table: DataTable, arm: Chain, row: int, pose: Array, nearest: Array) -> str:
    """Say that the robot does not reach the pose of a row, and how far the nearest one is."""
    distance = 1e3 * np.linalg.norm(nearest[:3, 3] - pose[:3, 3])
    angle = np.degrees(np.linalg.norm(se3.log3(nearest[:3, :3] @ pose[:3, :3].T)))
    return (
        f"{table.source}:{table.lines[row]}: this robot does not reach the pose, the nearest one is "
        f"{distance:.3g} mm and {angle:.3g} deg away; expected the pose of link {arm.tip} in the frame of "
        f"link {arm.root}; the robot file flange.urdf reaches every pose"
    )
