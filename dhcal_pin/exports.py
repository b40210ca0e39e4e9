"""A calibrated robot with the instrument's frames in its URDF, and as a plain table of origins."""

from __future__ import annotations

from xml.parsers import expat

from .chain import Chain
from .errors import DhcalError
from .robot_files import joint_origins
from .se3 import Array
from .ur_kinematics import ORIGIN_KEYS, six_numbers
from .urdf import parse_urdf
from .urdf_origins import with_origins
from .urdf_tags import quoted


def _end_of_robot(data: bytes) -> int:
    """Where the robot's end tag starts."""
    parser = expat.ParserCreate("utf-8")
    ends: list[int] = []
    parser.EndElementHandler = lambda _: ends.append(parser.CurrentByteIndex)
    parser.Parse(data, True)
    return ends[-1]


def _appended(data: bytes, link: str, joint: str, parent: str, child: str, origin: Array) -> bytes:
    """The URDF with one more link and the fixed joint that holds it."""
    xyz, rpy = (" ".join(map(repr, part)) for part in (six_numbers(origin)[:3], six_numbers(origin)[3:]))
    lines = [
        f"  <link name={quoted(link)}/>",
        f'  <joint name={quoted(joint)} type="fixed">',
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
        f"    <parent link={quoted(parent)}/>",
        f"    <child link={quoted(child)}/>",
        "  </joint>",
        "",
    ]
    end = _end_of_robot(data)
    mark = "\r\n" if b"\r\n" in data else "\n"
    return data[:end] + mark.join(lines).encode() + data[end:]


def with_world(data: bytes, base: Array) -> bytes:
    """A URDF whose root is `world`, the measuring frame, with the robot's base link at base (4, 4).

    A root that is called `world` already keeps its name and its fixed joint takes up the base.

    Raises:
        DhcalError: `world` is taken by something else.
    """
    urdf = parse_urdf(data, "the calibrated URDF")
    if urdf.root == "world":
        first = [joint for joint in urdf.joints if joint.parent == "world"]
        return with_origins(urdf, {joint.name: base @ joint.origin for joint in first})
    taken = {*urdf.links, *(joint.name for joint in urdf.joints)}
    if {"world", "world_joint"} & taken:
        raise DhcalError(f"{urdf.source}: 'world' or 'world_joint' is taken; leave out --world-joint")
    return _appended(data, "world", "world_joint", "world", urdf.root, base)


def with_tool_frame(data: bytes, tip: str, name: str, tool: Array) -> bytes:
    """A URDF with a link `name` fixed to the link `tip` at tool (4, 4), the measured point.

    Raises:
        DhcalError: the name is taken.
    """
    urdf = parse_urdf(data, "the calibrated URDF")
    joint = f"{name}_joint"
    if name in urdf.links or joint in {j.name for j in urdf.joints}:
        raise DhcalError(f"--tool-frame {name}: the URDF has a link {name!r} or a joint {joint!r} already")
    return _appended(data, name, joint, tip, name, tool)


def origins_text(chain: Chain) -> str:
    """CSV of every joint's own origin on the path, for people who keep their robot in xacro; m and rad."""
    moved, _ = joint_origins(chain)
    lines = ["joint," + ",".join(f"{k}[{'m' if k in 'xyz' else 'rad'}]" for k in ORIGIN_KEYS)]
    for joint in chain.urdf.path(chain.tip):
        lines.append(",".join([joint.name, *map(repr, six_numbers(moved.get(joint.name, joint.origin)))]))
    return "\n".join(lines) + "\n"
