"""Column maps: read measurement files of other vendors.

A column map is a TOML file that describes the columns of a vendor's file. Every key except the columns
themselves has a default:

    separator = ";"        # "," (default), ";", "tab", or "space" for any white space
    decimal = ","          # "." (default) or ","
    skip = 2               # number of lines before the header (default 0)
    header = true          # false: the file has no header; columns are numbers counted from 1
    comment = "#"          # start of a comment line; "" if there are none
    encoding = "cp1252"    # UTF-8 by default

    [joints]               # joints of the robot from base to tip, or those in `names`
    order = ["A1", "A2"]   # header or number of each joint's column
    unit = "deg"           # or one unit per joint, such as ["deg", "mm"]
    sign = [1, -1]         # optional
    offset = [0.0, 90.0]   # optional, in that unit: joint = sign * column + offset

    [columns]              # project column = vendor column
    x = {from = "X pos", unit = "mm"}
    sigma_x = {from = 9, unit = "mm", scale = 0.5}    # value = scale * column + offset
    point = {from = "socket"}

    [rotation]             # how the rotation of the target is written
    convention = "euler"   # or "rotvec", "quaternion", "matrix" (9 columns, row by row)
    axes = "ZYX"           # euler: axes in the order of the columns
    frame = "intrinsic"    # euler: about the rotated axes; "extrinsic": about the fixed axes
    order = "wxyz"         # quaternion, in place of the keys of euler; or "xyzw"
    columns = ["A", "B", "C"]
    unit = "deg"           # euler and rotvec

    [constant]             # text for the whole file; {file}, {stem}, {parent} are parts of its path
    point = "{parent}/{stem}"

`[to_joints]` has the keys of `[joints]` and describes the second configuration of a row. Columns of the file
that the map does not name are ignored. The map applies to every file, except to files with a header of the
project's own that lack columns of the map.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import DhcalError, FileFormatError, UnknownNameError
from ..units import ANGLES, UNITS
from .measurement_columns import ROTVEC, SECOND_PREFIX
from .tabular import BLANK_CHARACTERS, Column, CsvTable, read_csv_table, read_text
from .toml_table import TomlTable, is_number

# Placeholders in a constant, each written in braces.
_PATH_PARTS = ("file", "stem", "parent")
# Separator characters by their names in a map; None for any white space.
_SEPARATORS: Mapping[str, str | None] = {",": ",", ";": ";", "tab": "\t", "space": None}
# Number of columns of each convention of rotations, and the other keys that it needs.
_CONVENTIONS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "rotvec": (3, ("unit",)),
    "euler": (3, ("unit", "axes", "frame")),
    "quaternion": (4, ("order",)),
    "matrix": (9, ()),
}
# Pattern of the value of each of these keys, and its description.
_CONVENTION_KEYS = {
    "unit": ("|".join(ANGLES), " or ".join(ANGLES)),
    "axes": (r"(?i:([xyz])(?!\1)([xyz])(?!\2)[xyz])", 'three axes, such as "XYZ" or "ZYZ"'),
    "frame": ("intrinsic|extrinsic", "intrinsic (rotated axes) or extrinsic (fixed axes)"),
    "order": ("wxyz|xyzw", "wxyz or xyzw"),
}
# Largest deviation of a matrix' singular values from 1. A larger one is an error, not rounding.
_MAX_ORTHOGONALITY_ERROR = 1e-3
# Greatest number of column names that a message lists.
_MAX_LISTED_NAMES = 30


@dataclass(frozen=True)
class ColumnRule:
    """Rule that makes a column of the project from a column of the vendor: scale * column + offset.

    Attributes:
        name: Name of the project's column.
        content: "length", "angle", "number" or "text"; empty if the project has no such column.
        unit: Unit of the vendor's column and of the offset.
        source_column: Header of the vendor's column, or its number counted from 1.
        scale: Factor.
        offset: Summand, in `unit`.
    """

    name: str
    content: str
    unit: str
    source_column: str | int
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Rotation:
    """Notation of a rotation. Keys that the convention does not need are empty.

    Attributes:
        convention: "rotvec", "euler", "quaternion" or "matrix".
        columns: Header or number of each of the vendor's columns.
        unit: Unit of angles.
        axes: Euler axes in lower case, such as "zyx".
        frame: "intrinsic" or "extrinsic".
        order: "wxyz" or "xyzw".
    """

    convention: str
    columns: tuple[str | int, ...]
    unit: str = ""
    axes: str = ""
    frame: str = ""
    order: str = ""


@dataclass(frozen=True)
class ColumnMap:
    """Checked content of a column map.

    Attributes:
        source: Name of the map's file.
        rules: Columns of the project that are columns of the vendor.
        rotation: Notation of the rotation; None if the file has none.
        constants: Columns of the project that have one text for the whole file.
        separator: Name of the separator between cells.
        decimal: Decimal sign.
        skip: Number of lines before the header.
        header: Whether the file has a header.
        comment: Start of a comment line; empty if there are none.
        encoding: Encoding of the file.
    """

    source: str
    rules: tuple[ColumnRule, ...]
    rotation: Rotation | None
    constants: Mapping[str, str]
    separator: str
    decimal: str
    skip: int
    header: bool
    comment: str
    encoding: str


# --- reading a map ---------------------------------------------------------------------------------


def read_map(path: PathLike, contents: Mapping[str, str], joints: Sequence[str]) -> ColumnMap:
    """Read a column map and check it for a robot.

    Args:
        path: TOML file.
        contents: "length", "angle", "number" or "text" for each column that the project knows.
        joints: Names of the robot's joints in order.

    Returns:
        The map.

    Raises:
        FileFormatError: The map is invalid or contradicts itself.
        UnknownNameError: The encoding is unknown.
    """
    table = TomlTable.read(path)
    settings: dict[str, Any] = {
        "separator": table.choice("separator", _SEPARATORS, ","),
        "decimal": table.choice("decimal", (".", ","), "."),
        "skip": table.value("skip", int, 0, expected="a number of lines, as in skip = 2"),
        "header": table.value("header", bool, True),
        "comment": table.text("comment", "#"),
        "encoding": table.text("encoding", "utf-8"),
    }
    rules: list[ColumnRule] = []
    for key, prefix in (("joints", ""), ("to_joints", SECOND_PREFIX)):
        if key in table:
            rules += _joint_rules(table.table(key), [prefix + name for name in joints], contents)
    rules += _column_rules(table.table("columns"), contents)
    rotation = _rotation(table.table("rotation")) if "rotation" in table else None
    constants = _constants(table.table("constant"), contents)
    table.finish()
    if settings["separator"] == settings["decimal"]:
        raise FileFormatError(f"{table.where}: separator and decimal are both ','; change one of them")
    if settings["skip"] < 0:
        raise table.error("skip", "expected the number of lines before the header")
    try:
        codecs.lookup(settings["encoding"])
    except LookupError:
        raise UnknownNameError(
            f"{table.where}: unknown encoding {settings['encoding']!r}; expected one such as utf-8 or cp1252"
        ) from None
    names = [*(rule.name for rule in rules), *constants, *(ROTVEC if rotation else ())]
    if repeated := [name for i, name in enumerate(names) if name in names[:i]]:
        raise FileFormatError(f"{table.where}: column {repeated[0]!r} is given twice; remove one")
    return ColumnMap(table.path, tuple(rules), rotation, constants, **settings)


def _joint_rules(table: TomlTable, joints: Sequence[str], contents: Mapping[str, str]) -> list[ColumnRule]:
    order = table.array("order")
    size = len(order)
    names = table.array("names", joints, size=size)
    unit = table.get("unit", "")
    units = table.array("unit", size=size) if isinstance(unit, list) else [unit] * size
    signs = table.array("sign", [1] * size, size=size)
    offsets = table.array("offset", [0] * size, size=size)
    table.finish()
    if any(type(sign) is bool or sign not in (1, -1) for sign in signs):
        raise table.error("sign", "expected 1 or -1 for each joint")
    for offset in offsets:
        if not is_number(offset):
            raise table.error("offset", f"{offset!r} is not a number")
    return [
        _rule(table, str(name), contents, source, unit, float(sign), float(offset))
        for name, source, unit, sign, offset in zip(names, order, units, signs, offsets, strict=True)
    ]


def _column_rules(table: TomlTable, contents: Mapping[str, str]) -> list[ColumnRule]:
    rules = []
    for name in table.keys():
        entry = table.table(name)
        source = entry.get("from", expected='the header of a column, as in from = "X pos"')
        unit = entry.get("unit", "")
        scale, offset = entry.number("scale", 1.0), entry.number("offset", 0.0)
        entry.finish()
        rules.append(_rule(entry, name, contents, source, unit, scale, offset))
    return rules


def _rule(
    table: TomlTable,
    name: str,
    contents: Mapping[str, str],
    source: Any,
    unit: Any,
    scale: float,
    offset: float,
) -> ColumnRule:
    """Build the rule of a column of the project."""
    # Unknown column names are reported later, by `measurement_columns.check_columns`.
    content = contents.get(name, "")
    units = UNITS.get(content, {})
    if content and (units or unit) and unit not in units:
        choices = ", ".join(f'"{choice}"' for choice in units if choice.isascii())
        remedy = f"write unit = one of {choices}" if units else "leave the unit out"
        raise UnknownNameError(f"{table.where}: {name}: unit {unit!r}; {remedy}")
    if content == "text" and (scale, offset) != (1.0, 0.0):
        raise FileFormatError(f"{table.where}: {name}: is text; leave scale and offset out")
    return ColumnRule(name, content, unit, _source_column(table, source), scale, offset)


def _source_column(table: TomlTable, value: Any) -> str | int:
    """Check the name of a vendor's column."""
    if type(value) is str or (type(value) is int and value > 0):
        return value
    raise FileFormatError(
        f"{table.where}: {value!r} is not a column; write its header, or its number counted from 1"
    )


