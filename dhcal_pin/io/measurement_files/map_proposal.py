"""Proposal of a column map for a file whose columns have no names, or names of another program.

The proposal is a guess. Joints and coordinates are taken by their names in the header. Without such names the
first n columns of numbers are the joints, the next three the position, and so on. Units that the header does
not name follow from the size of the numbers.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

import numpy as np

from ..._typing import Array
from ...exceptions import FileFormatError
from ...formatting import join_names
from ...messages import quote
from ...robot.chain import Chain
from ...units import ANGLES, LENGTHS
from ..tables import DataTable
from .columns import EULER_NOTATIONS, KAWASAKI, VALUE_COLUMNS, euler_columns, joint_units

# Joint positions beyond this are degrees [rad]; lengths beyond this are millimetres [m].
_MAX_RADIANS, _MAX_METRES = 2 * np.pi + 0.1, 20.0
# Largest deviation of a quaternion's norm from 1.
_MAX_NORM_ERROR = 0.01
# Units in the headers of other programs, such as "A1 (deg)" or "X_mm".
_HEADER_UNITS = {
    "deg": r"deg|°|grad\b",
    "rad": r"\brad",
    "mm": r"(?<![a-z])mm\b",
    "m": r"(?<![a-z])m\b|(?<![a-z])meter",
}
# Greatest number of column names that a message lists.
_MAX_LISTED_NAMES = 12
# Image coordinates: a file with these has no measured positions.
_IMAGE_COLUMNS = frozenset(("u", "v"))
# Headers of coordinates that are not measured, and of rotations.
_NOT_MEASURED = r"std|sigma|goal|target|command|nominal|soll"
_ROTATION = r"(?<![a-z])(?:q[wxyz0-3]|r[xyz]|[abcwpr]|roll|pitch|yaw|rot.*)(?![a-z])"


def propose_map(table: DataTable, chain: Chain) -> list[str]:
    """Propose the lines of a column map."""
    columns = _numeric_columns(table)
    joints = _choose_joints(table, chain, columns)
    if not joints or _suffixed_joint(table, chain):
        return []
    lines = ["header = false"] if table.has_numbers_as_header else []
    lines.append(f"joints = {{order = {_names(table, joints)}, unit = {_joint_unit(table, chain, joints)}}}")
    others = [i for i in columns if i not in joints]
    has_images = not table.has_numbers_as_header and _IMAGE_COLUMNS <= table.columns.keys()
    position = [] if has_images else _choose_position(table, others)
    names = ("length",) if len(position) == 1 else "xyz"
    if position:
        unit = _unit(table, position[0], np.stack([columns[i] for i in position]), is_length=True)
        entries = (
            f'{name} = {{from = {_name(table, i)}, unit = "{unit}"}}'
            for name, i in zip(names, position, strict=False)
        )
        lines.append(f"columns = {{{', '.join(entries)}}}")
    if len(position) == 3:
        lines += _rotation_line(table, position, [i for i in others if i > position[-1]], columns)
    return lines


def _choose_joints(table: DataTable, chain: Chain, columns: Mapping[int, Array]) -> list[int]:
    """Return the columns of the joints: those of their names, otherwise the first n ones of numbers."""
    named = {} if table.has_numbers_as_header else table.columns
    if named.keys() >= set(chain.joint_names):
        return [named[name].index for name in chain.joint_names]
    indices, n = list(columns), chain.n_joints
    angles = [one for name, one in named.items() if one.unit in ANGLES and name not in VALUE_COLUMNS]
    if len(angles) > n:
        return []  # The file has the joints of another robot.
    # A counter of the rows is no joint.
    if len(indices) > n + 3 and _counts_rows(columns[indices[0]]):
        del indices[0]
    return indices[:n] if len(indices) >= n else []


def _joint_unit(table: DataTable, chain: Chain, joints: Sequence[int]) -> str:
    """Return the unit of all joints, or a list of units, as TOML."""
    units = [
        _unit(table, i, table.values(i), is_length=joint_units(chain, name) is LENGTHS)
        for i, name in zip(joints, chain.joint_names, strict=True)
    ]
    # One unit for all revolute joints: a joint that hardly moves does not show its own.
    if "deg" in units:
        units = ["deg" if unit == "rad" else unit for unit in units]
    return json.dumps(units[0] if len(set(units)) == 1 else units)


def _choose_position(table: DataTable, others: Sequence[int]) -> list[int]:
    """Return the columns of x, y and z by their headers, otherwise the first three, or one length."""
    if not table.has_numbers_as_header:
        found = [
            next((i for i in others if _is_axis(table.headers[i].lower(), axis)), None) for axis in "xyz"
        ]
        if None not in found:
            return [i for i in found if i is not None]
    return list(others[: 3 if len(others) >= 3 else 1])


def _is_axis(header: str, axis: str) -> bool:
    """Return whether a header in lower case names a measured coordinate along an axis."""
    return bool(re.search(rf"(?<![a-z]){axis}(?![a-z])", header)) and not re.search(_NOT_MEASURED, header)


def _rotation_line(
    table: DataTable, position: Sequence[int], turns: Sequence[int], columns: Mapping[int, Array]
) -> list[str]:
    """Return the line of the rotation, if columns for one follow the position."""
    if table.has_numbers_as_header:
        candidates = list(turns)
    elif _first_words(table, (*position, *turns[:3])) == ("x", "y", "z", *KAWASAKI):
        candidates = list(turns[:3])
    else:
        candidates = [i for i in turns if re.search(_ROTATION, table.headers[i].lower())]
        candidates = [i for i in candidates if not re.search(_NOT_MEASURED, table.headers[i].lower())]
    if len(candidates) >= 4 and _are_quaternions(np.stack([columns[i] for i in candidates[:4]])):
        return [
            f'rotation = {{convention = "quaternion", order = "wxyz", '
            f"columns = {_names(table, candidates[:4])}}}"
        ]
    if len(candidates) < 3:
        return []
    unit = _unit(table, candidates[0], np.stack([columns[i] for i in candidates[:3]]), is_length=False)
    names, words = _names(table, candidates[:3]), _first_words(table, candidates[:3])
    if unit == "rad" and words not in EULER_NOTATIONS:
        return [f'rotation = {{convention = "rotvec", columns = {names}, unit = "rad"}}']
    axes, frame = EULER_NOTATIONS.get(words, ("XYZ", "intrinsic"))
    return [
        f'rotation = {{convention = "euler", axes = "{axes}", frame = "{frame}", columns = {names}, '
        f'unit = "{unit}"}}'
    ]


def _first_words(table: DataTable, indices: Sequence[int]) -> tuple[str, ...]:
    """Return the headers of columns in lower case without units."""
    return tuple(str(re.split(r"[\s\[(]", table.headers[i].strip().lower())[0]) for i in indices)


def header_problem(table: DataTable, chain: Chain) -> str:
    """Say what is wrong with the header of a file that needs a column map, see `columns.needs_column_map`."""
    where = table.header_location
    if table.has_numbers_as_header:
        example = f"{chain.joint_names[0]}[deg],…,x[mm],y[mm],z[mm]"
        return f"{where}: numbers where the header must be; write one such as {example}"
    if suffixed := _suffixed_joint(table, chain):
        joint, header = suffixed
        return (
            f"{where}: column {quote(header)} is not understood; expected '{joint}[ticks]' for the counts "
            f"that the servo reports, with --servos FILE, or '{joint}[deg]' or '{joint}[rad]'; rename the "
            "columns of all joints"
        )
    if angles := euler_columns(table, chain):
        return (
            f"{where}: {join_names([*map(quote, angles)])} are Euler angles without their axes; remove them"
        )
    headers = [quote(header) for header in table.headers if header]
    n_more = len(headers) - _MAX_LISTED_NAMES
    listed = ", ".join(headers[:_MAX_LISTED_NAMES]) + (f" and {n_more} more" if n_more > 0 else "")
    expected = f"a joint of this robot ({', '.join(chain.joint_names)})"
    if set(chain.joint_names) & set(table.columns):
        expected = "a measured value, such as x[mm]"
    problem = f"{where}: no column is {expected}; the columns are {listed}"
    return f"{problem}; state the robot of this file, or rename them"


def _suffixed_joint(table: DataTable, chain: Chain) -> tuple[str, str] | None:
    """Return the first joint and header of its name with a suffix, such as LeRobot's `shoulder_pan.pos`."""
    return next(
        (
            (joint, header)
            for joint in chain.joint_names
            for header in table.headers
            if re.fullmatch(rf"{re.escape(joint)}[.:/]\w+", header.strip())
        ),
        None,
    )


