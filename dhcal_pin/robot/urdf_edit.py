"""Edits of a URDF that keep every other byte of the file.

`with_origins` rewrites the values of `xyz` and `rpy` at their byte offsets, which the parser in `urdf`
recorded. Comments, order, quotes and line ends stay. `with_turned_joints` rewrites axes and limits.
`with_world` and `with_tool_frame` append a link and a fixed joint for the measuring frame and for the
measured point.

Numbers are written with `repr`, the shortest text that reads back as the same double. A rotation has several
triples of roll, pitch and yaw; the one nearest to that of the file is written (`se3.nearest_rpy`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from xml.parsers import expat

import numpy as np

from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..se3 import nearest_rotation, nearest_rpy, to_xyz_rpy
from .formats.xml_tags import (
    Edit,
    attribute_edit,
    attribute_spans,
    attribute_text,
    edited,
    number_text,
)
from .urdf import MAX_ORIGIN, Urdf, UrdfJoint, parse_urdf, scan_tags, xml_attribute

# Maximum deviation of RᵀR from the identity, and of the last row of a pose from (0, 0, 0, 1).
_RIGIDITY_TOL = 1e-9

# Tags of a joint with limits, and the names of the lower and the upper one.
_LIMITS = (("limit", "lower", "upper"), ("safety_controller", "soft_lower_limit", "soft_upper_limit"))

# White space before the first child of a joint, from the last line end on.
_INDENT = re.compile(rb"(?:\r\n|\n|\r)[ \t]*\Z")


def changed_origins(urdf: Urdf, origins: Mapping[str, Array]) -> Iterator[tuple[UrdfJoint, Array]]:
    """List the joints whose new origins, which must be rigid, differ from those of the file."""
    for name, value in origins.items():
        joint, origin = urdf.joint(name), np.asarray(value, float)
        where = f"{urdf.source}:{joint.line}: joint {name!r}: the new origin"
        if origin.shape != (4, 4) or not np.isfinite(origin).all():
            raise InvalidArgumentError(
                f"{where} has shape {origin.shape} or a value that is not finite; expected finite (4, 4)"
            )
        rotation = origin[:3, :3]
        if (
            np.abs(origin).max() > MAX_ORIGIN
            or np.abs(origin[3] - (0, 0, 0, 1)).max() > _RIGIDITY_TOL
            or np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGIDITY_TOL
            or np.linalg.det(rotation) < 0
        ):
            raise InvalidArgumentError(
                f"{where} is not rigid; expected a rotation and a translation within {MAX_ORIGIN:g} m"
            )
        if not np.array_equal(origin, joint.origin):
            yield joint, origin


def with_origins(urdf: Urdf, origins: Mapping[str, Array]) -> bytes:
    """Return the bytes of a URDF with new joint origins; only what differs is written again."""
    changed = changed_origins(urdf, origins)
    return edited(
        urdf.data, [edit for joint, origin in changed for edit in _origin_edits(urdf, joint, origin)]
    )


def with_turned_joints(urdf: Urdf, names: Sequence[str]) -> Urdf:
    """Return a URDF in which some joints turn the other way: reversed axes, and exchanged limits."""
    tags = scan_tags(urdf.data, urdf.source)[2]
    edits: list[Edit] = []
    for name in names:
        joint = tags[name]
        axis = number_text(-urdf.joint(name).axis)
        if "axis" in joint.children:
            spans, end, quotes = attribute_spans(urdf.data, joint.children["axis"].start)
            edits.append(attribute_edit(spans, end, b"xyz", axis, quotes or b'"'))
        else:
            start = urdf.joint(name).first_child
            edits.append(Edit(start, start, b'<axis xyz="' + axis + b'"/>'))
        for child, lower, upper in _LIMITS:
            if child in joint.children:
                tag = joint.children[child]
                spans, _, _ = attribute_spans(urdf.data, tag.start)
                for key, other in ((lower, upper), (upper, lower)):
                    text = number_text([-float(tag.attributes.get(other, "0"))])
                    edits += [Edit(*spans[key.encode()].value, text)] if key.encode() in spans else []
    return replace(parse_urdf(edited(urdf.data, edits), urdf.source), package_dirs=urdf.package_dirs)


def with_world(data: bytes, base: Array) -> bytes:
    """Return the bytes of a URDF whose root is the link `world`, the measuring frame."""
    urdf = parse_urdf(data, "the calibrated URDF")
    if urdf.root == "world":
        at_root = [joint for joint in urdf.joints if joint.parent == "world"]
        return with_origins(urdf, {joint.name: base @ joint.origin for joint in at_root})
    used_names = {*urdf.links, *(joint.name for joint in urdf.joints)}
    if {"world", "world_joint"} & used_names:
        raise InvalidArgumentError(
            f"{urdf.source}: the name 'world' or 'world_joint' is already used; leave out --world-joint"
        )
    return _with_fixed_link(data, "world", "world_joint", "world", urdf.root, base)


def with_tool_frame(data: bytes, tip: str, name: str, tool: Array) -> bytes:
    """Return the bytes of a URDF with one more link at the measured point."""
    return with_fixed_frame(data, tip, name, tool, "--tool-frame")


def with_fixed_frame(data: bytes, parent: str, name: str, pose: Array, option: str) -> bytes:
    """Return the bytes of a URDF with one more link that is fixed to another one."""
    urdf = parse_urdf(data, "the calibrated URDF")
    joint = f"{name}_joint"
    if name in urdf.links or joint in {other.name for other in urdf.joints}:
        raise InvalidArgumentError(
            f"{option} {name}: the URDF already has a link {name!r} or a joint {joint!r}; choose another name"
        )
    return _with_fixed_link(data, name, joint, parent, name, pose)


def _origin_edits(urdf: Urdf, joint: UrdfJoint, origin: Array) -> list[Edit]:
    """Return the edits that give a joint a new origin, shape (4, 4)."""
    rpy, old = nearest_rpy(nearest_rotation(origin[:3, :3]), joint.rpy), joint.origin
    texts = {
        key: number_text(value)
        for key, value, is_unchanged in (
            (b"xyz", origin[:3, 3], np.array_equal(origin[:3, 3], old[:3, 3])),
            (b"rpy", rpy, np.array_equal(origin[:3, :3], old[:3, :3])),
        )
        if not (is_unchanged and joint.origin_start is not None)
    }
    joint_quote = attribute_spans(urdf.data, joint.start)[2]
    if joint.origin_start is None:
        start = joint.first_child
        attributes = b"".join(attribute_text(key, text, joint_quote) for key, text in texts.items())
        indent = _INDENT.search(urdf.data, joint.start, start)
        return [Edit(start, start, b"<origin" + attributes + b"/>" + (indent[0] if indent else b""))]
    spans, end, quote = attribute_spans(urdf.data, joint.origin_start)
    return [attribute_edit(spans, end, key, text, quote or joint_quote) for key, text in texts.items()]


def _find_end_of_robot(data: bytes) -> int:
    """Return the byte offset of the end tag of the robot."""
    parser = expat.ParserCreate("utf-8")
    ends: list[int] = []
    parser.EndElementHandler = lambda _: ends.append(parser.CurrentByteIndex)
    parser.Parse(data, True)
    return ends[-1]


def _with_fixed_link(data: bytes, link: str, joint: str, parent: str, child: str, origin: Array) -> bytes:
    """Append a link and a fixed joint between a parent and a child link."""
    numbers = to_xyz_rpy(origin)
    xyz, rpy = (" ".join(map(repr, part)) for part in (numbers[:3], numbers[3:]))
    lines = [
        f"  <link name={xml_attribute(link)}/>",
        f'  <joint name={xml_attribute(joint)} type="fixed">',
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
        f"    <parent link={xml_attribute(parent)}/>",
        f"    <child link={xml_attribute(child)}/>",
        "  </joint>",
        "",
    ]
    end = _find_end_of_robot(data)
    line_end = "\r\n" if b"\r\n" in data else "\n"
    return data[:end] + line_end.join(lines).encode() + data[end:]
