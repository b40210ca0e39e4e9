"""DH tables in TOML and CSV, in any unit that the file states."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import DhcalError
from ..robot.chain import extract_dh_table
from ..robot.dh import CONVENTIONS, DHTable
from ..units import ANGLES, LENGTHS
from .robot_format import ConvertedRobot, RobotSource
from .sidecar import existing_sidecar
from .tabular import Column, CsvTable, number, read_csv_table, read_toml, require_usable_names

_UNITS = {"theta": ANGLES, "d": LENGTHS, "a": LENGTHS, "alpha": ANGLES, "beta": ANGLES}


_LIMITS = {"lower": -math.inf, "upper": math.inf}


_REQUIRED = ("theta", "d", "a", "alpha")


_LARGEST = 1e300  # that still is a finite double in any unit


_MAX_VALUE = 1e4  # m or rad: beyond it no robot, and no URDF


def read_dh(path: PathLike) -> DHTable:
    """A DH table from `.dh.toml` or `.dh.csv`.

    Raises:
        DhcalError: no convention or unit, an unknown key, a value that is not a finite number.
    """
    return _read_dh_csv(path) if os.fspath(path).lower().endswith(".csv") else _read_dh_toml(path)


def _convention(value: object, source: str, form: str) -> str:
    if value not in CONVENTIONS:
        said = "states no convention" if value is None else f"convention {value!r} is unknown"
        raise DhcalError(f"{source}: {said}; write {form} or the same with modified")
    return str(value)


def read_frame(values: object, source: str, name: str) -> Array:
    """A pose (4, 4) from a TOML table with xyz_m and rotvec_rad, or DhcalError naming the file."""
    zero = [0.0, 0.0, 0.0]
    table = values if isinstance(values, dict) else {"": values}
    three = [table.get(key, zero) for key in ("xyz_m", "rotvec_rad")]
    if set(table) - {"xyz_m", "rotvec_rad"} or not all(
        isinstance(item, list) and len(item) == 3 and all(map(_is_number, item)) for item in three
    ):
        raise DhcalError(
            f"{source}: [{name}] needs xyz_m and rotvec_rad alone, three numbers each as [0.0, 0.0, 0.0]"
        )
    xyz, turn = np.array(three, float)
    return se3.transform(se3.exp3(turn), xyz)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MAX_VALUE


# --- TOML ------------------------------------------------------------------------------------------
def _read_dh_toml(path: PathLike) -> DHTable:
    source, raw = os.fspath(path), read_toml(path)
    convention = _convention(raw.get("convention"), source, 'convention = "standard"')
    if unknown := set(raw) - {"convention", "units", "joint", "base", "tool"}:
        raise DhcalError(
            f"{source}: unknown key {min(unknown)!r}; allowed: convention, units, joint, base, tool"
        )
    units = raw.get("units")
    scales = {}
    for key, known in (("length", LENGTHS), ("angle", ANGLES)):
        unit = units.get(key) if isinstance(units, dict) else None
        if not isinstance(unit, str) or unit not in known:
            raise DhcalError(
                f"{source}: [units] must state {key} as one of {', '.join(filter(str.isascii, known))}"
            )
        scales[key] = known[unit]
    joints = raw.get("joint")
    if not isinstance(joints, list) or not joints or not all(isinstance(joint, dict) for joint in joints):
        raise DhcalError(f"{source}: no [[joint]]; write one block a joint with theta, d, a, alpha")
    columns: dict[str, list] = {key: [] for key in ("name", "type", *_UNITS, *_LIMITS)}
    for place, joint in enumerate(joints, 1):
        kind = joint.get("type", "revolute")
        columns["name"].append(joint.get("name", f"joint_{place}"))
        columns["type"].append(kind)
        where = f"{source}: joint {columns['name'][-1]!r}"
        if unknown := set(joint) - set(columns):
            raise DhcalError(f"{where}: unknown key {min(unknown)!r}; allowed: {', '.join(columns)}")
        for key, known in _UNITS.items():
            columns[key].append(_entry(joint, key, where) / scales["length" if known is LENGTHS else "angle"])
        for key, none in _LIMITS.items():
            value = none if joint.get(key) in (-math.inf, math.inf) else _entry(joint, key, where, none)
            columns[key].append(value / scales["length" if kind == "prismatic" else "angle"])
    frames = {key: read_frame(raw[key], source, key) for key in ("base", "tool") if key in raw}
    return _table(source, convention, columns, frames)


def _entry(joint: Mapping[str, object], key: str, where: str, default: float = 0.0) -> float:
    if key not in joint:
        if key in _REQUIRED:
            raise DhcalError(f"{where}: {key} is missing; write {key} = 0.0 if it is zero")
        return default
    value = joint[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        raise DhcalError(f"{where}: {key} = {value!r} is not a finite number; write one such as 0.0")
    return float(value)


# --- CSV -------------------------------------------------------------------------------------------
def _read_dh_csv(path: PathLike) -> DHTable:
    sheet = read_csv_table(path)
    where = f"{sheet.source}:{sheet.header}"
    notes = dict(part.split(":", 1) for part in sheet.comments if ":" in part)
    notes = {key.strip().lower(): value.strip() for key, value in notes.items()}
    convention = _convention(notes.get("convention"), sheet.source, "a line '# convention: standard'")
    known = ("joint", "type", *_UNITS, *_LIMITS)
    for name in sheet.columns:
        if name not in known:
            raise DhcalError(f"{where}: unknown column {name!r}; allowed: {', '.join(known)}")
    for name in ("joint", "type", *_REQUIRED):
        if name not in sheet.columns:
            raise DhcalError(
                f"{where}: column {name!r} is missing; write joint,type,theta[deg],d[mm],a[mm],alpha[deg]"
            )
    columns: dict[str, list] = {
        "name": sheet.text(sheet.columns["joint"]),
        "type": sheet.text(sheet.columns["type"]),
    }
    for key, units in _UNITS.items():
        column = sheet.columns.get(key)
        columns[key] = [0.0] * len(sheet.cells) if column is None else sheet.to_si(column, units).tolist()
    for key, none in _LIMITS.items():
        column = sheet.columns.get(key)
        columns[key] = (
            [none] * len(sheet.cells)
            if column is None
            else [
                _limit(sheet, column, row, kind == "prismatic", none)
                for row, kind in enumerate(columns["type"])
            ]
        )
    frames = {}
    for key in ("base", "tool"):
        if key in notes:
            try:
                six = [float(word) for word in notes[key].split()]
            except ValueError:
                six = []
            if len(six) != 6:
                raise DhcalError(f"{sheet.source}: '# {key}:' needs six numbers: x y z in m, rx ry rz in rad")
            frames[key] = read_frame({"xyz_m": six[:3], "rotvec_rad": six[3:]}, sheet.source, key)
    return _table(sheet.source, convention, columns, frames)


def _limit(sheet: CsvTable, column: Column, row: int, slides: bool, none: float) -> float:
    """One joint's limit; the column's unit is an angle, a length, or both as in `lower[rad|m]`."""
    cell = sheet.cells[row][column.index].strip()
    if not cell:
        return none
    units = LENGTHS if slides else ANGLES
    unit = next((unit for unit in column.unit.split("|") if unit in units), "")
    if not unit:
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: column {column.name!r} has no unit for a "
            f"{'sliding' if slides else 'turning'} joint; write {column.name}[{'mm' if slides else 'deg'}], "
            f"or {column.name}[deg|mm] where there are both kinds"
        )
    try:
        value = number(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DhcalError(
            f"{sheet.source}:{sheet.lines[row]}: column {column.name!r}: {cell!r} is not a finite number; "
            "correct it, or leave it empty where there is no limit"
        )
    return value / units[unit]


# --- both ------------------------------------------------------------------------------------------
def _table(source: str, convention: str, columns: Mapping[str, list], frames: Mapping[str, Array]) -> DHTable:
    for row, (name, kind) in enumerate(zip(columns["name"], columns["type"], strict=True)):
        where = f"{source}: joint {name!r}"
        if not isinstance(name, str):
            raise DhcalError(f"{where}: a name must be a text; put it in quotes")
        if kind not in ("revolute", "prismatic"):
            raise DhcalError(f"{where}: type {kind!r} must be revolute or prismatic")
        for key in (*_UNITS, *_LIMITS):
            value = columns[key][row]
            if math.isfinite(value) and abs(value) > _MAX_VALUE:
                raise DhcalError(
                    f"{where}: {key} is {value:g} m or rad, beyond ±{_MAX_VALUE:g}; check its unit"
                )
        if columns["lower"][row] > columns["upper"][row]:
            raise DhcalError(f"{where}: lower is above upper; swap them")
    require_usable_names(columns["name"], source)
    slides = np.array([kind == "prismatic" for kind in columns["type"]])
    numbers = {key: np.array(columns[key], float) for key in (*_UNITS, *_LIMITS)}
    try:
        return DHTable(convention, tuple(columns["name"]), slides, **numbers, **frames)  # pyright: ignore[reportArgumentType]
    except DhcalError as error:
        raise DhcalError(f"{source}: {error}") from None


def dh_text(table: DHTable, path: PathLike) -> str:
    """The text of a DH file, TOML or CSV by the path's ending; metres and radians, every digit.

    Raises:
        DhcalError: a joint's name does not go into a table.
    """
    require_usable_names(table.names, os.fspath(path))
    frames = {
        key: [*pose[:3, 3].tolist(), *se3.log3(pose[:3, :3]).tolist()]
        for key, pose in (("base", table.base), ("tool", table.tool))
        if not np.array_equal(pose, np.eye(4))
    }
    keys = [key for key in _UNITS if key in _REQUIRED or np.any(table.beta)]
    keys += [key for key in _LIMITS if np.isfinite(getattr(table, key)).any()]
    rows = [
        (name, "prismatic" if slides else "revolute", dict(zip(keys, values, strict=True)))
        for name, slides, values in zip(
            table.names,
            table.prismatic,
            np.stack([getattr(table, key) for key in keys], -1).tolist(),
            strict=True,
        )
    ]
    text = _csv_text if os.fspath(path).lower().endswith(".csv") else _toml_text
    return "\n".join(text(table.convention, frames, keys, rows)) + "\n"


def convert_to_dh(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a robot to a DH file.

    A table that already has the convention is written as it is; another one is extracted from the chain.
    """
    if robot.table is not None and robot.convention in (None, robot.table.convention):
        return ConvertedRobot(dh_text(robot.table, path))
    extraction = extract_dh_table(robot.chain, robot.convention or "standard")
    sidecar = existing_sidecar(robot.path)
    notes = [f"base, tool and joints in {sidecar} do not go to the table"] if sidecar else []
    return ConvertedRobot(dh_text(extraction.table, path), [*extraction.notes, *notes])


