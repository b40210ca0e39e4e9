"""Joint origins of a URDF rewritten in place: every other byte of the file stays as it is."""

from __future__ import annotations

import re
from collections.abc import Mapping
from xml.parsers import expat

import numpy as np
import pinocchio as pin

from .._typing import Array
from ..exceptions import DhcalError
from ..se3 import to_xyz_rpy
from .urdf import MAX_ORIGIN, Urdf, UrdfJoint, parse_urdf, xml_attribute

_RIGID = 1e-9  # how far from orthonormal a rotation may be before it is no rotation


_ELEMENT = re.compile(rb"<[^ \t\r\n/>]+")


_ATTRIBUTE = re.compile(rb"""[ \t\r\n]+([^ \t\r\n=/>]+)[ \t\r\n]*=[ \t\r\n]*("[^"]*"|'[^']*')""")


_INDENT = re.compile(rb"(?:\r\n|\n|\r)[ \t]*\Z")


def _attributes(data: bytes, start: int) -> tuple[dict[bytes, tuple[int, int]], int, bytes]:
    """Of the tag at `start`: each value's span between its quotes, where the last ends, a quote.

    The tag is known to be well-formed; expat gives its offset, but values only after normalising them.
    """
    element = _ELEMENT.match(data, start)
    assert element is not None, "expat found a tag here"
    spans, end, quote = {}, element.end(), b""
    while found := _ATTRIBUTE.match(data, end):
        spans[found[1]] = found.start(2) + 1, found.end(2) - 1
        end, quote = found.end(), found[2][:1]
    return spans, end, quote


def _edits(urdf: Urdf, joint: UrdfJoint, origin: Array) -> list[tuple[int, int, bytes]]:
    """The (start, end, new bytes) that give a joint a new origin (4, 4)."""
    u, _, vt = np.linalg.svd(origin[:3, :3])
    rpy, old = pin.rpy.matrixToRpy(u @ vt), joint.origin
    texts = {
        key: " ".join(repr(float(x) + 0.0) for x in value).encode()  # + 0.0 turns -0.0 into 0.0
        for key, value, same in (
            (b"xyz", origin[:3, 3], np.array_equal(origin[:3, 3], old[:3, 3])),
            (b"rpy", rpy, np.array_equal(origin[:3, :3], old[:3, :3])),
        )
        if not (same and joint.origin_start is not None)
    }
    joint_quote = _attributes(urdf.data, joint.start)[2]
    if joint.origin_start is None:
        at, quote = joint.first_child, joint_quote
        inner = b"".join(b" " + key + b"=" + quote + text + quote for key, text in texts.items())
        indent = _INDENT.search(urdf.data, joint.start, at)
        return [(at, at, b"<origin" + inner + b"/>" + (indent[0] if indent else b""))]
    spans, end, quote = _attributes(urdf.data, joint.origin_start)
    quote = quote or joint_quote
    return [
        (*spans[key], text) if key in spans else (end, end, b" " + key + b"=" + quote + text + quote)
        for key, text in texts.items()
    ]


def with_origins(urdf: Urdf, origins: Mapping[str, Array]) -> bytes:
    """The URDF's bytes with new joint origins; every other byte stays as it is.

    Args:
        urdf: the file to start from.
        origins: by joint name the (4, 4) pose of the joint frame in its parent link, metres. Its
            position and rotation are each rewritten only if they differ from the file's.

    Raises:
        DhcalError: an unknown joint, or an origin that is no finite rigid motion.
    """
    edits: list[tuple[int, int, bytes]] = []
    for name, value in origins.items():
        joint, origin = urdf.joint(name), np.asarray(value, float)
        where = f"{urdf.source}:{joint.line}: joint {name!r}: its new origin"
        if origin.shape != (4, 4) or not np.isfinite(origin).all():
            raise DhcalError(f"{where} must be a (4, 4) matrix of finite numbers")
        rotation = origin[:3, :3]
        if (
            np.abs(origin).max() > MAX_ORIGIN
            or np.abs(origin[3] - (0, 0, 0, 1)).max() > _RIGID
            or np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGID
            or np.linalg.det(rotation) < 0
        ):
            raise DhcalError(f"{where} must be a rotation and a translation within {MAX_ORIGIN:g} m")
        if not np.array_equal(origin, joint.origin):
            edits += _edits(urdf, joint, origin)
    out, done = [], 0
    # Stable: two attributes inserted at the same place keep their order.
    for start, end, text in sorted(edits, key=lambda edit: edit[0]):
        out += [urdf.data[done:start], text]
        done = end
    return b"".join([*out, urdf.data[done:]])


def _end_of_robot(data: bytes) -> int:
    """Where the robot's end tag starts."""
    parser = expat.ParserCreate("utf-8")
    ends: list[int] = []
    parser.EndElementHandler = lambda _: ends.append(parser.CurrentByteIndex)
    parser.Parse(data, True)
    return ends[-1]


def _appended(data: bytes, link: str, joint: str, parent: str, child: str, origin: Array) -> bytes:
    """The URDF with one more link and the fixed joint that holds it."""
    xyz, rpy = (" ".join(map(repr, part)) for part in (to_xyz_rpy(origin)[:3], to_xyz_rpy(origin)[3:]))
    lines = [
        f"  <link name={xml_attribute(link)}/>",
        f'  <joint name={xml_attribute(joint)} type="fixed">',
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
        f"    <parent link={xml_attribute(parent)}/>",
        f"    <child link={xml_attribute(child)}/>",
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
