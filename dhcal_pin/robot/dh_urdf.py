"""The exact URDF of a DH table, as text that is meant to be read.

Every joint turns about (or slides along) its own z, and every ``<origin>`` is one row of the table,
so that a change of a table entry is a change of one origin and nothing else. The numbers of the
origins are written in full and read back to rounding; those of the drawing are rounded to six digits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from .dh import DHTable
from .dh_extraction import normalize_offsets
from .urdf import xml_attribute

# Okabe and Ito's palette: told apart by colour-blind eyes and on grey paper.
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


REVOLUTE_SPAN = 2 * np.pi  # rad each way, where the table names no limit


PRISMATIC_SPAN = 10.0  # m each way


MASS, INERTIA = 1e-3, 1e-6  # kg, kg m²: simulators refuse massless links; these bend nothing


@dataclass(frozen=True)
class _Path:
    """A link's skeleton in its own frame: points (k, 3) in metres and the material of each segment."""

    points: list[Array]
    materials: list[str]


def dh_to_urdf(table: DHTable, name: str) -> str:
    """URDF text of a DH table: links base_link, link_1 … link_n and tool0, in metres and radians.

    Joint i is ``table.names[i-1]``, with parent link_{i-1}, child link_i, axis z and the origin
    ``table.origins()[i-1]``; a fixed joint, ``tool`` or the next free name, carries the last origin.
    A table whose offsets only cancel each other is settled first (`extraction.settled`).
    Revolute joints without limits get ±2π, prismatic ones ±10 m. The drawing uses primitives only.

    Args:
        table: the arm.
        name: the robot's name.

    Returns:
        The whole file, which Pinocchio, MuJoCo and other readers load as it is.
    """
    table = normalize_offsets(table)
    origins = table.origins()
    paths = _paths(table)
    tool_joint = next(t for t in _tool_names() if t not in table.names)
    links = ["base_link", *(f"link_{i + 1}" for i in range(table.n_joints)), "tool0"]
    lines = ['<?xml version="1.0"?>', *_preamble(table), f"<robot name={xml_attribute(name)}>", ""]
    for i, joint in enumerate(table.names):
        lines += _joint(
            joint, "prismatic" if table.prismatic[i] else "revolute", origins[i], links[i : i + 2]
        )
        lines += ['    <axis xyz="0 0 1"/>', f"    {_limit(table, i)}", "  </joint>", ""]
    lines += [*_joint(tool_joint, "fixed", origins[-1], links[-2:]), "  </joint>", ""]
    lines += ["  <!-- From here on: what the arm looks like, and token masses. -->", ""]
    for material, rgba in MATERIALS.items():
        lines.append(f'  <material name="{material}"><color rgba="{_short(rgba)}"/></material>')
    for i, link in enumerate(links):
        lines += ["", f'  <link name="{link}">']
        lines += [f"    {visual}" for visual in _visuals(table, origins, paths, i)]
        lines += _inertial() if 0 < i <= table.n_joints else []
        lines.append("  </link>")
    return "\n".join([*lines, "</robot>", ""])


def _tool_names() -> Iterator[str]:
    yield "tool"
    number = 2
    while True:
        yield f"tool_{number}"
        number += 1


