"""Conversion of a DH table to an exact URDF with a drawing of the arm.

Every joint moves about or along its own z axis, and every ``<origin>`` is one row of the table, so that a
change of one table entry changes exactly one origin. The numbers of the origins are written with all digits;
those of the drawing are rounded to six digits. A comment at the top of the file contains the table.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from .._frozen import frozen
from .._typing import Array
from .dh import DHTable
from .dh_extraction import normalize_offsets
from .urdf import xml_attribute

# Colours of Okabe and Ito, which are distinguishable with colour blindness and in greyscale.
MATERIALS = {
    "along_d": (0.00, 0.45, 0.70, 1.0),
    "along_a": (0.90, 0.62, 0.00, 1.0),
    "revolute": (0.23, 0.25, 0.28, 1.0),
    "prismatic": (0.80, 0.47, 0.65, 1.0),
    "corner": (0.86, 0.87, 0.88, 1.0),
    "x_axis": (0.84, 0.37, 0.00, 1.0),
    "y_axis": (0.00, 0.62, 0.45, 1.0),
    "z_axis": (0.34, 0.71, 0.91, 1.0),
}

# Distance of the limits that are written for joints without limits [rad and m].
REVOLUTE_SPAN = 2 * np.pi
PRISMATIC_SPAN = 10.0

# Mass [kg] and moments of inertia [kg m²] of every link. Simulators refuse massless links.
MASS, INERTIA = 1e-3, 1e-6


@frozen
class _Skeleton:
    """Line segments of a link in its own frame."""

    points: list[Array]  # Points, each of shape (3,) [m]
    materials: list[str]  # Material of each segment


def dh_to_urdf(table: DHTable, name: str) -> str:
    """Write a DH table as URDF text.

    The links are base_link, link_1 … link_n and tool0. Joint i is ``table.names[i-1]``, with parent
    link_{i-1}, child link_i, axis z and the origin ``table.origins()[i-1]``. A fixed joint `tool` (or tool_2,
    tool_3, … if the name is used) contains the last origin. Large offsets that only cancel each other are
    removed first. Continuous joints have no limits; other joints without limits get ±2π or, if prismatic,
    ±10 m. The drawing uses primitive shapes only.

    Args:
        table: DH table.
        name: Name of the robot.

    Returns:
        Text of the file.
    """
    table = normalize_offsets(table)
    origins = table.origins()
    skeletons = _skeletons(table)
    tool_joint = next(t for t in _tool_names() if t not in table.names)
    links = ["base_link", *(f"link_{i + 1}" for i in range(table.n_joints)), "tool0"]
    lines = ['<?xml version="1.0"?>', *_preamble(table), f"<robot name={xml_attribute(name)}>", ""]
    for i, joint in enumerate(table.names):
        lines += _joint(joint, table.joint_types[i], origins[i], links[i : i + 2])
        lines += ['    <axis xyz="0 0 1"/>', f"    {_limit(table, i)}", "  </joint>", ""]
    lines += [*_joint(tool_joint, "fixed", origins[-1], links[-2:]), "  </joint>", ""]
    lines += ["  <!-- From here on: what the arm looks like, and token masses. -->", ""]
    for material, rgba in MATERIALS.items():
        lines.append(f'  <material name="{material}"><color rgba="{_short(rgba)}"/></material>')
    for i, link in enumerate(links):
        lines += ["", f'  <link name="{link}">']
        lines += [f"    {visual}" for visual in _visuals(table, origins, skeletons, i)]
        lines += _inertial() if 0 < i <= table.n_joints else []
        lines.append("  </link>")
    return "\n".join([*lines, "</robot>", ""])


def _tool_names() -> Iterator[str]:
    """Generate names for the fixed joint of the tool."""
    yield "tool"
    number = 2
    while True:
        yield f"tool_{number}"
        number += 1


def _preamble(table: DHTable) -> list[str]:
    """Write the comment at the top of the file: the table in degrees and millimetres."""
    if table.convention == "standard":
        row = "Rz(theta+q) Tz(d) Tx(a) Rx(alpha)"
        origin_note = (
            "Joint 1 stands at the base; the origin of joint i+1 is row i; the tool carries the last row."
        )
    else:
        row = "Tx(a) Rx(alpha) Tz(d) Rz(theta+q)"
        origin_note = (
            "The origin of joint i is row i; the first one stands on the base; the tool follows the last."
        )
    hayati = bool(np.any(table.beta))
    row = row.replace("Rx(alpha)", "Rx(alpha) Ry(beta)") if hayati else row
    columns = ["theta", "d", "a", "alpha"] + ["beta"] * hayati
    units = ["deg", "mm", "mm", "deg"] + ["deg"] * hayati
    lines = [
        "<!--",
        f"  Written from this {table.convention} Denavit-Hartenberg table, row = {row}.",
        f"  {origin_note}",
        "  A sliding joint adds q to d instead of theta. Below: metres, radians, and z as every axis.",
        "",
        "  row  " + "".join(f"{f'{h} [{u}]':>14}" for h, u in zip(columns, units, strict=True)),
    ]
    for i in range(table.n_joints):
        values = [
            getattr(table, h)[i] * (1e3 if u == "mm" else 180 / np.pi)
            for h, u in zip(columns, units, strict=True)
        ]
        note = "  slides" if table.prismatic[i] else ""
        lines.append(f"  {i + 1:3d}  " + "".join(f"{_short([v]):>14}" for v in values) + note)
    return [*lines, "-->"]


def _joint(name: str, joint_type: str, origin: Array, links: list[str]) -> list[str]:
    """Write the beginning of a joint between a parent and a child link."""
    xyz = " ".join(_exact(v) for v in origin[:3, 3])
    rpy = " ".join(_exact(v) for v in _rpy(origin[:3, :3]))
    return [
        f'  <joint name={xml_attribute(name)} type="{joint_type}">',
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
        f'    <parent link="{links[0]}"/>',
        f'    <child link="{links[1]}"/>',
    ]


def _rpy(rotation: Array) -> Array:
    """Compute roll, pitch and yaw, shape (3,) [rad], with exact quarter turns."""
    (xx, _, _), (yx, _, _), (zx, zy, zz) = rotation + 0.0
    roll = np.arctan2(zy, zz)
    # Yaw is computed after removing roll. Near ±90° of pitch only their combination is well determined.
    remaining = rotation @ np.array([0.0, np.cos(roll), -np.sin(roll)])
    rpy = np.array([roll, np.arctan2(-zx, np.hypot(xx, yx)), np.arctan2(-remaining[0], remaining[1])])
    quarters = np.round(rpy / (np.pi / 2)) * (np.pi / 2)
    return np.where(np.abs(rpy - quarters) < 1e-15, quarters, rpy)


def _limit(table: DHTable, i: int) -> str:
    """Write the limits of joint i; a missing limit is one span beyond the other limit or zero."""
    if table.continuous[i]:
        return '<limit effort="100.0" velocity="3.0"/>'
    lower, upper = float(table.lower[i]), float(table.upper[i])
    span = PRISMATIC_SPAN if table.prismatic[i] else REVOLUTE_SPAN
    low = lower if np.isfinite(lower) else min(upper, 0.0) - span
    high = upper if np.isfinite(upper) else max(lower, 0.0) + span
    return f'<limit lower="{_exact(low)}" upper="{_exact(high)}" effort="100.0" velocity="3.0"/>'


def _inertial() -> list[str]:
    """Write the mass and inertia of a link."""
    return [
        "    <inertial>",
        f'      <mass value="{MASS}"/>',
        f'      <inertia ixx="{INERTIA}" ixy="0" ixz="0" iyy="{INERTIA}" iyz="0" izz="{INERTIA}"/>',
        "    </inertial>",
    ]


def _skeletons(table: DHTable) -> list[_Skeleton]:
    """Compute line segments that lead from frame to frame along d and a."""
    # In the standard convention, row i belongs to link i, d before a. In the modified convention, row i
    # belongs to link i-1, a before d.
    row = table.rows(np.zeros((1, table.n_joints)))[0]
    start, zero = table.base[:3, 3], np.zeros(3)
    skeletons = []
    if table.convention == "standard":
        skeletons.append(_Skeleton([zero, start], ["corner"]))
        for i in range(table.n_joints):
            skeletons.append(
                _Skeleton([zero, np.array([0, 0, table.d[i]]), row[i, :3, 3]], ["along_d", "along_a"])
            )
        end = (row[-1] @ table.tool)[:3, 3]
    else:
        for i in range(table.n_joints):
            frame = table.base if i == 0 else np.eye(4)
            corner = frame @ [table.a[i], 0, 0, 1]
            points = [frame[:3, 3], corner[:3], (frame @ row[i])[:3, 3]]
            skeletons.append(_Skeleton(points, ["along_a", "along_d"]))
        skeletons[0] = _Skeleton([zero, *skeletons[0].points], ["corner", *skeletons[0].materials])
        skeletons.append(_Skeleton([zero], []))
        end = table.tool[:3, 3]
    skeletons[-1] = _Skeleton([*skeletons[-1].points, end], [*skeletons[-1].materials, "corner"])
    return skeletons


def _scale(table: DHTable, skeletons: Iterable[_Skeleton]) -> float:
    """Return the total length of the arm [m], which determines all thicknesses."""
    lengths = sum(
        float(np.linalg.norm(np.diff(skeleton.points, axis=0), axis=1).sum()) for skeleton in skeletons
    )
    strokes = np.where(table.prismatic, np.abs([table.lower, table.upper]), 0.0)
    return lengths + float(strokes[np.isfinite(strokes)].sum()) or 1.0


def _visuals(table: DHTable, origins: Array, skeletons: list[_Skeleton], link: int) -> Iterator[str]:
    """Write the drawing of one link, one element per line."""
    scale = _scale(table, skeletons)
    r = 0.02 * scale
    if link > table.n_joints:
        yield from _triad(6.0 * r, 0.4 * r)
        return
    if link == 0:
        yield _cylinder(np.array([0, 0, -0.6 * r]), np.zeros(3), 4.0 * r, "corner")
    elif table.prismatic[link - 1]:
        # The rod reaches back to the sleeve at every joint position.
        reach = np.clip([table.lower[link - 1], table.upper[link - 1]], -0.5 * scale, 0.5 * scale)
        back, front = -max(reach[1], 0.0), max(-reach[0], 0.0)
        if front > back:
            yield _cylinder(np.array([0, 0, back]), np.array([0, 0, front]), 0.6 * r, "along_d")
    else:
        half = np.array([0, 0, 1.7 * r])
        yield _cylinder(-half, half, 1.6 * r, "revolute")
        yield _cylinder(-1.1 * half, 1.1 * half, 0.9 * r, "corner")
    skeleton = skeletons[link]
    for a, b, material in zip(skeleton.points[:-1], skeleton.points[1:], skeleton.materials, strict=True):
        if np.linalg.norm(b - a) > 1e-6 * scale:
            yield _cylinder(a, b, r, material)
            yield _visual(b, np.zeros(3), f'<sphere radius="{_short([1.15 * r])}"/>', "corner")
    if link < table.n_joints and table.prismatic[link]:
        # The sleeve belongs to the link before the joint.
        box = f'<box size="{_short([3 * r, 3 * r, 5 * r])}"/>'
        yield _visual(origins[link, :3, 3], _rpy(origins[link, :3, :3]), box, "prismatic")


def _triad(length: float, radius: float) -> Iterator[str]:
    """Write the three axes of a frame."""
    for axis, material in enumerate(("x_axis", "y_axis", "z_axis")):
        yield _cylinder(np.zeros(3), length * np.eye(3)[axis], radius, material)


def _cylinder(start: Array, end: Array, radius: float, material: str) -> str:
    """Write a cylinder between two points, shape (3,)."""
    x, y, z = end - start
    length = float(np.linalg.norm(end - start))
    rpy = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
    shape = f'<cylinder radius="{_short([radius])}" length="{_short([length])}"/>'
    return _visual((start + end) / 2, rpy, shape, material)


def _visual(xyz: Array, rpy: Array, shape: str, material: str) -> str:
    """Write a shape at a pose."""
    origin = f'<origin xyz="{_short(xyz)}" rpy="{_short(rpy)}"/>'
    return f'<visual>{origin}<geometry>{shape}</geometry><material name="{material}"/></visual>'


def _exact(value: float) -> str:
    """Write the shortest text that reads back as the same double, without negative zero."""
    return repr(float(value) + 0.0)


def _short(values: Iterable[float]) -> str:
    """Write numbers with six digits, without negative zero."""
    return " ".join(f"{float(v) + 0.0:.6g}" for v in values)
