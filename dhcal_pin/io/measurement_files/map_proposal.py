"""Proposal of a column map for a file whose columns have no names, or names of another program.

The proposal is a guess. Joints and coordinates are taken by their names in the header: headers that are the
names of the joints or contain them, or n headers that differ by a number only, such as `A1` to `A6`. Without
such names the first n columns of numbers are the joints, the next three the position, and so on. Times and
counters of rows are left out. Units that the header does not name follow from the size of the numbers.

A header below lines of titles is found, and the lines above it are skipped.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..._typing import Array
from ...exceptions import FileFormatError
from ...formatting import join_names, list_first
from ...messages import quote
from ...robot.chain import Chain
from ...units import ANGLES, LENGTHS
from ..tables import DataTable
from .columns import (
    EULER_NOTATIONS,
    KAWASAKI,
    VALUE_COLUMNS,
    counts_rows,
    euler_columns,
    has_titles,
    joint_units,
)
from .counts import TICKS

# Joint positions beyond this are degrees [rad]; lengths beyond this are millimetres [m].
_MAX_RADIANS, _MAX_METRES = 2 * np.pi + 0.1, 20.0
# Largest deviation of a quaternion's norm from 1.
_MAX_NORM_ERROR = 0.01
# Units in the headers of other programs, such as "A1 (deg)" or "X_mm".
_HEADER_UNITS = {
    "deg": r"deg|°|º|grad\b",
    "rad": r"\brad",
    "mm": r"(?<![a-z])mm\b",
    "m": r"(?<![a-z])m\b|(?<![a-z])meter",
}
# Image coordinates: a file with these has no measured positions.
_IMAGE_COLUMNS = frozenset(("u", "v"))
# Headers of coordinates that are not measured, of rotations, and of other quantities of a joint.
_NOT_MEASURED = r"std|sigma|goal|target|command|nominal|soll"
_NOT_POSITION = (
    rf"vel|speed|acc|effort|torque|force|moment|current|temp|tcp|(?<![a-z])qd+(?![a-z])|{_NOT_MEASURED}"
)
# Rotation vectors of OpenCV have headers such as `rvx`, `rvec_x` and `rvec[0]`.
_ROTATION = (
    r"(?<![a-z])(?:q[wxyz0-3]|r[xyz]|r(?:v|vec|odrigues)[_. \[]?[xyz0-3]|[abcwpr]|roll|pitch|yaw|rot.*|"
    r"orientation.*)(?![a-z])"
)
# Headers of times, and of counters of rows.
_TIME = r"time|stamp|zeit|datum|(?<![a-z])(?:n?secs?|date)(?![a-z])"
_COUNTER = (
    r"#|(?<![a-z])(?:nr|no|num|number|nummer|idx?|index|row|line|zeile|sample|seq|count|counter|pt|point|"
    r"punkt|messpunkt|pose)(?![a-z])"
)
# Increasing numbers beyond this are times; no joint position and no length of a robot is as large.
_MAX_POSITION = 1e6


def propose_map(table: DataTable, chain: Chain) -> list[str]:
    """Propose the lines of a column map."""
    if table.below_titles is not None and has_titles(table, chain):
        lines = propose_map(table.below_titles, chain)
        return [skip_line(table.below_titles), *lines] if lines else []
    numeric = _numeric_columns(table)
    columns = _without_counters(table, numeric, chain.n_joints)
    joints = _choose_joints(table, chain, numeric) or list(columns)[: chain.n_joints]
    if (
        len(joints) < chain.n_joints
        or _has_other_joints(table, chain, numeric)
        or _suffixed_joint(table, chain)
    ):
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


def skip_line(below: DataTable) -> str:
    """Return the line of a map that skips the titles above a table."""
    return f"skip = {below.header_line - 1}"


def _choose_joints(table: DataTable, chain: Chain, columns: Iterable[int]) -> list[int]:
    """Return the columns of the joints by the names in the header, nothing without such names."""
    if table.has_numbers_as_header:
        return []
    if table.columns.keys() >= set(chain.joint_names):
        return [table.columns[name].index for name in chain.joint_names]
    return _joints_in_headers(table, chain, columns) or _numbered_joints(table, chain, columns)


def _joints_in_headers(table: DataTable, chain: Chain, columns: Iterable[int]) -> list[int]:
    """Return the columns of numbers whose headers contain the names of joints, such as topics of ROS."""
    headers = {i: table.headers[i].lower() for i in columns}
    found = []
    for joint in chain.joint_names:
        name = rf"(?<![a-z0-9]){re.escape(joint.lower())}(?![a-z0-9])"
        matches = [i for i, header in headers.items() if re.search(name, header)]
        positions = [i for i in matches if "position" in headers[i]] or matches
        others = [i for i in positions if not re.search(_NOT_POSITION, re.sub(name, "", headers[i]))]
        if len(others) != 1:
            return []
        found += others
    return found


def _numbered_joints(table: DataTable, chain: Chain, columns: Iterable[int]) -> list[int]:
    """Return the first n columns of numbers whose headers differ only by the number of the joint."""
    groups: dict[tuple[str, str], dict[int, int]] = {}
    for i in columns:
        header = table.headers[i].lower()
        match = re.fullmatch(r"(.*?)(\d{1,4})(\D*)", header)
        is_position = not re.search(_NOT_POSITION, header) and table.headers[i] not in VALUE_COLUMNS
        if match and is_position and not _names_length(table, chain, i):
            groups.setdefault((match[1], match[3]), {})[int(match[2])] = i
    n = chain.n_joints
    for group in groups.values():
        if n > 1 and sorted(group) in ([*range(n)], [*range(1, n + 1)]):
            names = _names_beside(table, chain, group)
            return [names[name] for name in chain.joint_names] if names else [group[k] for k in sorted(group)]
    return []


def _names_length(table: DataTable, chain: Chain, index: int) -> bool:
    """Return whether a header names the unit of a length, or a measured length, and the robot has no rail."""
    name, _, unit = table.headers[index].partition("[")
    return not any(chain.is_prismatic) and (name.strip() in VALUE_COLUMNS or unit.rstrip(" ]") in LENGTHS)


def _names_beside(table: DataTable, chain: Chain, group: Mapping[int, int]) -> dict[str, int]:
    """Return the columns of numbered joints by the names in columns of texts, such as `name[0]`."""
    names: dict[str, int] = {}
    for i, header in enumerate(table.headers):
        match = re.fullmatch(r".*?(\d{1,4})\D*", header)
        if match and int(match[1]) in group and table.cells[0][i].strip() in chain.joint_names:
            texts = {row[i].strip() for row in table.cells}
            names |= dict.fromkeys(texts, group[int(match[1])]) if len(texts) == 1 else {}
    return names if names.keys() == set(chain.joint_names) and len({*names.values()}) == len(names) else {}


def _has_other_joints(table: DataTable, chain: Chain, columns: Iterable[int]) -> bool:
    """Return whether a file has more angles than the robot joints, so that it is that of another one."""
    if table.has_numbers_as_header or _choose_joints(table, chain, columns):
        return False
    angles = [
        name
        for name, column in table.columns.items()
        if column.unit in ANGLES and name not in VALUE_COLUMNS and not re.search(_ROTATION, name.lower())
    ]
    return len(angles) > chain.n_joints


def _without_counters(table: DataTable, columns: Mapping[int, Array], n_joints: int) -> Mapping[int, Array]:
    """Return the columns of numbers without times and counters, if enough others are left for the joints."""
    kept = {i: values for i, values in columns.items() if not _is_time_or_counter(table, i, values)}
    return kept if len(kept) >= n_joints else columns


def _is_time_or_counter(table: DataTable, index: int, values: Array) -> bool:
    """Return whether a column (m,) has times, or counts the rows."""
    header = "" if table.has_numbers_as_header else table.headers[index].lower()
    if re.search(_TIME, header):
        return True
    values = values[np.isfinite(values)]
    steps = np.diff(values)
    if len(values) < 3 or not np.all(steps > 0):
        return False
    if values[-1] > _MAX_POSITION or counts_rows(values):
        return True
    are_integers = bool(np.all(values == np.round(values)))
    is_first = index == 0 and np.all(steps == steps[0])
    return are_integers and bool(is_first or re.search(_COUNTER, header))


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
    lengths = [i for i in others if not (table.units and table.units[i] in ANGLES)]
    return lengths[: 3 if len(lengths) >= 3 else 1]


def _is_axis(header: str, axis: str) -> bool:
    """Return whether a header in lower case names a measured coordinate along an axis."""
    is_named = re.search(rf"(?<![a-z]){axis}(?![a-z])", header)
    others = rf"orientation|rotation|quat|rv(?:ec)?_|rodrigues|{_NOT_MEASURED}"
    return bool(is_named) and not re.search(others, header)


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
        is_scalar_last = bool(re.search(r"w\W*$", table.headers[candidates[3]].lower()))
        return [
            f'rotation = {{convention = "quaternion", order = "{"xyzw" if is_scalar_last else "wxyz"}", '
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
    if table.below_titles is not None and has_titles(table, chain):
        return (
            f"{where}: no names of columns in this line; they seem to be in line "
            f"{table.below_titles.header_line}; remove the lines above it"
        )
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
    headers = [quote(header) for header in table.written_headers if header]
    expected = f"a joint of this robot ({', '.join(chain.joint_names)})"
    if set(chain.joint_names) & set(table.columns):
        expected = "a measured value, such as x[mm]"
    problem = f"{where}: no column is {expected}; the columns are {list_first(headers)}{_text_axis(table)}"
    if _has_other_joints(table, chain, _numeric_columns(table)):
        problem += "; they have more angles than the robot has joints: give the robot that was measured"
        return f"{problem}, rename them"
    return f"{problem}; rename them"


def _text_axis(table: DataTable) -> str:
    """Return the clause about the first coordinate whose column has no numbers; empty without it."""
    for i, header in enumerate(table.headers):
        if any(_is_axis(header.lower(), axis) for axis in "xyz") and not np.isfinite(table.values(i)).any():
            text = next((row[i].strip() for row in table.cells if row[i].strip()), "")
            return f"; {table.bad_number(text, i)}" if text else ""
    return ""


def _suffixed_joint(table: DataTable, chain: Chain) -> tuple[str, str] | None:
    """Return the first joint and header of its name with a suffix, such as LeRobot's `shoulder_pan.pos`."""
    return next(
        (
            (joint, header)
            for joint in chain.joint_names
            for header in table.headers
            if re.fullmatch(rf"{re.escape(joint)}[.:/](?!position$|velocity$|effort$)\w+", header.strip())
        ),
        None,
    )