def _preamble(table: DHTable) -> list[str]:
    """The comment on top: what the numbers are, and the table in the units people think in."""
    if table.convention == "standard":
        row = "Rz(theta+q) Tz(d) Tx(a) Rx(alpha)"
        where = "Joint 1 stands at the base; the origin of joint i+1 is row i; the tool carries the last row."
    else:
        row = "Tx(a) Rx(alpha) Tz(d) Rz(theta+q)"
        where = "The origin of joint i is row i; the first one stands on the base; the tool follows the last."
    hayati = bool(np.any(table.beta))
    row = row.replace("Rx(alpha)", "Rx(alpha) Ry(beta)") if hayati else row
    heads = ["theta", "d", "a", "alpha"] + ["beta"] * hayati
    units = ["deg", "mm", "mm", "deg"] + ["deg"] * hayati
    lines = [
        "<!--",
        f"  Written from this {table.convention} Denavit-Hartenberg table, row = {row}.",
        f"  {where}",
        "  A sliding joint adds q to d instead of theta. Below: metres, radians, and z as every axis.",
        "",
        "  row  " + "".join(f"{f'{h} [{u}]':>14}" for h, u in zip(heads, units, strict=True)),
    ]
    for i in range(table.n_joints):
        values = [
            getattr(table, h)[i] * (1e3 if u == "mm" else 180 / np.pi)
            for h, u in zip(heads, units, strict=True)
        ]
        kind = "  slides" if table.prismatic[i] else ""
        lines.append(f"  {i + 1:3d}  " + "".join(f"{_short([v]):>14}" for v in values) + kind)
    return [*lines, "-->"]


def _joint(name: str, kind: str, origin: Array, links: list[str]) -> list[str]:
    xyz = " ".join(_exact(v) for v in origin[:3, 3])
    rpy = " ".join(_exact(v) for v in _rpy(origin[:3, :3]))
    return [
        f'  <joint name={xml_attribute(name)} type="{kind}">',
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
        f'    <parent link="{links[0]}"/>',
        f'    <child link="{links[1]}"/>',
    ]


def _rpy(rotation: Array) -> Array:
    """Roll, pitch, yaw (3,) in radians of a rotation (3, 3); quarter turns within rounding made exact."""
    (xx, _, _), (yx, _, _), (zx, zy, zz) = rotation + 0.0
    roll = np.arctan2(zy, zz)
    # Yaw is what remains after roll, so the pair stays exact near ±90° of pitch, where each alone is not.
    remaining = rotation @ np.array([0.0, np.cos(roll), -np.sin(roll)])
    rpy = np.array([roll, np.arctan2(-zx, np.hypot(xx, yx)), np.arctan2(-remaining[0], remaining[1])])
    quarters = np.round(rpy / (np.pi / 2)) * (np.pi / 2)
    return np.where(np.abs(rpy - quarters) < 1e-15, quarters, rpy)


def _limit(table: DHTable, i: int) -> str:
    """Limits of joint i; a missing side is put one span beyond the other side or zero."""
    lower, upper = float(table.lower[i]), float(table.upper[i])
    span = PRISMATIC_SPAN if table.prismatic[i] else REVOLUTE_SPAN
    low = lower if np.isfinite(lower) else min(upper, 0.0) - span
    high = upper if np.isfinite(upper) else max(lower, 0.0) + span
    return f'<limit lower="{_exact(low)}" upper="{_exact(high)}" effort="100.0" velocity="3.0"/>'


def _inertial() -> list[str]:
    return [
        "    <inertial>",
        f'      <mass value="{MASS}"/>',
        f'      <inertia ixx="{INERTIA}" ixy="0" ixz="0" iyy="{INERTIA}" iyz="0" izz="{INERTIA}"/>',
        "    </inertial>",
    ]


def _paths(table: DHTable) -> list[_Path]:
    """Skeletons of base_link, link_1 … link_n: the way from each frame to the next along d and a.

    Standard: link i carries row i, d then a. Modified: link i-1 carries row i, a then d.
    """
    row = table.rows(np.zeros((1, table.n_joints)))[0]
    start, zero = table.base[:3, 3], np.zeros(3)
    paths = []
    if table.convention == "standard":
        paths.append(_Path([zero, start], ["corner"]))
        for i in range(table.n_joints):
            paths.append(_Path([zero, np.array([0, 0, table.d[i]]), row[i, :3, 3]], ["along_d", "along_a"]))
        end = (row[-1] @ table.tool)[:3, 3]
    else:
        for i in range(table.n_joints):
            frame = table.base if i == 0 else np.eye(4)
            corner = frame @ [table.a[i], 0, 0, 1]
            points = [frame[:3, 3], corner[:3], (frame @ row[i])[:3, 3]]
            paths.append(_Path(points, ["along_a", "along_d"]))
        paths[0] = _Path([zero, *paths[0].points], ["corner", *paths[0].materials])
        paths.append(_Path([zero], []))
        end = table.tool[:3, 3]
    paths[-1] = _Path([*paths[-1].points, end], [*paths[-1].materials, "corner"])
    return paths


