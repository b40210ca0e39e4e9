"""Files of other makers, read through a map: a TOML file that says which column is what.

Everything in a map but the columns themselves has a default:

    separator = ";"        # "," (default), ";", "tab", or "space" for any white space
    decimal = ","          # "." (default) or ","
    skip = 2               # lines before the header, 0 by default
    header = true          # false: there is none, and columns have numbers from 1
    comment = "#"          # what a comment line starts with; "" where there are none
    encoding = "cp1252"    # UTF-8 by default

    [joints]               # the robot's joints from its base to its tip, or those of `names`
    order = ["A1", "A2"]   # their headers or numbers
    unit = "deg"           # or one a joint, as ["deg", "mm"]
    sign = [1, -1]         # optional
    offset = [0.0, 90.0]   # optional, in that unit: ours = sign * theirs + offset

    [columns]              # our name = theirs
    x = {from = "X pos", unit = "mm"}
    sigma_x = {from = 9, unit = "mm", scale = 0.5}    # ours = scale * theirs + offset
    point = {from = "socket"}

    [rotation]             # how the target's rotation is written
    convention = "euler"   # or "rotvec", "quaternion" (order = "wxyz" or "xyzw"), "matrix" (nine, row by row)
    axes = "ZYX"           # euler: the axes in the order of the columns,
    frame = "intrinsic"    # about the axes as they have turned; "extrinsic": about fixed ones
    columns = ["A", "B", "C"]
    unit = "deg"           # euler and rotvec

    [constant]             # the same for a whole file; {file}, {stem}, {parent} are parts of its path
    point = "{parent}/{stem}"

`[to_joints]` is as `[joints]`, for the second configuration of a row. Columns of theirs that the map does
not name are left alone. A map is used for every file, but for one that lacks its columns and has a header
of the project's own.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import DhcalError
from ..units import ANGLES, UNITS
from .measurement_columns import ROTVEC, SECOND_PREFIX
from .tabular import Column, CsvTable, read_csv_table, read_text, read_toml

# What stands in braces in a constant.
PARTS = ("file", "stem", "parent")


_SEPARATORS = (",", ";", "tab", "space")


_PLAIN = {"separator": str, "decimal": str, "skip": int, "header": bool, "comment": str, "encoding": str}


_TABLES = ("joints", "to_joints", "columns", "rotation", "constant")


_EXAMPLES = {
    **{"separator": '";"', "decimal": '","', "skip": "2"},
    **{"header": "false", "comment": '"#"', "encoding": '"cp1252"'},
}


# How many columns a convention has, and what else it needs.
_CONVENTIONS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "rotvec": (3, ("unit",)),
    "euler": (3, ("unit", "axes", "frame")),
    "quaternion": (4, ("order",)),
    "matrix": (9, ()),
}


_WORDS = {
    "unit": ("|".join(ANGLES), " or ".join(ANGLES)),
    "axes": (r"(?i:([xyz])(?!\1)([xyz])(?!\2)[xyz])", 'three axes, as "XYZ" or "ZYZ"'),
    "frame": ("intrinsic|extrinsic", "intrinsic (axes that turn with it) or extrinsic (fixed axes)"),
    "order": ("wxyz|xyzw", "wxyz or xyzw"),
}


_MAX_VALUE = 1e300


@dataclass(frozen=True)
class ColumnRule:
    """A column of ours: its unit, which of theirs, and ours = scale * theirs + offset in that unit.

    `what` is "length", "angle", "number" or "text"; "" where the project has no such column.
    """

    name: str
    quantity: str
    unit: str
    source_column: str | int
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Rotation:
    """How a rotation is written: "rotvec", "euler", "quaternion" or "matrix", and what goes with it.

    `axes` and `order` are lower-case letters, `frame` is "intrinsic" or "extrinsic"; empty where not needed.
    """

    convention: str
    columns: tuple[str | int, ...]
    unit: str = ""
    axes: str = ""
    frame: str = ""
    order: str = ""


@dataclass(frozen=True)
class ColumnMap:
    """What a map says, checked.

    Attributes:
        source: the map's file.
        rules: the columns of ours that are columns of theirs.
        rotation: how theirs is written, or None.
        constants: columns of ours that are one text a file.
        separator, decimal, skip, header, comment, encoding: of their file.
    """

    source: str
    rules: tuple[ColumnRule, ...]
    rotation: Rotation | None
    constants: Mapping[str, str]
    separator: str = ","
    decimal: str = "."
    skip: int = 0
    header: bool = True
    comment: str = "#"
    encoding: str = "utf-8"


def read_map(path: PathLike, quantities: Mapping[str, str], joints: Sequence[str]) -> ColumnMap:
    """A map, checked for a robot.

    Args:
        path: the TOML file.
        quantities: for each column of ours, "length", "angle", "number" or "text".
        joints: the robot's joints in order.

    Raises:
        DhcalError: what is wrong in it, and what would be right.
    """
    where, raw = str(path), read_toml(path)
    _check_keys(raw, (*_PLAIN, *_TABLES), where)
    entries: list[ColumnRule] = []
    for key, before in (("joints", ""), ("to_joints", SECOND_PREFIX)):
        if key in raw:
            names = [before + name for name in joints]
            entries += _joints(raw[key], names, quantities, f"{where}: [{key}]")
    entries += _columns(raw.get("columns", {}), quantities, f"{where}: [columns]")
    rotation = _rotation(raw["rotation"], f"{where}: [rotation]") if "rotation" in raw else None
    constants = _constants(raw.get("constant", {}), quantities, f"{where}: [constant]")
    names = [*(entry.name for entry in entries), *constants, *(ROTVEC if rotation else ())]
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise DhcalError(f"{where}: {twice[0]!r} is given twice; once is enough")
    out = ColumnMap(where, tuple(entries), rotation, constants)
    return replace(out, **_settings(raw, out))


def _check_keys(raw: Any, allowed: Sequence[str], where: str) -> None:
    if not isinstance(raw, dict):
        raise DhcalError(f"{where}: {raw!r} is no table; give {', '.join(allowed)}")
    if unknown := [key for key in raw if key not in allowed]:
        raise DhcalError(f"{where}: unknown key {unknown[0]!r}; allowed: {', '.join(allowed)}")


def _settings(raw: Mapping[str, Any], default: ColumnMap) -> dict[str, Any]:
    where = default.source
    for key, kind in _PLAIN.items():
        if key in raw and type(raw[key]) is not kind:
            raise DhcalError(f"{where}: {key} = {raw[key]!r}; write it as in {key} = {_EXAMPLES[key]}")
    out = {key: raw.get(key, getattr(default, key)) for key in _PLAIN}
    for key, allowed in (("separator", _SEPARATORS), ("decimal", (".", ","))):
        if out[key] not in allowed:
            raise DhcalError(f"{where}: {key} = {out[key]!r}; choose from {', '.join(map(repr, allowed))}")
    if out["separator"] == out["decimal"]:
        raise DhcalError(f"{where}: separator and decimal are both ','; one of them must be another")
    try:
        codecs.lookup(out["encoding"])
    except LookupError:
        raise DhcalError(f"{where}: encoding = {out['encoding']!r}; write one as utf-8 or cp1252") from None
    if out["skip"] < 0:
        raise DhcalError(f"{where}: skip = {out['skip']}; write how many lines stand before the header")
    return out


def _rule(
    name: str, raw: Mapping[str, Any], quantities: Mapping[str, str], source: Any, where: str
) -> ColumnRule:
    """A column of ours from `unit`, `scale` and `offset`, and whatever names theirs."""
    what, unit = quantities.get(name, ""), raw.get("unit", "")
    units = UNITS.get(what, {})
    # Whoever knows the readings complains about a name that is none.
    if what and (units or unit) and unit not in units:
        names = ", ".join(f'"{unit}"' for unit in units if unit.isascii())
        fix = f"write unit = one of {names}" if units else "leave the unit out"
        raise DhcalError(f"{where}: {name}: unit {unit!r}; {fix}")
    scale, offset = _number(raw.get("scale", 1), where), _number(raw.get("offset", 0), where)
    if what == "text" and (scale, offset) != (1.0, 0.0):
        raise DhcalError(f"{where}: {name}: is text; leave scale and offset out")
    return ColumnRule(name, what, unit, _source_column(source, where), scale, offset)


def _columns(raw: Any, quantities: Mapping[str, str], where: str) -> list[ColumnRule]:
    if not isinstance(raw, dict):
        raise DhcalError(f'{where}: {raw!r} is no table; write entries such as x = {{from = 1, unit = "mm"}}')
    out = []
    for name, entry in raw.items():
        _check_keys(entry, ("from", "unit", "scale", "offset"), f"{where} {name}")
        if "from" not in entry:
            raise DhcalError(f'{where} {name}: has no `from`; write {name} = {{from = "their header"}}')
        out.append(_rule(name, entry, quantities, entry["from"], f"{where} {name}"))
    return out


def _joints(raw: Any, joints: Sequence[str], quantities: Mapping[str, str], where: str) -> list[ColumnRule]:
    _check_keys(raw, ("order", "names", "unit", "sign", "offset"), where)
    order = _column_list(raw.get("order"), None, f"{where} order")
    names = _column_list(raw.get("names", joints), len(order), f"{where} names")
    unit = raw.get("unit", "")
    units = _column_list(unit if isinstance(unit, list) else [unit] * len(order), len(order), f"{where} unit")
    sign = _column_list(raw.get("sign", [1] * len(order)), len(order), f"{where} sign")
    offset = _column_list(raw.get("offset", [0] * len(order)), len(order), f"{where} offset")
    if any(type(value) is bool or value not in (1, -1) for value in sign):
        raise DhcalError(f"{where} sign: {sign}; write 1 or -1 for each joint")
    return [
        _rule(str(name), {"unit": unit, "scale": s, "offset": o}, quantities, source, where)
        for name, source, unit, s, o in zip(names, order, units, sign, offset, strict=True)
    ]


def _column_list(value: Any, count: int | None, where: str) -> list[Any]:
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise DhcalError(f"{where}: write a list in brackets, one entry a column")
    if count not in (None, len(value)):
        raise DhcalError(f"{where}: {len(value)} entries for {count} columns; give as many")
    return list(value)


def _source_column(value: Any, where: str) -> str | int:
    if type(value) is str or (type(value) is int and value > 0):
        return value
    raise DhcalError(f"{where}: {value!r} names no column; write its header, or its number from 1")


def _number(value: Any, where: str) -> float:
    if type(value) not in (int, float) or not abs(value) < _MAX_VALUE:
        raise DhcalError(f"{where}: {value!r} is no number for a scale or an offset")
    return float(value)


def _rotation(raw: Any, where: str) -> Rotation:
    _check_keys(raw, ("convention", "axes", "frame", "order", "columns", "unit"), where)
    convention = raw.get("convention")
    if convention not in _CONVENTIONS:
        raise DhcalError(f"{where} convention = {convention!r}; choose from {', '.join(_CONVENTIONS)}")
    count, needs = _CONVENTIONS[convention]
    for key in ("unit", "axes", "frame", "order"):
        value, fits = raw.get(key), key in needs
        if key in raw and not fits:
            raise DhcalError(f"{where} {key}: does not go with {convention}; leave it out")
        if fits and key not in raw:
            raise DhcalError(f"{where}: no {key}; {convention} needs {_WORDS[key][1]}")
        if fits and not (isinstance(value, str) and re.fullmatch(_WORDS[key][0], value)):
            raise DhcalError(f"{where} {key} = {value!r}; {convention} needs {_WORDS[key][1]}")
    columns = _column_list(raw.get("columns"), count, f"{where} columns")
    rest = {key: raw[key] if key == "unit" else raw[key].lower() for key in needs}
    return Rotation(convention, tuple(_source_column(name, where) for name in columns), **rest)


def _constants(raw: Any, quantities: Mapping[str, str], where: str) -> dict[str, str]:
    _check_keys(raw, [name for name, what in quantities.items() if what == "text"], where)
    for name, text in raw.items():
        if not isinstance(text, str) or not text:
            raise DhcalError(f'{where} {name} = {text!r}; write a text, as in {name} = "{{stem}}"')
        if unknown := set(re.findall(r"\{([^}]*)\}", text)) - set(PARTS):
            parts = ", ".join(f"{{{part}}}" for part in PARTS)
            raise DhcalError(f"{where} {name}: {{{min(unknown)}}} stands for nothing; there are {parts}")
    return dict(raw)


_DELIMITERS = {",": ",", ";": ";", "tab": "\t"}


# A matrix that is less of a rotation than this was not rounded but mistaken.
_MAX_SKEW = 1e-3


@dataclass(frozen=True)
class _VendorTable:
    """Their file: names of its columns, cells by line, the header's line, comments, and how it is written."""

    source: str
    column_map: ColumnMap
    names: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: list[int]
    header: int
    comments: tuple[str, ...]

    def column_index(self, name: str | int) -> int | None:
        """Where a column stands, from 0; None if it is not there."""
        if isinstance(name, int):
            return name - 1 if name <= len(self.names) else None
        if self.names.count(name) > 1:
            raise DhcalError(
                f"{self.source}:{self.header}: column {name!r} stands twice; give its number in the map"
            )
        return self.names.index(name) if name in self.names else None

    def missing_columns(self) -> list[str | int]:
        """The columns that the map names and the file does not have."""
        rotation = self.column_map.rotation.columns if self.column_map.rotation else ()
        theirs = [*(entry.source_column for entry in self.column_map.rules), *rotation]
        return [name for name in theirs if self.column_index(name) is None]

    def text(self, name: str | int) -> list[str]:
        """A column's cells."""
        index = self.column_index(name)
        assert index is not None
        return [row[index] for row in self.rows]

    def numbers(self, name: str | int) -> tuple[list[str], Array]:
        """A column's cells with a decimal point, and its numbers (m,)."""
        cells, decimal = self.text(name), self.column_map.decimal
        other = "." if decimal == "," else ","
        for cell, line in zip(cells, self.lines, strict=True):
            if other in cell:
                raise DhcalError(
                    f"{self.source}:{line}: column {name!r}: {cell!r} where the decimal sign is {decimal!r}; "
                    "write it with that sign, and none for thousands"
                )
        cells = [cell.replace(decimal, ".") for cell in cells]
        sheet = CsvTable(self.source, (), {}, [[cell] for cell in cells], self.lines, self.header)
        return cells, sheet.numbers(Column(str(name), "", 0))