def _rotation(table: TomlTable) -> Rotation:
    convention = table.choice("convention", _CONVENTIONS)
    count, needed_keys = _CONVENTIONS[convention]
    values: dict[str, str] = {}
    for key, (pattern, description) in _CONVENTION_KEYS.items():
        if key not in needed_keys:
            if key in table:
                raise table.error(key, f"does not go with {convention}; leave it out")
            continue
        expected = f"{description} for {convention}"
        value = table.text(key, expected=expected)
        if not re.fullmatch(pattern, value):
            raise table.error(key, f"expected {expected}")
        values[key] = value if key == "unit" else value.lower()
    columns = table.array("columns", size=count)
    table.finish()
    return Rotation(convention, tuple(_source_column(table, name) for name in columns), **values)


def _constants(table: TomlTable, contents: Mapping[str, str]) -> dict[str, str]:
    constants: dict[str, str] = {}
    for name in (name for name, content in contents.items() if content == "text" and name in table):
        example = f'a text in quotes, as in {name} = "{{stem}}"'
        constants[name] = table.text(name, expected=example)
        if not constants[name]:
            raise table.error(name, f"expected {example}")
        if unknown := set(re.findall(r"\{([^}]*)\}", constants[name])) - set(_PATH_PARTS):
            choices = ", ".join(f"{{{part}}}" for part in _PATH_PARTS)
            raise UnknownNameError(
                f"{table.where}: {name}: unknown placeholder {{{min(unknown)}}}; choose from {choices}"
            )
    table.finish()
    return constants


