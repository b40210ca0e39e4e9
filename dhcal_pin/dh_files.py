"""DH tables in TOML and CSV, in any unit that the file states."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from . import se3
from .dh import CONVENTIONS, DHTable
from .errors import DhcalError
from .files import ANGLES, LENGTHS, PathLike, read_sheet, read_toml
from .se3 import Array

_DH_KEYS = {"theta": ANGLES, "d": LENGTHS, "a": LENGTHS, "alpha": ANGLES, "beta": ANGLES}


def is_dh(path: PathLike) -> bool:
    """Whether a path names a DH file: .toml or .csv."""
    return os.fspath(path).lower().endswith((".toml", ".csv"))


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
    if not (
        isinstance(values, dict)
        and all(np.shape(values.get(key, (0.0,) * 3)) == (3,) for key in ("xyz_m", "rotvec_rad"))
    ):
        raise DhcalError(f"{source}: [{name}] needs xyz_m and rotvec_rad, three numbers each")
    xyz, turn = (np.array(values.get(key, (0.0,) * 3), float) for key in ("xyz_m", "rotvec_rad"))
    return se3.transform(se3.exp3(turn), xyz)


def _read_dh_toml(path: PathLike) -> DHTable:
    source, raw = os.fspath(path), read_toml(path)
    convention = _convention(raw.get("convention"), source, 'convention = "standard"')
    units = raw.get("units", {})
    scales = {}
    for key, known in (("length", LENGTHS), ("angle", ANGLES)):
        if not isinstance(units, dict) or units.get(key) not in known:
            raise DhcalError(f"{source}: [units] must state {key} as one of {', '.join(known)}")
        scales[key] = known[units[key]]
    joints = raw.get("joint")
    if not isinstance(joints, list) or not joints:
        raise DhcalError(f"{source}: no [[joint]]; write one block a joint with theta, d, a, alpha")
    columns: dict[str, list] = {key: [] for key in ("name", "type", *_DH_KEYS, "lower", "upper")}
    for number, joint in enumerate(joints, 1):
        name = joint.get("name", f"joint_{number}")
        if unknown := set(joint) - set(columns):
            raise DhcalError(
                f"{source}: joint {name!r}: unknown key {min(unknown)!r}; allowed: {', '.join(columns)}"
            )
        kind = joint.get("type", "revolute")
        for key in ("theta", "d", "a", "alpha"):
            if key not in joint:
                raise DhcalError(f"{source}: joint {name!r}: {key} is missing; write 0.0 if it is zero")
        for key in (*_DH_KEYS, "lower", "upper"):
            slides = key in ("d", "a") or (key in ("lower", "upper") and kind == "prismatic")
            default = {"lower": -np.inf, "upper": np.inf}.get(key, 0.0)
            value = joint.get(key, default)
            if (
                isinstance(value, bool)
                or not isinstance(value, int | float)
                or (key in _DH_KEYS and not np.isfinite(value))
            ):
                raise DhcalError(f"{source}: joint {name!r}: {key} = {value!r} is not a finite number")
            columns[key].append(value / scales["length" if slides else "angle"])
        columns["name"].append(name)
        columns["type"].append(kind)
    frames = {key: read_frame(raw[key], source, key) for key in ("base", "tool") if key in raw}
    return _table(source, convention, columns, frames)


def _read_dh_csv(path: PathLike) -> DHTable:
    sheet = read_sheet(path)
    notes = dict(part.split(":", 1) for part in sheet.comments if ":" in part)
    notes = {key.strip().lower(): value.strip() for key, value in notes.items()}
    convention = _convention(notes.get("convention"), sheet.source, "a line '# convention: standard'")
    known = ("joint", "type", *_DH_KEYS)
    for name in sheet.columns:
        if name not in known:
            raise DhcalError(
                f"{sheet.source}:{sheet.header}: unknown column {name!r}; allowed: {', '.join(known)}"
            )
    for name in ("joint", "type", "theta", "d", "a", "alpha"):
        if name not in sheet.columns:
            raise DhcalError(f"{sheet.source}:{sheet.header}: column {name!r} is missing")
    columns: dict[str, list] = {
        "name": sheet.text(sheet.columns["joint"]),
        "type": sheet.text(sheet.columns["type"]),
    }
    where = f"{sheet.source}:{sheet.header}"
    for key, units in _DH_KEYS.items():
        column = sheet.columns.get(key)
        columns[key] = (
            [0.0] * len(sheet.cells)
            if column is None
            else list(sheet.numbers(column) / column.scale(units, where))
        )
    columns["lower"], columns["upper"] = [-np.inf] * len(sheet.cells), [np.inf] * len(sheet.cells)
    frames = {}
    for key in ("base", "tool"):
        if key in notes:
            try:
                numbers = np.array(notes[key].split(), float)
                frames[key] = read_frame({"xyz_m": numbers[:3], "rotvec_rad": numbers[3:]}, sheet.source, key)
            except ValueError:
                raise DhcalError(f"{sheet.source}: '# {key}:' needs six numbers, m and rad") from None
    return _table(sheet.source, convention, columns, frames)


def _table(source: str, convention: str, columns: Mapping[str, list], frames: Mapping[str, Array]) -> DHTable:
    for name, kind in zip(columns["name"], columns["type"], strict=True):
        if kind not in ("revolute", "prismatic"):
            raise DhcalError(f"{source}: joint {name!r}: type {kind!r} must be revolute or prismatic")
        if not isinstance(name, str) or not name:
            raise DhcalError(f"{source}: joint name {name!r} must be a text")
    slides = np.array([kind == "prismatic" for kind in columns["type"]])
    numbers = {key: np.array(columns[key], float) for key in (*_DH_KEYS, "lower", "upper")}
    try:
        return DHTable(convention, tuple(columns["name"]), slides, **numbers, **frames)  # pyright: ignore[reportArgumentType]
    except DhcalError as error:
        raise DhcalError(f"{source}: {error}") from None


def dh_text(table: DHTable, path: PathLike) -> str:
    """The text of a DH file, TOML or CSV by the path's ending; metres and radians, every digit."""
    rows = [
        (name, "prismatic" if slides else "revolute", *map(float, values))
        for name, slides, *values in zip(
            table.names, table.prismatic, table.theta, table.d, table.a, table.alpha, table.beta,
            table.lower, table.upper, strict=True,
        )
    ]  # fmt: skip
    frames = {
        key: [*map(float, pose[:3, 3]), *map(float, se3.log3(pose[:3, :3]))]
        for key, pose in (("base", table.base), ("tool", table.tool))
        if not np.array_equal(pose, np.eye(4))
    }
    keys = ["theta", "d", "a", "alpha"] + (["beta"] if np.any(table.beta) else [])
    place = {"theta": 2, "d": 3, "a": 4, "alpha": 5, "beta": 6, "lower": 7, "upper": 8}
    if os.fspath(path).lower().endswith(".csv"):
        out = [f"# convention: {table.convention}"]
        out += [f"# {key}: {' '.join(map(repr, six))}" for key, six in frames.items()]
        unit = {"d": "m", "a": "m"}
        out.append(",".join(["joint", "type", *(f"{key}[{unit.get(key, 'rad')}]" for key in keys)]))
        out += [",".join([row[0], row[1], *(repr(row[place[key]]) for key in keys)]) for row in rows]
        return "\n".join(out) + "\n"
    out = [f'convention = "{table.convention}"', "", "[units]", 'length = "m"', 'angle = "rad"']
    for key, six in frames.items():
        out += ["", f"[{key}]", f"xyz_m = {six[:3]}", f"rotvec_rad = {six[3:]}"]
    for row in rows:
        out += ["", "[[joint]]", f'name = "{row[0]}"', f'type = "{row[1]}"']
        out += [f"{key} = {row[place[key]]!r}" for key in keys]
        out += [f"{key} = {row[place[key]]!r}" for key in ("lower", "upper") if np.isfinite(row[place[key]])]
    return "\n".join(out) + "\n"
