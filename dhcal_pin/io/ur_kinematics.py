"""UR's own kinematics YAML, which its ROS description loads: written from a chain, and read back."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from .. import se3
from .._typing import PathLike
from ..exceptions import DhcalError
from ..robot.chain import Chain, extract_dh_table
from ..robot.dh import DHTable
from ..robot.dh_extraction import extract_dh
from ..se3 import to_xyz_rpy
from .joint_origins import ORIGIN_KEYS
from .robot_format import ConvertedRobot, RobotSource
from .tabular import read_text

# UR's joints and what its description calls their origins.
UR_JOINTS = {
    "shoulder_pan_joint": "shoulder",
    "shoulder_lift_joint": "upper_arm",
    "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1",
    "wrist_2_joint": "wrist_2",
    "wrist_3_joint": "wrist_3",
}


def _ur_names(chain: Chain) -> Mapping[str, str]:
    names = [name[len(name) - len(own) :] for name, own in zip(chain.joint_names, UR_JOINTS, strict=False)]
    if len(chain.joint_names) != 6 or names != list(UR_JOINTS):
        raise DhcalError(
            f"UR's kinematics need the joints {', '.join(UR_JOINTS)}; "
            f"this path has {', '.join(chain.joint_names)}"
        )
    return UR_JOINTS


def ur_kinematics(chain: Chain) -> dict[str, Any]:
    """The `kinematics` mapping of UR's robot description: each joint's origin with its axis along z.

    It holds the path from the base link to the flange. What the last axis' turn and slide cannot take
    up of the tip has no place there.

    Raises:
        DhcalError: the joints are not UR's, or the tip is not on the last axis.
    """
    names = _ur_names(chain)
    table = extract_dh_table(chain, "modified").table
    origins = table.origins()
    turn = np.arctan2(table.tool[1, 0], table.tool[0, 0])
    slide = se3.transform(se3.exp3([0.0, 0.0, turn]), [0.0, 0.0, table.tool[2, 3]])
    rest = np.abs(se3.inverse(slide) @ table.tool - np.eye(4)).max()
    if rest > 1e-9:
        raise DhcalError(
            f"UR's kinematics end on the axis of wrist_3, and the tip {chain.tip!r} is {rest:.2g} off it; "
            "choose --tip tool0 or flange, and calibrate with tool rather than with the last row"
        )
    origins[-2] = origins[-2] @ slide
    return {
        key: dict(zip(ORIGIN_KEYS, to_xyz_rpy(origin), strict=True))
        for key, origin in zip(names.values(), origins[:-1], strict=True)
    }


def ur_kinematics_text(chain: Chain) -> str:
    """UR's kinematics YAML, every digit; its hash is of the numbers, not the controller's own."""
    content = ur_kinematics(chain)
    lines = ["kinematics:"]
    for name, values in content.items():
        lines += [f"  {name}:", *(f"    {key}: {value!r}" for key, value in values.items())]
    digest = int(hashlib.sha256("\n".join(lines).encode()).hexdigest()[:15], 16)
    return "\n".join([*lines, f"  hash: calib_{digest}", ""])


def read_ur_kinematics(path: PathLike) -> DHTable:
    """A modified DH table from UR's kinematics YAML, base and tool being identities or fixed frames.

    Raises:
        DhcalError: it is not such a file.
    """
    import yaml  # a good part of the start-up, and few commands read it

    source = os.fspath(path)
    try:
        raw = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise DhcalError(f"{source}: not YAML: {' '.join(str(error).split())}") from None
    content = raw.get("kinematics") if isinstance(raw, dict) else None
    origins = []
    for name in UR_JOINTS.values():
        entry = content.get(name) if isinstance(content, dict) else None
        values = [entry.get(key) for key in ORIGIN_KEYS] if isinstance(entry, dict) else []
        numbers = [float(value) for value in values if isinstance(value, int | float)]
        if len(numbers) != len(ORIGIN_KEYS) or not np.isfinite(numbers).all():
            raise DhcalError(
                f"{source}: kinematics: {name} needs the numbers {', '.join(ORIGIN_KEYS)} in m and rad"
            )
        origins.append(se3.transform(pin.rpy.rpyToMatrix(*numbers[3:]), numbers[:3]))
    origins.append(np.eye(4))
    six = np.zeros(6)
    return extract_dh(origins, list(UR_JOINTS), six, six - np.inf, six + np.inf, "modified").table


def convert_to_ur_kinematics(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a robot to UR's kinematics YAML."""
    return ConvertedRobot(ur_kinematics_text(robot.chain))