def missing_header_error(table: DataTable, chain: Chain) -> FileFormatError:
    """Build the error of a file that needs a column map, see `columns.needs_column_map`."""
    problem, lines = header_problem(table, chain), propose_map(table, chain)
    if not lines:
        return FileFormatError(f"{problem}, or describe them in a column map (--columns)")
    return FileFormatError(
        f"{problem}, or write a column map (--columns MAP.toml) with the lines "
        f"{', '.join(f'`{line}`' for line in lines)} and check its columns and units"
    )


def _numeric_columns(table: DataTable) -> dict[int, Array]:
    """Return the columns of numbers by index; a first row of numbers in place of the header is left out."""
    columns = {i: table.values(i) for i in range(len(table.headers))}
    return {i: values for i, values in columns.items() if 2 * np.isfinite(values).sum() > len(values)}


def _counts_rows(values: Array) -> bool:
    """Return whether a column (m,) counts its rows."""
    return len(values) > 2 and bool(np.all(np.diff(values) == 1))


def _are_quaternions(values: Array) -> bool:
    """Return whether four columns (4, m) are unit quaternions."""
    return bool(np.nanmax(np.abs(np.linalg.norm(values, axis=0) - 1), initial=0.0) < _MAX_NORM_ERROR)


def _unit(table: DataTable, index: int, values: Array, *, is_length: bool) -> str:
    """Return the unit that a header names, or that the size of the numbers (…, m) suggests."""
    header = "" if table.has_numbers_as_header else table.headers[index].lower()
    written = re.search(r"\[(\w+)\]", header)
    if written and written[1] in (LENGTHS if is_length else ANGLES):
        return written[1]
    for unit in ("mm", "m") if is_length else ("deg", "rad"):
        if re.search(_HEADER_UNITS[unit], header):
            return unit
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if is_length:
        return "mm" if largest > _MAX_METRES else "m"
    return "deg" if largest > _MAX_RADIANS else "rad"


def _names(table: DataTable, indices: Sequence[int]) -> str:
    """Return how a map names columns, as a list."""
    return f"[{', '.join(_name(table, i) for i in indices)}]"


def _name(table: DataTable, index: int) -> str:
    """Return how a map names a column: by its number without a header, otherwise by its header."""
    header = table.headers[index]
    is_name = bool(header) and table.headers.count(header) == 1 and not table.has_numbers_as_header
    return json.dumps(header, ensure_ascii=False) if is_name else str(index + 1)