def read_mapped_table(path: PathLike, column_map: ColumnMap, known: Set[str]) -> CsvTable:
    """Another maker's file as a sheet of the project's own.

    Args:
        path: the file.
        column_map: the map.
        known: columns that a file of the project's own can have.

    Raises:
        DhcalError: the file is not as the map says.
    """
    if _is_native(path, known) and not _matches(path, column_map):
        return read_csv_table(path)
    raw = _read(path, column_map)
    if lacking := raw.missing_columns():
        raise DhcalError(
            f"{path}:{raw.header}: no column {lacking[0]!r}, which {column_map.source} names; with separator "
            f"{column_map.separator!r} there are {', '.join(map(repr, raw.names[:30]))}"
        )
    found = {entry.name: (entry.unit, _cells(raw, entry)) for entry in column_map.rules}
    found |= _rotation_columns(raw, column_map.rotation) if column_map.rotation else {}
    place = Path(path).absolute()
    parts: dict[str, str] = dict(zip(PARTS, (place.name, place.stem, place.parent.name), strict=True))
    for name, text in column_map.constants.items():
        # No str.format: a path may have braces too.
        full = re.sub("|".join(f"{{{part}}}" for part in PARTS), lambda hit: parts[hit[0][1:-1]], text)
        found[name] = "", [full] * len(raw.rows)
    return CsvTable(
        raw.source,
        raw.comments,
        {name: Column(name, unit, i) for i, (name, (unit, _)) in enumerate(found.items())},
        [list(row) for row in zip(*(cells for _, cells in found.values()), strict=True)],
        raw.lines,
        raw.header,
    )