# --- reading a file through a map ------------------------------------------------------------------


@dataclass(frozen=True)
class _VendorTable:
    """Cells of a vendor's file.

    Attributes:
        source: Name of the file.
        column_map: Map that it was read with.
        names: Headers of its columns, or their numbers.
        rows: Cells of each row.
        lines: File line number of each row.
        header_line: File line number of the header, or of the first row.
        comments: Text of the comment lines.
    """

    source: str
    column_map: ColumnMap
    names: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: list[int]
    header_line: int
    comments: tuple[str, ...]

    def column_index(self, name: str | int) -> int | None:
        """Return the index of a column, counted from 0; None if it is absent."""
        if isinstance(name, int):
            return name - 1 if name <= len(self.names) else None
        if self.names.count(name) > 1:
            raise FileFormatError(
                f"{self.source}:{self.header_line}: column {name!r} appears twice; give its number in the map"
            )
        return self.names.index(name) if name in self.names else None

    def missing_columns(self) -> list[str | int]:
        """Return the columns of the map that the file does not have."""
        rotation = self.column_map.rotation.columns if self.column_map.rotation else ()
        names = [*(rule.source_column for rule in self.column_map.rules), *rotation]
        return [name for name in names if self.column_index(name) is None]

    def text(self, name: str | int) -> list[str]:
        """Return the cells of a column."""
        index = self.column_index(name)
        assert index is not None
        return [row[index] for row in self.rows]

    def numbers(self, name: str | int) -> tuple[list[str], Array]:
        """Return the cells of a column with decimal points, and its numbers, shape (m,)."""
        cells, decimal = self.text(name), self.column_map.decimal
        other = "." if decimal == "," else ","
        for cell, line in zip(cells, self.lines, strict=True):
            if other in cell:
                raise FileFormatError(
                    f"{self.source}:{line}: column {name!r}: {cell!r} where the decimal sign is {decimal!r}; "
                    "write it with that sign, and without a sign for thousands"
                )
        cells = [cell.replace(decimal, ".") for cell in cells]
        table = CsvTable(self.source, (), {}, [[cell] for cell in cells], self.lines, self.header_line)
        return cells, table.numbers(Column(str(name), "", 0))


