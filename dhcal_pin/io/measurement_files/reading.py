"""Reading of measurement files: tables of joint positions and measured values.

The joints are columns under their URDF names, and the measured values are columns whose names select the
measurement kind (see `columns`). Image coordinates may have the pose of the tip in place of the joints (see
`tool_poses`). Every length and angle carries its unit in brackets. A table can come from a
text file, an Excel workbook, a Parquet file or a data frame (see the package `tables`). Files of other makers
are read through a column map (see `column_map`).

Errors in the content of a file are `FileFormatError` or, for unknown columns and units, `UnknownNameError`.
Their messages name the file, the line as counted by a text editor, and the column. `Measurement.rows` has
the same line numbers.

Shapes: m rows of data, n joints.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array, PathLike
from ...exceptions import DhcalError, FileFormatError, SampleError
from ...formatting import format_lines
from ...measurements.base import Measurement
from ...measurements.euler_angles import ROTATION_VECTOR
from ...measurements.mounting import MountedRig
from ...measurements.pose import Pose, PoseMeasurement
from ...robot.chain import Chain
from ...robot.conditions import CONDITIONS, Condition, directions_in_order
from ...units import LENGTHS, MASSES, TEMPERATURES, UNITS
from ..tables import Column, DataTable, TextLayout, read_table
from .columns import (
    AFTER,
    COMMANDED,
    ISO_POINT,
    QUATERNION,
    ROTVEC,
    SECOND_PREFIX,
    TOOL_POSE,
    check_columns,
    check_joint_names,
    condition_columns,
    describe_conditions,
    find_kind,
    has_titles,
    has_tool_poses,
    is_in_order,
    join_hint,
    joint_units,
    joints_off_the_chain,
    known_columns,
    needs_column_map,
    value_table,
    with_known_spelling,
)
from .counts import with_joint_values
from .tool_poses import solve_tool_poses

if TYPE_CHECKING:
    from ..servo_file import ServoFile

# Smallest accepted standard deviation [m or rad]; no instrument is as accurate.
_MIN_SIGMA = 1e-15
# Largest deviation of a quaternion's norm from 1. Rounding to three decimals stays below it.
_MAX_NORM_ERROR = 1e-3


@frozen(eq=False)
class MeasurementFile:
    """Content of a measurement file."""

    source: str  #: Name of the file.
    data: Measurement  #: Samples of all rows.
    fit: Measurement  #: Samples to be fitted, which are all, or those whose column `set` says so.
    holdout: Measurement  #: Samples that the column `set` holds out.
    #: Positions that the controller was commanded to, shape (m, 3) [m]; None without the columns.
    commanded: Array | None
    #: Positions measured again with calibrated parameters, shape (m, 3) [m]; None without the columns.
    measured_after: Array | None
    #: Columns of measured values, shape (m,) each, in SI units or as text.
    values: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)  #: Unit that each column was written in.
    notes: tuple[str, ...] = ()  #: Sentences on columns, rows and sheets that are not used.
    bad_rows: Mapping[int, str] = field(default_factory=dict)  #: Reason why a row was skipped, by line.
    #: Joints of the robot that move in the file, but not the tip of the chain.
    other_moving_joints: tuple[str, ...] = ()
    #: Point and cycle of each sample in a test according to ISO 9283, such as ("P1", 12), with cycle 0 if
    #: it is not stated; None without the column.
    iso_points: tuple[tuple[str, int], ...] | None = None


def read_measurements(
    source: PathLike | Any,
    chain: Chain,
    columns: PathLike | None = None,
    *,
    skip_bad_rows: bool = False,
    rig: MountedRig | None = None,
    servos: ServoFile | None = None,
    sheet: str = "",
) -> Measurement:
    """Read all samples of a measurement file.

    Args:
        source: Text file, Excel workbook, Parquet file, or a data frame such as one of pandas.
        chain: Robot that was measured.
        columns: Column map for a file of another maker.
        skip_bad_rows: Whether rows without a number or a name in a column, or with a quaternion that is no
            rotation, are skipped; otherwise they are an error.
        rig: Cameras and boards of image coordinates, on the chain.
        servos: Servos whose counts are in columns `NAME[ticks]`, see `dhcal_pin.io.read_servos`.
        sheet: Sheet of an Excel workbook; by default the one with the most known columns.

    Returns:
        Samples of the kind that the columns select.
    """
    return read_measurement_file(
        source, chain, columns, skip_bad_rows=skip_bad_rows, rig=rig, servos=servos, sheet=sheet
    ).data


def read_measurement_file(
    source: PathLike | Any,
    chain: Chain,
    columns: PathLike | None = None,
    *,
    skip_bad_rows: bool = False,
    rig: MountedRig | None = None,
    servos: ServoFile | None = None,
    sheet: str = "",
    max_rows: int | None = None,
) -> MeasurementFile:
    """Read a measurement file with its hold-out samples, of many rows `max_rows` drawn at random."""
    table = open_measurement_table(source, chain, columns, servos, sheet)
    table = table.thinned(max_rows) if max_rows else table
    return parse_measurements(table, chain, skip_bad_rows, rig)


def open_measurement_table(
    source: PathLike | Any,
    chain: Chain,
    columns: PathLike | None,
    servos: ServoFile | None = None,
    sheet: str = "",
) -> DataTable:
    """Read the table of a measurement file, through a column map and a servo file if they are given."""
    check_joint_names(chain)
    if columns is None:
        table = read_table(source, TextLayout(sheet=sheet, names=known_columns(chain)))
        if not has_titles(table, chain):
            table = with_known_spelling(table, chain)
    else:
        from .column_map import read_map  # lazy import, as the following: only for files of other makers
        from .mapped_table import read_mapped_table

        table = read_mapped_table(source, read_map(columns, chain), known_columns(chain), sheet)
    with table.notes_in_errors():
        return with_joint_values(table, chain, servos)


def has_image_coordinates(
    source: PathLike | Any,
    chain: Chain,
    columns: PathLike | None,
    servos: ServoFile | None,
    sheet: str,
) -> bool:
    """Return whether a measurement file has image coordinates, whose cameras and boards must be known."""
    table = open_measurement_table(source, chain, columns, servos, sheet)
    with table.notes_in_errors():
        return not needs_column_map(table, chain) and find_kind(value_table(table, chain)).kind == "camera"


def parse_measurements(
    table: DataTable, chain: Chain, skip_bad_rows: bool = False, rig: MountedRig | None = None
) -> MeasurementFile:
    """Parse the samples of a table; errors say what was not read, such as further sheets."""
    with table.notes_in_errors():
        return _parse_table(table, chain, skip_bad_rows, rig)


def _parse_table(
    table: DataTable, chain: Chain, skip_bad_rows: bool, rig: MountedRig | None
) -> MeasurementFile:
    """Parse the samples of a table."""
    if needs_column_map(table, chain):
        from .map_proposal import missing_header_error  # lazy import: only for the message

        raise missing_header_error(table, chain)
    ignored = check_columns(table, chain)
    kind = find_kind(value_table(table, chain))
    has_poses = has_tool_poses(value_table(table, chain))
    prefixes = () if has_poses else ("", SECOND_PREFIX)[: kind.configurations_per_row]
    for prefix in prefixes:
        _require_joints(table, chain, prefix)
    complete = table
    table = _usable_rows(table, chain, kind, prefixes, skip_bad_rows)
    measured = value_table(table, chain)
    joints = {prefix + name: joint_units(chain, name) for prefix in prefixes for name in chain.joint_names}
    table.require_units({name: UNITS[each] for name, each in kind.columns.items() if UNITS[each]} | joints)
    values = parse_values(measured, kind)
    _require_all_sigmas(measured, kind, values)
    q = [parse_joint_positions(table, chain, prefix) for prefix in prefixes]
    placeholder = np.zeros((len(table.lines), chain.n_joints))
    data = build_measurement(table, kind, q or [placeholder], values, chain, rig)
    if has_poses:
        tips = parse_values(measured, Pose)
        data = data.replace(q=solve_tool_poses(table, chain, tips), has_joint_values=False)
        values |= tips
    elif table.euler_angles is not None and isinstance(data, PoseMeasurement):
        euler = table.euler_angles
        used = np.searchsorted(euler.lines, data.rows)
        data = data.with_euler_angles(euler.notation, euler.angles[used])
    elif isinstance(data, PoseMeasurement):
        turn = [column.name for column in data.COLUMNS[3:]]
        if measured.columns.keys() >= set(turn):
            data = data.with_euler_angles(ROTATION_VECTOR, np.stack([values[name] for name in turn], -1))
    if len(table.lines) < len(complete.lines) and len(prefixes) == 1 and _is_ordered(table, chain):
        data = data.with_conditions(approach=_directions(complete, table, chain))
    data = with_conditions(data, table, chain)
    is_holdout = _parse_holdout_mask(table)
    return MeasurementFile(
        source=table.source,
        data=data,
        fit=data.take(~is_holdout),
        holdout=data.take(is_holdout),
        commanded=_parse_group(table, COMMANDED, LENGTHS),
        measured_after=_parse_group(table, AFTER, LENGTHS),
        values=values,
        units=column_units(table),
        notes=(
            *table.notes,
            *ignored_columns_note(ignored),
            *_unknown_conditions_note(table, chain),
            *skipped_rows_note(table),
        ),
        bad_rows=table.bad_rows,
        other_moving_joints=_find_other_moving_joints(table, chain),
        iso_points=_parse_iso_points(table),
    )


def _parse_iso_points(table: DataTable) -> tuple[tuple[str, int], ...] | None:
    """Parse the points and cycles of a test according to ISO 9283; None without the column."""
    if ISO_POINT not in table.columns:
        return None
    found = []
    for row, text in enumerate(table.text(table.columns[ISO_POINT])):
        match = re.fullmatch(r"([^:]+?)(?:\s*:\s*(\d{1,9}))?", text)
        if not match:
            raise FileFormatError(
                f"{table.cell_location(row, ISO_POINT)}: {text!r}; expected a point, or a point and a cycle, "
                "such as P1:12"
            )
        found.append((match[1], int(match[2] or 0)))
    return tuple(found)


def _find_other_moving_joints(table: DataTable, chain: Chain) -> tuple[str, ...]:
    """Return the joints off the chain whose columns do not hold the same value in all rows."""
    present = [name for name in joints_off_the_chain(chain) if name in table.columns]
    return tuple(name for name in present if len(np.unique(table.values(table.columns[name].index))) > 1)


def ignored_columns_note(labels: Sequence[str]) -> list[str]:
    """Return one sentence that names ignored columns, none if there are no such columns."""
    names = ", ".join(label.removeprefix("column ") for label in labels)
    return [f"column{'s' if len(labels) > 1 else ''} {names} ignored"] if labels else []


def _unknown_conditions_note(table: DataTable, chain: Chain) -> list[str]:
    """Return a sentence on ignored columns that have the unit of a condition, none without such columns."""
    units, known = {*TEMPERATURES, *MASSES}, known_columns(chain)
    names = [name for name, column in table.columns.items() if column.unit in units and name not in known]
    if not names:
        return []
    return [f"{', '.join(names)}: not a known condition; the conditions are {describe_conditions()}"]


def skipped_rows_note(table: DataTable) -> list[str]:
    """Return one sentence that names the skipped rows of a table, none if there are no such rows."""
    if not table.bad_rows:
        return []
    count, lines = len(table.bad_rows), format_lines(table.bad_rows)
    first = next(iter(table.bad_rows.values()))
    if count == 1:
        return [f"line {lines} skipped: {first}"]
    return [f"{count} lines skipped: {lines}; the first because {first}"]


def _usable_rows(
    table: DataTable, chain: Chain, kind: type[Measurement], prefixes: Sequence[str], skip_bad_rows: bool
) -> DataTable:
    """Return the table without rows that lack a number, a name or a rotation, or raise an error on them."""
    joints = [prefix + name for prefix in prefixes for name in chain.joint_names]
    quantities = {
        **kind.columns,
        **dict.fromkeys((*TOOL_POSE, *QUATERNION, *COMMANDED, *AFTER), ""),
        "set": "text",
    }
    texts = {name for name, quantity in quantities.items() if quantity == "text"}
    needed = [name for name, quantity in quantities.items() if quantity != "remark"]
    conditions = [column.name for columns in _present_conditions(table, chain).values() for column in columns]
    used = [name for name in (*joints, *needed, *conditions) if name in table.columns]
    table = table.without_bad_rows(
        [table.columns[name].index for name in used if name not in texts],
        [table.columns[name].index for name in used if name in texts],
    )
    table = table.without_rows(_wrong_quaternions(table))
    if not skip_bad_rows:
        table.require_good_rows(", or use --skip-bad-rows")
    if not len(table.lines):
        line, reason = next(iter(table.bad_rows.items()), (table.header_line, "no rows"))
        raise FileFormatError(
            f"{table.source}: no row has all numbers (line {line}: {reason}); correct the file or its columns"
        )
    return table


def _wrong_quaternions(table: DataTable) -> dict[int, str]:
    """Return why rows have no rotation; none if most rows do, as with columns that are no quaternion."""
    if not set(QUATERNION) <= table.columns.keys():
        return {}
    norm = _norms(np.stack([table.values(table.columns[name].index) for name in QUATERNION], -1))
    wrong = np.flatnonzero(np.abs(norm - 1) > _MAX_NORM_ERROR).tolist()
    if 2 * len(wrong) > len(norm):
        return {}
    return {row: f"the quaternion's norm is {norm[row]:.4g}, not 1 within a thousandth" for row in wrong}


def _norms(quaternion: Array) -> Array:
    """Return the norms of quaternions, shape (m,)."""
    with np.errstate(over="ignore"):
        return np.linalg.norm(quaternion, axis=1)


def _present_conditions(table: DataTable, chain: Chain) -> dict[str, list[Column]]:
    """Return the columns of each condition that a table has; a time without a unit is a text for people."""
    present = {
        name: [table.columns[column] for column in columns if column in table.columns]
        for name, columns in condition_columns(chain).items()
    }
    return {
        name: columns
        for name, columns in present.items()
        if columns and not (name == "time" and not columns[0].unit)
    }


def with_conditions(data: Measurement, table: DataTable, chain: Chain) -> Measurement:
    """Return the samples with their conditions; rows with a time are in the order of measurement."""
    present = _present_conditions(table, chain)
    values: dict[str, Array] = {}
    for name, columns in present.items():
        parsed = [_parse_condition(table, column, CONDITIONS[name]) for column in columns]
        if CONDITIONS[name].is_per_joint:
            by_column = dict(zip([column.name for column in columns], parsed, strict=True))
            unknown = np.zeros(len(table.lines))
            values[name] = np.stack([by_column.get(c, unknown) for c in condition_columns(chain)[name]], -1)
        else:
            values[name] = parsed[0]
    if values:
        data = data.with_conditions(**values)
    is_ordered = _is_ordered(table, chain) and data.configurations_per_row == 1
    return data.in_order() if is_ordered else data


def _is_ordered(table: DataTable, chain: Chain) -> bool:
    """Return whether the rows are in the order of measurement."""
    return "time" in _present_conditions(table, chain) or is_in_order(table)


def _directions(complete: DataTable, table: DataTable, chain: Chain) -> Array:
    """Return the direction of the last motion of each joint in usable rows (m, n); 0 if it is unknown."""
    # The arm was at the joint values of skipped rows, too. Where these are missing, a new sequence begins.
    joints = [complete.columns[name].index for name in chain.joint_names if name in complete.columns]
    known = complete.without_bad_rows(joints, [])
    q = parse_joint_positions(known, chain, "")
    gaps = np.flatnonzero(np.diff(np.searchsorted(complete.lines, known.lines)) > 1) + 1
    directions = np.concatenate([directions_in_order(part) for part in np.split(q, gaps)])
    return directions[np.isin(known.lines, table.lines)]


def _parse_condition(table: DataTable, column: Column, condition: Condition) -> Array:
    """Parse and check a column of a condition, shape (m,)."""
    units = UNITS[condition.quantity]
    if units:
        values = table.finite_numbers(column) / column.divisor(units, table.header_location)
    else:
        values = _pure_numbers(table, column)
    if problem := condition.find_problem(values):
        row, text = problem
        raise FileFormatError(f"{table.cell_location(row, column.name)}: {text}")
    return values


def build_measurement(
    table: DataTable,
    kind: type[Measurement],
    q: Sequence[Array],
    values: Mapping[str, Any],
    chain: Chain,
    rig: MountedRig | None = None,
) -> Measurement:
    """Build the samples with their file and lines, and put the name of the file in front of an error."""
    try:
        data = kind.from_columns(q, values, rig).mounted(chain)
    except SampleError as error:
        line = int(table.lines[error.sample])
        raise FileFormatError(f"{table.source}:{line}: {error.problem}") from None
    except DhcalError as error:
        raise FileFormatError(f"{table.source}: {error}") from None
    return data.replace(rows=np.array(table.lines), source=table.source, has_counts=table.has_counts)


def parse_joint_positions(table: DataTable, chain: Chain, prefix: str = "") -> Array:
    """Parse the columns of the joints."""
    _require_joints(table, chain, prefix)
    columns = [(table.columns[prefix + name], joint_units(chain, name)) for name in chain.joint_names]
    return np.stack([table.to_si(column, units) for column, units in columns], -1)


def _require_joints(table: DataTable, chain: Chain, prefix: str) -> None:
    """Raise an error if the column of a joint is missing."""
    missing = [name for name in chain.joint_names if prefix + name not in table.columns]
    if missing:
        units = {name: "mm" if joint_units(chain, name) is LENGTHS else "deg" for name in chain.joint_names}
        expected = ",".join(f"{prefix}{name}[{unit}]" for name, unit in units.items())
        raise FileFormatError(
            f"{table.header_location}: no column for joint {prefix + missing[0]!r}; this robot needs "
            f"{expected}; if the measured point does not move with it, choose another tip link"
            f"{join_hint(table)}"
        )


def parse_values(table: DataTable, kind: type[Measurement]) -> dict[str, Any]:
    """Parse the columns of a kind in SI units or as text; a quaternion becomes a rotation vector."""
    values: dict[str, Any] = {}
    for name, content in kind.columns.items():
        if name not in table.columns:
            continue
        column = table.columns[name]
        is_text = content in ("text", "remark")
        values[name] = table.text(column) if is_text else table.to_si(column, UNITS[content])
        if "sigma" in name and (too_small := np.flatnonzero(values[name] < _MIN_SIGMA)).size:
            raise FileFormatError(
                f"{table.cell_location(int(too_small[0]), name)}: must be above zero; "
                "leave the sigma columns out if they are not known"
            )
        if content == "text" and "" in values[name]:
            raise FileFormatError(
                f"{table.cell_location(values[name].index(''), name)} is empty; correct or remove the row"
            )
    if set(ROTVEC) <= set(kind.columns) and set(QUATERNION) & set(table.columns):
        if set(ROTVEC) & set(table.columns):
            raise FileFormatError(f"{table.header_location}: both qw… and rx… given; keep one rotation")
        rotvec = se3.log3(_parse_quaternion(table))
        values |= {name: rotvec[:, i] for i, name in enumerate(ROTVEC)}
    return values


def _parse_quaternion(table: DataTable) -> Array:
    """Parse the quaternion columns to rotation matrices, shape (m, 3, 3)."""
    quaternion = _parse_group(table, QUATERNION, None)
    assert quaternion is not None
    norm = _norms(quaternion)
    wrong = np.flatnonzero(np.abs(norm - 1) > _MAX_NORM_ERROR)
    if wrong.size:
        raise FileFormatError(
            f"{table.source}:{table.lines[wrong[0]]}: the quaternion's norm is {norm[wrong[0]]:.4g}; "
            "it must be 1 within a thousandth (order qw,qx,qy,qz)"
        )
    return se3.quaternion_to_matrix(quaternion / norm[:, None])


def _parse_group(table: DataTable, names: Sequence[str], units: Mapping[str, float] | None) -> Array | None:
    """Parse k columns that belong together, shape (m, k), in SI units; return None if all are absent."""
    if not _has_all(table, names):
        return None
    columns = [table.columns[name] for name in names]
    if units is not None:
        return np.stack([table.to_si(column, units) for column in columns], -1)
    return np.stack([_pure_numbers(table, column) for column in columns], -1)


def _pure_numbers(table: DataTable, column: Column) -> Array:
    """Return the numbers of a column without a unit, shape (m,)."""
    if column.unit:
        raise FileFormatError(
            f"{table.header_location}: column {column.name!r} is a pure number; "
            f"write {column.name} without a unit"
        )
    return table.finite_numbers(column)


def _require_all_sigmas(table: DataTable, kind: type[Measurement], values: Mapping[str, Any]) -> None:
    """Raise an error if some standard deviations are given without the others."""
    wanted = [f"sigma_{name}" for name in kind.columns if name in values and f"sigma_{name}" in kind.columns]
    wanted = wanted or [name for name in kind.columns if name.startswith("sigma_")]
    _has_all(table, wanted)


def _has_all(table: DataTable, names: Sequence[str]) -> bool:
    """Return whether a table has columns that belong together; raise an error if some of them are missing."""
    present = [name for name in names if name in table.columns]
    if present and len(present) < len(names):
        missing = next(name for name in names if name not in present)
        raise FileFormatError(
            f"{table.header_location}: {', '.join(present)} without {missing!r}; "
            f"give {','.join(names)} or none"
        )
    return bool(present)


def _parse_holdout_mask(table: DataTable) -> Array:
    """Parse the column `set`, shape (m,): True for samples that are held out."""
    column: Column | None = table.columns.get("set")
    if column is None:
        return np.zeros(len(table.lines), bool)
    words = table.text(column)
    for row, word in enumerate(words):
        if word not in ("fit", "holdout"):
            raise FileFormatError(f"{table.cell_location(row, 'set')}: {word!r} must be fit or holdout")
    return np.array([word == "holdout" for word in words])


def column_units(table: DataTable) -> dict[str, str]:
    """Return the unit of each column, by name."""
    return {name: column.unit for name, column in table.columns.items()}