def _read(path: PathLike, how: ColumnMap) -> _VendorTable:
    """Their lines cut into cells."""
    comments: list[str] = []
    kept: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(path, how.encoding).splitlines(), 1):
        if number <= how.skip or not line.strip(" \t,;"):
            continue
        if how.comment and line.lstrip().startswith(how.comment):
            comments.append(line.lstrip()[len(how.comment) :].strip())
            continue
        try:
            # Line by line, so that a stray quote stays in its own row.
            cells = (
                line.split()
                if how.separator == "space"
                else next(csv.reader([line], delimiter=_DELIMITERS[how.separator]))
            )
        except csv.Error as error:
            raise DhcalError(f"{path}:{number}: {error}; correct this line") from error
        kept.append((number, [cell.strip() for cell in cells]))
    if len(kept) <= how.header:
        raise DhcalError(f"{path}: no rows with readings; add at least one")
    first, names = kept[0]
    if not how.header:
        names = [str(i) for i in range(1, len(names) + 1)]
    rows = kept[how.header :]
    for number, cells in rows:
        # A separator at the end of a line makes no column.
        if len(cells) < len(names) or any(cells[len(names) :]):
            raise DhcalError(
                f"{path}:{number}: {len(cells)} values for {len(names)} columns; correct the row, or "
                f"separator and decimal in {how.source}"
            )
    return _VendorTable(
        str(path),
        how,
        names,
        [cells for _, cells in rows],
        [number for number, _ in rows],
        first,
        tuple(comments),
    )