def read_mapped_table(path: PathLike, column_map: ColumnMap, known: Set[str]) -> CsvTable:
    """Read a vendor's file as a table with the project's own columns.

    A file whose header has the project's columns only, and lacks columns of the map, is read as it is.

    Args:
        path: The file.
        column_map: Map of its columns.
        known: Columns that a file of the project can have.

    Returns:
        Table with the columns of the map.

    Raises:
        FileFormatError: A column of the map is missing.
    """
    if _is_native(path, known) and not _matches(path, column_map):
        return read_csv_table(path)
    vendor = _read_vendor_table(path, column_map)
    if missing := vendor.missing_columns():
        raise FileFormatError(
            f"{path}:{vendor.header_line}: no column {missing[0]!r}, which {column_map.source} names; with "
            f"separator {column_map.separator!r} there are "
            f"{', '.join(map(repr, vendor.names[:_MAX_LISTED_NAMES]))}"
        )
    # Unit and cells by column.
    columns = {rule.name: (rule.unit, _apply_rule(vendor, rule)) for rule in column_map.rules}
    if column_map.rotation:
        columns |= _rotation_columns(vendor, column_map.rotation)
    for name, text in column_map.constants.items():
        columns[name] = "", [_fill_placeholders(text, path)] * len(vendor.rows)
    return CsvTable(
        vendor.source,
        vendor.comments,
        {name: Column(name, unit, i) for i, (name, (unit, _)) in enumerate(columns.items())},
        [list(row) for row in zip(*(cells for _, cells in columns.values()), strict=True)],
        vendor.lines,
        vendor.header_line,
    )


def _fill_placeholders(text: str, path: PathLike) -> str:
    """Replace {file}, {stem} and {parent}; braces in the path itself stay, other than with str.format."""
    absolute = Path(path).absolute()
    values = absolute.name, absolute.stem, absolute.parent.name
    parts: dict[str, str] = dict(zip(_PATH_PARTS, values, strict=True))
    pattern = "|".join(f"{{{part}}}" for part in _PATH_PARTS)
    return re.sub(pattern, lambda match: parts[match[0][1:-1]], text)