def missing_header_error(table: DataTable, chain: Chain) -> FileFormatError:
    """Build the error of a file that needs a column map, see `columns.needs_column_map`."""
    problem, lines = header_problem(table, chain), propose_map(table, chain)
    if not lines:
        return FileFormatError(f"{problem}, or describe the columns in a column map (--columns)")
    return FileFormatError(
        f"{problem}, or write a column map (--columns MAP.toml) with the lines "
        f"{', '.join(f'`{line}`' for line in lines)} and check its columns and units"
    )


def _numeric_columns(table: DataTable) -> dict[int, Array]:
    """Return the columns of numbers by index; a first row of numbers in place of the header is left out."""
    columns = {i: table.values(i) for i in range(len(table.headers))}
    return {i: values for i, values in columns.items() if 2 * np.isfinite(values).sum() > len(values)}


def _are_quaternions(values: Array) -> bool:
    """Return whether four columns (4, m) are unit quaternions."""
    return bool(np.nanmax(np.abs(np.linalg.norm(values, axis=0) - 1), initial=0.0) < _MAX_NORM_ERROR)


def _unit(table: DataTable, index: int, values: Array, *, is_length: bool) -> str:
    """Return the unit that a header names, or that the size of the numbers (…, m) suggests."""
    header = "" if table.has_numbers_as_header else table.written_headers[index].lower()
    written = re.search(r"\[(\w+)\]", header)
    for text in (written[1] if written else "", table.units[index] if table.units else ""):
        if text in (LENGTHS if is_length else (*ANGLES, TICKS)):
            return text
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
    header = table.written_headers[index]
    is_name = bool(header) and table.written_headers.count(header) == 1 and not table.has_numbers_as_header
    return json.dumps(header, ensure_ascii=False) if is_name else str(index + 1)