def _is_native(path: PathLike, known: Set[str]) -> bool:
    """Whether a file's header is the project's own."""
    try:
        return set(read_csv_table(path).columns) <= known
    except DhcalError:
        return False


def _matches(path: PathLike, how: ColumnMap) -> bool:
    """Whether a file has a header with all the columns of a map."""
    try:
        return how.header and not _read(path, how).missing_columns()
    except DhcalError:
        return False


def _cells(raw: _VendorTable, entry: ColumnRule) -> list[str]:
    """One column of ours; digits stay as they are where nothing is computed."""
    if entry.quantity == "text":
        return raw.text(entry.source_column)
    cells, values = raw.numbers(entry.source_column)
    if (entry.scale, entry.offset) == (1.0, 0.0):
        return cells
    return [repr(value) for value in (entry.scale * values + entry.offset).tolist()]


def _rotation_columns(raw: _VendorTable, how: Rotation) -> dict[str, tuple[str, list[str]]]:
    """The columns of ours for a rotation of theirs, each with its unit."""
    pairs = [raw.numbers(name) for name in how.columns]
    if how.convention in ("rotvec", "quaternion"):
        names = ROTVEC if how.convention == "rotvec" else [f"q{letter}" for letter in how.order]
        return {name: (how.unit, cells) for name, (cells, _) in zip(names, pairs, strict=True)}
    values = np.stack([numbers for _, numbers in pairs], -1)
    if how.convention == "euler":
        turns = euler(values / ANGLES[how.unit], how.axes, how.frame)
    else:
        turns = _nearest(values.reshape(-1, 3, 3), raw)
    vectors = se3.log3(turns).T.tolist()
    return {name: ("rad", [*map(repr, column)]) for name, column in zip(ROTVEC, vectors, strict=True)}


def euler(angles: Array, axes: str, frame: str) -> Array:
    """Rotations (m, 3, 3) of Euler angles (m, 3) in rad about three axes, such as "xyz", in that order.

    Intrinsic angles turn about axes as the turns before have left them, extrinsic ones about fixed axes.
    """
    first, second, third = (
        se3.exp3(angles[:, i, None] * np.eye(3)["xyz".index(axis)]) for i, axis in enumerate(axes)
    )
    return first @ second @ third if frame == "intrinsic" else third @ second @ first


def _nearest(matrices: Array, raw: _VendorTable) -> Array:
    """Rotations (m, 3, 3) nearest to matrices, or DhcalError where one is none."""
    u, s, vt = np.linalg.svd(matrices)
    off = np.abs(s - 1).max(-1) + (np.linalg.det(matrices) < 0)
    if (bad := np.flatnonzero(off > _MAX_SKEW)).size:
        raise DhcalError(
            f"{raw.source}:{raw.lines[bad[0]]}: the nine numbers are no rotation, by {off[bad[0]]:.2g}; "
            "give them row by row, right-handed, within a thousandth"
        )
    return u @ vt