_Row = tuple[str, str, dict[str, float]]


def _csv_text(convention: str, frames: Mapping[str, list], keys: list[str], rows: list[_Row]) -> list[str]:
    units = {"d": "m", "a": "m", "lower": "rad|m", "upper": "rad|m"}
    out = [f"# convention: {convention}"]
    out += [f"# {key}: {' '.join(map(repr, six))}" for key, six in frames.items()]
    out.append(",".join(["joint", "type", *(f"{key}[{units.get(key, 'rad')}]" for key in keys)]))
    for name, kind, values in rows:
        out.append(",".join([name, kind, *(repr(x) if math.isfinite(x) else "" for x in values.values())]))
    return out


def _toml_text(convention: str, frames: Mapping[str, list], keys: list[str], rows: list[_Row]) -> list[str]:
    out = [f'convention = "{convention}"', "", "[units]", 'length = "m"', 'angle = "rad"']
    for key, six in frames.items():
        out += ["", f"[{key}]", f"xyz_m = {six[:3]}", f"rotvec_rad = {six[3:]}"]
    for name, kind, values in rows:
        # A JSON string is a TOML string.
        out += ["", "[[joint]]", f"name = {json.dumps(name, ensure_ascii=False)}", f'type = "{kind}"']
        out += [f"{key} = {value!r}" for key, value in values.items() if math.isfinite(value)]
    return out