def _scale(table: DHTable, paths: Iterable[_Path]) -> float:
    """Total length of the arm in metres, which all thicknesses are fractions of."""
    lengths = sum(float(np.linalg.norm(np.diff(path.points, axis=0), axis=1).sum()) for path in paths)
    strokes = np.where(table.prismatic, np.abs([table.lower, table.upper]), 0.0)
    return lengths + float(strokes[np.isfinite(strokes)].sum()) or 1.0


def _visuals(table: DHTable, origins: Array, paths: list[_Path], link: int) -> Iterator[str]:
    """The drawing of one link, an element a line."""
    scale = _scale(table, paths)
    r = 0.02 * scale
    if link > table.n_joints:
        yield from _triad(6.0 * r, 0.4 * r)
        return
    if link == 0:
        yield _rod(np.array([0, 0, -0.6 * r]), np.zeros(3), 4.0 * r, "corner")
    elif table.prismatic[link - 1]:
        # The moving rod reaches back to the sleeve at every value of the joint.
        reach = np.clip([table.lower[link - 1], table.upper[link - 1]], -0.5 * scale, 0.5 * scale)
        back, front = -max(reach[1], 0.0), max(-reach[0], 0.0)
        if front > back:
            yield _rod(np.array([0, 0, back]), np.array([0, 0, front]), 0.6 * r, "along_d")
    else:
        half = np.array([0, 0, 1.7 * r])
        yield _rod(-half, half, 1.6 * r, "revolute")
        yield _rod(-1.1 * half, 1.1 * half, 0.9 * r, "corner")
    path = paths[link]
    for a, b, material in zip(path.points[:-1], path.points[1:], path.materials, strict=True):
        if np.linalg.norm(b - a) > 1e-6 * scale:
            yield _rod(a, b, r, material)
            yield _visual(b, np.zeros(3), f'<sphere radius="{_short([1.15 * r])}"/>', "corner")
    if link < table.n_joints and table.prismatic[link]:
        # The sleeve stays with the link before the joint.
        box = f'<box size="{_short([3 * r, 3 * r, 5 * r])}"/>'
        yield _visual(origins[link, :3, 3], _rpy(origins[link, :3, :3]), box, "prismatic")


def _triad(length: float, radius: float) -> Iterator[str]:
    for axis, material in enumerate(("x_axis", "y_axis", "z_axis")):
        yield _rod(np.zeros(3), length * np.eye(3)[axis], radius, material)


def _rod(start: Array, end: Array, radius: float, material: str) -> str:
    """A cylinder between two points (3,)."""
    x, y, z = end - start
    length = float(np.linalg.norm(end - start))
    rpy = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
    shape = f'<cylinder radius="{_short([radius])}" length="{_short([length])}"/>'
    return _visual((start + end) / 2, rpy, shape, material)


def _visual(xyz: Array, rpy: Array, shape: str, material: str) -> str:
    origin = f'<origin xyz="{_short(xyz)}" rpy="{_short(rpy)}"/>'
    return f'<visual>{origin}<geometry>{shape}</geometry><material name="{material}"/></visual>'


def _exact(value: float) -> str:
    """The shortest text that reads back as the same double; no negative zero."""
    return repr(float(value) + 0.0)


def _short(values: Iterable[float]) -> str:
    return " ".join(f"{float(v) + 0.0:.6g}" for v in values)