def _read_vendor_table(path: PathLike, column_map: ColumnMap) -> _VendorTable:
    """Split the lines of a vendor's file into cells."""
    comments: list[str] = []
    content: list[tuple[int, list[str]]] = []
    separator = _SEPARATORS[column_map.separator]
    for line_number, line in enumerate(read_text(path, column_map.encoding).splitlines(), 1):
        if line_number <= column_map.skip or not line.strip(BLANK_CHARACTERS):
            continue
        if column_map.comment and line.lstrip().startswith(column_map.comment):
            comments.append(line.lstrip()[len(column_map.comment) :].strip())
            continue
        try:
            # Line by line, so that an unbalanced quote does not extend over the following lines.
            cells = line.split() if separator is None else next(csv.reader([line], delimiter=separator))
        except csv.Error as error:
            raise FileFormatError(f"{path}:{line_number}: {error}; correct this line") from error
        content.append((line_number, [cell.strip() for cell in cells]))
    if len(content) <= column_map.header:
        raise FileFormatError(f"{path}: no rows with measured values; add at least one")
    header_line, names = content[0]
    if not column_map.header:
        names = [str(i) for i in range(1, len(names) + 1)]
    rows = content[column_map.header :]
    for line_number, cells in rows:
        # Separators at the end of a line do not make a column.
        if len(cells) < len(names) or any(cells[len(names) :]):
            raise FileFormatError(
                f"{path}:{line_number}: {len(cells)} values for {len(names)} columns; correct the row, or "
                f"separator and decimal in {column_map.source}"
            )
    return _VendorTable(
        str(path),
        column_map,
        names,
        [cells for _, cells in rows],
        [line_number for line_number, _ in rows],
        header_line,
        tuple(comments),
    )


def _is_native(path: PathLike, known: Set[str]) -> bool:
    """Return whether the header of a file is the project's own."""
    try:
        return set(read_csv_table(path).columns) <= known
    except DhcalError:
        return False


def _matches(path: PathLike, column_map: ColumnMap) -> bool:
    """Return whether a file has a header with all columns of a map."""
    try:
        return column_map.header and not _read_vendor_table(path, column_map).missing_columns()
    except DhcalError:
        return False


def _apply_rule(vendor: _VendorTable, rule: ColumnRule) -> list[str]:
    """Return the cells of a column of the project; digits stay as they are if nothing is computed."""
    if rule.content == "text":
        return vendor.text(rule.source_column)
    cells, values = vendor.numbers(rule.source_column)
    if (rule.scale, rule.offset) == (1.0, 0.0):
        return cells
    return [repr(value) for value in (rule.scale * values + rule.offset).tolist()]


def _rotation_columns(vendor: _VendorTable, notation: Rotation) -> dict[str, tuple[str, list[str]]]:
    """Return unit and cells of each column of the project that holds the rotation."""
    pairs = [vendor.numbers(name) for name in notation.columns]
    if notation.convention in ("rotvec", "quaternion"):
        names = ROTVEC if notation.convention == "rotvec" else [f"q{letter}" for letter in notation.order]
        return {name: (notation.unit, cells) for name, (cells, _) in zip(names, pairs, strict=True)}
    values = np.stack([numbers for _, numbers in pairs], -1)
    if notation.convention == "euler":
        rotations = euler_to_matrix(values / ANGLES[notation.unit], notation.axes, notation.frame)
    else:
        rotations = _orthonormalized(values.reshape(-1, 3, 3), vendor)
    components = se3.log3(rotations).T.tolist()
    return {name: ("rad", [*map(repr, column)]) for name, column in zip(ROTVEC, components, strict=True)}


def euler_to_matrix(angles: Array, axes: str, frame: str) -> Array:
    """Convert Euler angles to rotation matrices.

    Args:
        angles: Angles about the three axes in their order, shape (m, 3) [rad].
        axes: Three letters such as "xyz".
        frame: "intrinsic" for rotations about the axes as rotated so far, "extrinsic" for fixed axes.

    Returns:
        Rotation matrices, shape (m, 3, 3).
    """
    first, second, third = (
        se3.exp3(angles[:, i, None] * np.eye(3)["xyz".index(axis)]) for i, axis in enumerate(axes)
    )
    return first @ second @ third if frame == "intrinsic" else third @ second @ first


def _orthonormalized(matrices: Array, vendor: _VendorTable) -> Array:
    """Return the rotations nearest to matrices, shape (m, 3, 3)."""
    u, s, vt = np.linalg.svd(matrices)
    error = np.abs(s - 1).max(-1) + (np.linalg.det(matrices) < 0)
    if (wrong := np.flatnonzero(error > _MAX_ORTHOGONALITY_ERROR)).size:
        raise FileFormatError(
            f"{vendor.source}:{vendor.lines[wrong[0]]}: the nine numbers are not a rotation matrix "
            f"(error {error[wrong[0]]:.2g}); "
            "write them row by row, right-handed, with an error below one thousandth"
        )
    return u @ vt
