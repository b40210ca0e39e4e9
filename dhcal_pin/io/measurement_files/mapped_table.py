"""Files of other makers, read through a column map as tables with the project's own columns."""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import se3
from ..._typing import Array, PathLike
from ...exceptions import DhcalError, FileFormatError
from ...measurements.euler_angles import EulerAngles, angles_to_matrix, euler_notation
from ...units import ANGLES, column_header
from ..tables import DataTable, TextLayout, read_table
from ..tables.data_frame import is_data_frame
from .column_map import PATH_PARTS, ColumnMap, ColumnRule, Rotation
from .columns import ROTVEC
from .map_proposal import skip_line

# Largest deviation of a matrix' singular values from 1. A larger one is an error, not rounding.
_MAX_ORTHOGONALITY_ERROR = 1e-3
# Greatest number of column names that a message lists.
_MAX_LISTED_NAMES = 30


def _find_columns(table: DataTable, column_map: ColumnMap) -> dict[str | int, int | None]:
    """Return the index of each column that a map names, counted from 0; None if the file lacks it."""
    found: dict[str | int, int | None] = {}
    for name in column_map.source_columns:
        if isinstance(name, int):
            found[name] = name - 1 if name <= len(table.headers) else None
        elif table.headers.count(name) > 1:
            raise FileFormatError(
                f"{table.header_location}: column {name!r} appears twice; give its number in the map"
            )
        else:
            found[name] = table.headers.index(name) if name in table.headers else None
    return found


def read_mapped_table(
    source: PathLike | Any, column_map: ColumnMap, known: Set[str], sheet: str
) -> DataTable:
    """Read a file of another maker with the project's columns; one that has them already stays as it is."""
    named = frozenset(name for name in column_map.source_columns if isinstance(name, str))
    column_map = replace(column_map, layout=replace(column_map.layout, sheet=sheet, names=named))
    native = TextLayout(sheet=sheet, names=known)
    if _is_native(source, native, known) and not _matches(source, column_map):
        return read_table(source, native)
    table = read_table(source, column_map.layout)
    rotation, euler_angles = column_map.rotation, None
    with table.notes_in_errors():
        indices = _find_columns(table, column_map)
        if missing := [name for name, index in indices.items() if index is None]:
            raise FileFormatError(
                f"{table.header_location}: no column {missing[0]!r}, which {column_map.source} names; the "
                f"file ({table.description}) has {', '.join(map(repr, table.headers[:_MAX_LISTED_NAMES]))}"
                f"{_skip_hint(table, missing[0])}"
            )
        index = {name: found for name, found in indices.items() if found is not None}
        numbers = [rule.source_column for rule in column_map.rules if rule.content != "text"]
        turns = [index[name] for name in rotation.columns] if rotation else []
        table = table.without_bad_rows([*(index[name] for name in numbers), *turns])
        columns = {
            column_header(rule.name, rule.unit): _apply_rule(table, index[rule.source_column], rule)
            for rule in column_map.rules
        }
        if rotation:
            values = [table.values(i) for i in turns]
            euler_angles = _read_euler_angles(table, values, rotation)
            columns |= _rotation_columns(table, values, rotation, euler_angles)
    for name, text in column_map.constants.items():
        columns[name] = [_fill_placeholders(text, source)] * len(table.lines)
    return DataTable.from_columns(
        table.source,
        columns,
        table.lines,
        header_line=table.header_line,
        comments=table.comments,
        bad_rows=table.bad_rows,
        description=table.description,
        notes=table.notes,
        euler_angles=euler_angles,
    )


def _skip_hint(table: DataTable, name: str | int) -> str:
    """Return the remedy if a column is in a header below lines of titles; empty otherwise."""
    below = table.below_titles
    return (
        f"; {skip_line(below)} in the map reads the header in line {below.header_line}"
        if (below is not None and name in below.headers)
        else ""
    )


def _fill_placeholders(text: str, source: PathLike | Any) -> str:
    """Replace {file}, {stem} and {parent}; braces in the path itself stay, other than with str.format."""
    absolute = Path("DataFrame" if is_data_frame(source) else source).absolute()
    values = absolute.name, absolute.stem, absolute.parent.name
    parts: dict[str, str] = dict(zip(PATH_PARTS, values, strict=True))
    pattern = "|".join(f"{{{part}}}" for part in PATH_PARTS)
    return re.sub(pattern, lambda match: parts[match[0][1:-1]], text)


def _is_native(source: PathLike | Any, layout: TextLayout, known: Set[str]) -> bool:
    """Return whether the header of a file is the project's own."""
    try:
        return set(read_table(source, layout).columns) <= known
    except DhcalError:
        return False


def _matches(source: PathLike | Any, column_map: ColumnMap) -> bool:
    """Return whether a file has a header with all columns of a map."""
    if not column_map.layout.has_header:
        return False
    try:
        return None not in _find_columns(read_table(source, column_map.layout), column_map).values()
    except DhcalError:
        return False


def _apply_rule(table: DataTable, index: int, rule: ColumnRule) -> Array | list[str]:
    """Return the values of a column of the project, (m,), from that of the vendor with an index."""
    if rule.content == "text":
        return [row[index].strip() for row in table.cells]
    values = table.values(index)
    return values if (rule.scale, rule.offset) == (1.0, 0.0) else rule.scale * values + rule.offset


def _read_euler_angles(table: DataTable, columns: list[Array], notation: Rotation) -> EulerAngles | None:
    """Return the Euler angles of columns (m,); NaN for matrices, None for vectors and quaternions."""
    if notation.convention in ("rotvec", "quaternion"):
        return None
    lines = np.array(table.lines)
    if notation.convention == "matrix":
        return EulerAngles("", lines, np.full((len(lines), 3), np.nan))
    angles = np.stack(columns, -1) / ANGLES[notation.unit]
    return EulerAngles(euler_notation(notation.axes, notation.frame), lines, angles)


def _rotation_columns(
    table: DataTable, columns: list[Array], notation: Rotation, euler: EulerAngles | None
) -> dict[str, Array | list[str]]:
    """Return the values (m,) of each column of the project that holds the rotation, by header cell."""
    if notation.convention in ("rotvec", "quaternion"):
        names = ROTVEC if notation.convention == "rotvec" else [f"q{letter}" for letter in notation.order]
        return {
            column_header(name, notation.unit): values for name, values in zip(names, columns, strict=True)
        }
    if euler is not None and euler.notation:
        rotations = angles_to_matrix(euler.angles, euler.notation)
    else:
        rotations = _orthonormalized(np.stack(columns, -1).reshape(-1, 3, 3), table)
    components = np.ascontiguousarray(se3.log3(rotations).T)
    return {column_header(name, "rad"): column for name, column in zip(ROTVEC, components, strict=True)}


def _orthonormalized(matrices: Array, table: DataTable) -> Array:
    """Return the rotations nearest to matrices, shape (m, 3, 3)."""
    u, s, vt = np.linalg.svd(matrices)
    error = np.abs(s - 1).max(-1) + (np.linalg.det(matrices) < 0)
    if (wrong := np.flatnonzero(error > _MAX_ORTHOGONALITY_ERROR)).size:
        raise FileFormatError(
            f"{table.source}:{table.lines[wrong[0]]}: the nine numbers are not a rotation matrix "
            f"(error {error[wrong[0]]:.2g}); "
            "write them row by row, right-handed, with an error below one thousandth"
        )
    return u @ vt
