"""DH files: Denavit-Hartenberg tables in TOML and CSV.

A TOML file has `convention`, `[units]`, one `[[joint]]` table per joint, and optionally the poses `[base]`
and `[tool]`; a CSV file has one row per joint, units in the header, and convention and poses in comments:

    # convention: standard
    # base: 0 0 0 0 0 0
    joint,type,theta[deg],d[mm],a[mm],alpha[deg],lower[deg|mm],upper[deg|mm]
    joint_1,revolute,0,433,0,90,-160,160

Both can have `beta`, Hayati's angle. A limit has the unit of the joint: an angle, or a length if it is
prismatic. The type `continuous` is a revolute joint that turns without end and has no limits. Files are
written in metres and radians with all digits and read back bit-identical.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import tomli_w

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import DhcalError, FileFormatError, UnknownNameError
from ..robot.chain import extract_dh_table
from ..robot.dh import CONVENTIONS, Convention, DHTable
from ..units import ANGLES, LENGTHS
from . import toml_table as toml
from .robot_format import ConvertedRobot, RobotSource
from .tables import Column, DataTable, TextLayout, read_table
from .tabular import csv_text, parse_number, require_usable_names
from .toml_table import Key, TomlTable

# Columns of numbers with their units, those among them that are required, and the limits with their defaults.
_UNITS = {"theta": ANGLES, "d": LENGTHS, "a": LENGTHS, "alpha": ANGLES, "beta": ANGLES}
_REQUIRED = ("theta", "d", "a", "alpha")
_LIMITS = {"lower": -math.inf, "upper": math.inf}
_JOINT_TYPES = ("revolute", "prismatic", "continuous")
# Header of a CSV file, as an example in messages.
_CSV_HEADER = "joint,type,theta[deg],d[mm],a[mm],alpha[deg]"
# Largest entry of a table [m or rad]; a larger one has the wrong unit.
_MAX_ENTRY = 1e4
# Largest angle of a link [rad]; degrees that were read as radians are larger.
_MAX_ANGLE = 4 * math.pi
# Largest number of joints.
_MAX_JOINTS = 250

# Keys of the file before its joints.
HEAD_KEYS = {
    "convention": toml.choice(CONVENTIONS),
    "units": toml.table_of({"length": toml.choice(LENGTHS), "angle": toml.choice(ANGLES)}, is_optional=False),
}
POSE_TABLES = {"base": toml.table_of(toml.POSE_KEYS), "tool": toml.table_of(toml.POSE_KEYS)}


def _limit_key(no_limit: float) -> Key:
    """Declare a limit, which may be infinite."""
    return Key(
        "a finite number",
        {"type": "number"},
        lambda value: toml.is_number(value) or value in (-math.inf, math.inf),
        lambda value: float(value) if toml.is_number(value) else no_limit,
        default=no_limit,
    )


# Keys of a joint; an absent name is made from its number.
JOINT_KEYS = {
    "type": toml.choice(_JOINT_TYPES, default="revolute"),
    "name": toml.text(is_optional=True),
    **{
        key: toml.number(
            description=f"a finite number such as {key} = 0.0", default=None if key in _REQUIRED else 0.0
        )
        for key in _UNITS
    },
    **{key: _limit_key(no_limit) for key, no_limit in _LIMITS.items()},
}

# Name, type and numbers of a joint.
_Row = tuple[str, str, dict[str, float]]


def _is_csv(path: PathLike) -> bool:
    return os.fspath(path).lower().endswith(".csv")


# --- reading ---------------------------------------------------------------------------------------


def read_dh(path: PathLike) -> DHTable:
    """Read a DH table.

    Args:
        path: CSV file if its name ends with `.csv`, otherwise a TOML file.

    Returns:
        The table. Errors in the content are `FileFormatError`, unknown units and columns `UnknownNameError`.
    """
    return _read_dh_csv(path) if _is_csv(path) else _read_dh_toml(path)


def _read_dh_toml(path: PathLike) -> DHTable:
    document = TomlTable.read(path)
    head = document.some_values(HEAD_KEYS)
    lengths, angles = LENGTHS[head["units"]["length"]], ANGLES[head["units"]["angle"]]
    joints = document.tables("joint", expected="one per joint, with theta, d, a and alpha")
    poses = {key: toml.pose_of(values) for key, values in document.values(POSE_TABLES).items() if values}
    columns: dict[str, list[Any]] = {key: [] for key in ("name", "type", *_UNITS, *_LIMITS)}
    for count, joint in enumerate(joints, 1):
        name = joint.get("name", f"joint_{count}")
        joint.name = f"joint {name!r}"
        values = joint.values(JOINT_KEYS) | {"name": name}
        of_limits = lengths if values["type"] == "prismatic" else angles
        divisors = {key: lengths if known is LENGTHS else angles for key, known in _UNITS.items()}
        divisors |= dict.fromkeys(_LIMITS, of_limits)
        for key, column in columns.items():
            column.append(values[key] / divisors[key] if key in divisors else values[key])
    return _build_table(document.path, head["convention"], columns, poses)


def _read_dh_csv(path: PathLike) -> DHTable:
    table = read_table(path, TextLayout(header_example=_CSV_HEADER))
    table.require_good_rows()
    if not table.columns.keys() & {"joint", *_REQUIRED}:
        raise FileFormatError(
            f"{table.source}: expected a DH table with the header {_CSV_HEADER}; the file of the robot comes "
            "first, then measurements"
        )
    notes = _notes(table)
    written = notes.get("convention")
    convention = str(written).lower()
    if convention not in CONVENTIONS:
        problem = "no convention" if written is None else f"unknown convention {written!r}"
        raise FileFormatError(
            f"{table.source}: {problem}; write a line '# convention: standard' or '# convention: modified'"
        )
    known = ("joint", "type", *_UNITS, *_LIMITS)
    for name in table.columns:
        if name not in known:
            raise UnknownNameError(
                f"{table.header_location}: unknown column {name!r}; choose from {', '.join(known)}"
            )
    for name in ("joint", "type", *_REQUIRED):
        if name not in table.columns:
            raise FileFormatError(f"{table.header_location}: column {name!r} is missing; write {_CSV_HEADER}")
    columns: dict[str, list[Any]] = {
        "name": table.text(table.columns["joint"]),
        "type": table.text(table.columns["type"]),
    }
    for row, joint_type in enumerate(columns["type"]):
        if joint_type not in _JOINT_TYPES:
            raise FileFormatError(
                f"{table.cell_location(row, 'type')}: joint {columns['name'][row]!r}: unknown type "
                f"{joint_type!r}; choose from {', '.join(_JOINT_TYPES)}"
            )
    table.require_units(_UNITS)
    n_joints = len(table.cells)
    for key, units in _UNITS.items():
        column = table.columns.get(key)
        columns[key] = [0.0] * n_joints if column is None else table.to_si(column, units).tolist()
    for key, no_limit in _LIMITS.items():
        column = table.columns.get(key)
        columns[key] = [
            no_limit if column is None else _parse_limit(table, column, row, joint_type, no_limit)
            for row, joint_type in enumerate(columns["type"])
        ]
    poses = {key: _parse_pose_note(table, key, notes[key]) for key in ("base", "tool") if key in notes}
    return _build_table(table.source, convention, columns, poses)


def _notes(table: DataTable) -> dict[str, str]:
    """Return the comments `key: value` of a table."""
    pairs = (comment.split(":", 1) for comment in table.comments if ":" in comment)
    return {key.strip().lower(): value.strip() for key, value in pairs}


def _parse_pose_note(table: DataTable, key: str, note: str) -> Array:
    try:
        numbers = [float(word) for word in note.split()]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise FileFormatError(f"{table.source}: '# {key}:' needs six numbers: x y z in m, rx ry rz in rad")
    content = {"xyz_m": numbers[:3], "rotvec_rad": numbers[3:]}
    return toml.read_pose(TomlTable(table.source, content, f"[{key}]"))


def _parse_limit(table: DataTable, column: Column, row: int, joint_type: str, no_limit: float) -> float:
    """Parse the limit of a joint; the column's unit is an angle, a length, or both as in `lower[rad|m]`."""
    cell = table.cells[row][column.index].strip()
    if not cell:
        return no_limit
    units, example = (LENGTHS, "mm") if joint_type == "prismatic" else (ANGLES, "deg")
    unit = next((unit for unit in column.unit.split("|") if unit in units), None)
    if unit is None:
        raise FileFormatError(
            f"{table.header_location}: column {column.name!r} has no unit for a {joint_type} joint; "
            f"write {column.name}[{example}], or {column.name}[deg|mm] if there are joints of both types"
        )
    try:
        value = parse_number(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FileFormatError(
            f"{table.cell_location(row, column.name)}: {cell!r} is not a finite number; "
            "correct it, or leave it empty if there is no limit"
        )
    return value / units[unit]


def _build_table(
    source: str, convention: str, columns: Mapping[str, list[Any]], poses: Mapping[str, Array]
) -> DHTable:
    """Check the ranges of all entries and build the table."""
    if len(columns["name"]) > _MAX_JOINTS:
        raise FileFormatError(
            f"{source}: {len(columns['name'])} joints, more than {_MAX_JOINTS}; check that the file is a DH "
            "table"
        )
    for row, name in enumerate(columns["name"]):
        where = f"{source}: joint {name!r}"
        for key in (*_UNITS, *_LIMITS):
            value = columns[key][row]
            if _UNITS.get(key) is ANGLES and abs(value) > _MAX_ANGLE:
                raise FileFormatError(f"{where}: {key} is {value:g} rad, more than two turns; check its unit")
            if math.isfinite(value) and abs(value) > _MAX_ENTRY:
                raise FileFormatError(
                    f"{where}: {key} is {value:g} m or rad, beyond ±{_MAX_ENTRY:g}; check its unit"
                )
        limits = columns["lower"][row], columns["upper"][row]
        if limits[0] > limits[1]:
            raise FileFormatError(f"{where}: lower is above upper; swap them")
        if columns["type"][row] == "continuous" and np.isfinite(limits).any():
            raise FileFormatError(
                f"{where}: a continuous joint has limits; leave them out, or write the type revolute"
            )
    require_usable_names(columns["name"], source)
    prismatic, continuous = (
        np.array([joint_type == kind for joint_type in columns["type"]])
        for kind in ("prismatic", "continuous")
    )
    numbers = {key: np.array(columns[key], float) for key in (*_UNITS, *_LIMITS)}
    checked: Convention = "standard" if convention == "standard" else "modified"
    try:
        return DHTable(checked, tuple(columns["name"]), prismatic, **numbers, **poses, continuous=continuous)
    except DhcalError as error:
        raise FileFormatError(f"{source}: {error}") from None


# --- writing ---------------------------------------------------------------------------------------


def dh_text(table: DHTable, path: PathLike) -> str:
    """Return the text of a DH file in metres and radians."""
    require_usable_names(table.names, os.fspath(path))
    poses = {
        key: pose
        for key, pose in (("base", table.base), ("tool", table.tool))
        if not np.array_equal(pose, np.eye(4))
    }
    keys = [key for key in _UNITS if key in _REQUIRED or np.any(table.beta)]
    keys += [key for key in _LIMITS if np.isfinite(getattr(table, key)).any()]
    numbers = np.stack([getattr(table, key) for key in keys], -1).tolist()
    rows: list[_Row] = [
        (name, joint_type, dict(zip(keys, values, strict=True)))
        for name, joint_type, values in zip(table.names, table.joint_types, numbers, strict=True)
    ]
    return (_csv_text if _is_csv(path) else _toml_text)(table.convention, poses, keys, rows)


def _csv_text(convention: str, poses: Mapping[str, Array], keys: list[str], rows: list[_Row]) -> str:
    units = {"d": "m", "a": "m", "lower": "rad|m", "upper": "rad|m"}
    frames = {key: " ".join(map(repr, se3.position_and_rotvec(pose).tolist())) for key, pose in poses.items()}
    comments = [f"{key}: {text}" for key, text in ({"convention": convention} | frames).items()]
    names, types, values = zip(*rows, strict=True)
    columns = {
        f"{key}[{units.get(key, 'rad')}]": [each[key] if math.isfinite(each[key]) else "" for each in values]
        for key in keys
    }
    return csv_text({"joint": names, "type": types} | columns, comments)


def _toml_text(convention: str, poses: Mapping[str, Array], keys: list[str], rows: list[_Row]) -> str:
    head = {"convention": convention, "units": {"length": "m", "angle": "rad"}}
    blocks = [tomli_w.dumps(head | {key: toml.pose_content(pose) for key, pose in poses.items()})]
    for name, joint_type, values in rows:
        finite = {key: value for key, value in values.items() if math.isfinite(value)}
        # One by one, because tomli_w writes short tables of an array on one line each.
        blocks.append("[[joint]]\n" + tomli_w.dumps({"name": name, "type": joint_type, **finite}))
    return "\n".join(blocks)


def convert_to_dh(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a robot to a DH file; its own table stays as it is if it has the requested convention."""
    if robot.table is not None and robot.convention in (None, robot.table.convention):
        return ConvertedRobot(dh_text(robot.table, path))
    extraction = extract_dh_table(robot.chain, robot.convention or "standard")
    return ConvertedRobot(dh_text(extraction.table, path), extraction.notes)
