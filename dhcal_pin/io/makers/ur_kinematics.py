"""Kinematics files of Universal Robots: the YAML file that the ROS description of a UR arm loads.

The file `default_kinematics.yaml` holds one origin per joint, from the base link to the flange. It is
equivalent to a modified DH table: each origin is the transform from one joint axis to the next, with the
joint axis along z. The tip must therefore lie on the axis of the last joint, which only a rotation about and
a shift along that axis can reach.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from typing import Any

import numpy as np
import pinocchio as pin

from ... import se3
from ..._typing import Array, PathLike
from ...exceptions import FileFormatError, InvalidArgumentError
from ...messages import quote
from ...robot.chain import Chain, extract_dh_table
from ...robot.dh import DHTable
from ...robot.urdf import MAX_ORIGIN
from ..origins_file import ORIGIN_KEYS
from ..robot_format import ConvertedRobot, RobotSource
from ..tabular import parse_number, read_text, yaml_number

# Joints of a UR arm, and the names of their origins in the file.
UR_JOINTS = {
    "shoulder_pan_joint": "shoulder",
    "shoulder_lift_joint": "upper_arm",
    "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1",
    "wrist_2_joint": "wrist_2",
    "wrist_3_joint": "wrist_3",
}
# Largest offset of the tip from the axis of the last joint that is left out, and the largest one that is a
# rounding error [m or rad, entries of a pose].
_MAX_TIP_OFFSET, _MAX_TIP_ERROR = 2e-4, 1e-9
# Largest size of a file [byte]; PyYAML reads about 100 kB per second.
_MAX_BYTES = 1 << 17
# Number of hexadecimal digits of the hash.
_HASH_DIGITS = 15


def ur_kinematics(chain: Chain) -> dict[str, dict[str, float]]:
    """Compute the origins of a UR arm's joints, each with its joint axis along z."""
    names = [
        name[len(name) - len(ur_name) :] for name, ur_name in zip(chain.joint_names, UR_JOINTS, strict=False)
    ]
    if len(chain.joint_names) != len(UR_JOINTS) or names != list(UR_JOINTS):
        raise InvalidArgumentError(
            f"UR's kinematics need the joints {', '.join(UR_JOINTS)}; "
            f"this path has {', '.join(chain.joint_names)}"
        )
    table = extract_dh_table(chain, "modified").table
    origins = table.origins()
    along_axis, offset = _split_tip(table)
    tip_error = np.abs(offset - np.eye(4)).max()
    if tip_error > _MAX_TIP_OFFSET:
        raise InvalidArgumentError(
            f"UR's kinematics end on the axis of wrist_3, and the tip {chain.tip!r} is {tip_error:.2g} off; "
            "choose --tip tool0 or flange, and calibrate with tool rather than with the last row"
        )
    # The last origin takes up the motion along the last axis.
    origins[-2] = origins[-2] @ along_axis
    return {
        name: dict(zip(ORIGIN_KEYS, se3.to_xyz_rpy(origin), strict=True))
        for name, origin in zip(UR_JOINTS.values(), origins[:-1], strict=True)
    }


def _split_tip(table: DHTable) -> tuple[Array, Array]:
    """Split the pose of the tip into a motion along and about the last axis, and the offset from that."""
    angle = np.arctan2(table.tool[1, 0], table.tool[0, 0])
    along_axis = se3.transform(se3.exp3([0.0, 0.0, angle]), [0.0, 0.0, table.tool[2, 3]])
    return along_axis, se3.inverse(along_axis) @ table.tool


def ur_kinematics_text(chain: Chain) -> str:
    """Return the text of a UR kinematics file."""
    lines = ["kinematics:"]
    for name, origin in ur_kinematics(chain).items():
        lines += [f"  {name}:", *(f"    {key}: {yaml_number(value)}" for key, value in origin.items())]
    digest = int(hashlib.sha256("\n".join(lines).encode()).hexdigest()[:_HASH_DIGITS], 16)
    return "\n".join([*lines, f"  hash: calib_{digest}", ""])


def read_ur_kinematics(path: PathLike) -> DHTable:
    """Read a UR kinematics file."""
    import yaml  # lazy import: slow to import, and few commands read YAML

    source = os.fspath(path)
    try:
        # The base loader returns scalars as texts. Other loaders convert 1:30 to 90, and leave 1e-5 a text.
        document = yaml.load(read_text(path, max_bytes=_MAX_BYTES), yaml.BaseLoader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise FileFormatError(f"{source}: not YAML: {line}{error.problem}; correct that line") from None
    except yaml.YAMLError as error:
        reason = " ".join(str(error).splitlines()[:1])
        raise FileFormatError(f"{source}: not YAML: {reason}; remove it") from None
    except RecursionError:
        raise FileFormatError(f"{source}: not YAML: nested too deeply; correct the file") from None
    content = document.get("kinematics") if isinstance(document, dict) else None
    origins = []
    for name in UR_JOINTS.values():
        entry = content.get(name) if isinstance(content, dict) else None
        if not isinstance(entry, dict) or not set(ORIGIN_KEYS) <= set(entry):
            raise FileFormatError(
                f"{source}: kinematics: {name} needs the numbers {', '.join(ORIGIN_KEYS)} in m and rad"
            )
        numbers = [_origin_number(entry[key], f"{source}: kinematics: {name}: {key}") for key in ORIGIN_KEYS]
        origins.append(se3.transform(pin.rpy.rpyToMatrix(*numbers[3:]), numbers[:3]))
    origins.append(np.eye(4))
    n_joints = len(UR_JOINTS)
    no_limit = np.full(n_joints, np.inf)
    from ...robot.dh_extraction import extract_dh  # lazy import: only for DH tables

    return extract_dh(origins, list(UR_JOINTS), np.zeros(n_joints), -no_limit, no_limit, "modified").table


def _origin_number(value: Any, where: str) -> float:
    """Parse a number of an origin."""
    with suppress(ValueError):
        if isinstance(value, str) and abs(number := parse_number(value)) <= MAX_ORIGIN:
            return number
    raise FileFormatError(f"{where}: {quote(value)}; expected a number in m or rad up to ±{MAX_ORIGIN:g}")


def convert_to_ur_kinematics(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a robot to a UR kinematics file."""
    text = ur_kinematics_text(robot.chain)
    offset = se3.log6(_split_tip(extract_dh_table(robot.chain, "modified").table)[1])
    if np.abs(offset).max() <= _MAX_TIP_ERROR:
        return ConvertedRobot(text)
    length, angle = (1e3 * float(np.linalg.norm(part)) for part in np.split(offset, 2))
    note = (
        f"the offset of the tip from the axis of wrist_3, {length:.2g} mm and {angle:.2g} mrad, is left out"
    )
    return ConvertedRobot(text, [note])
