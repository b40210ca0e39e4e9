"""Measurement files: CSV tables of joint positions and measured values, and files of joint positions alone.

The joints are columns under their URDF names, and the measured values are columns whose names select the
measurement kind (see `measurement_columns`). Every length and angle carries its unit in brackets. Files of
other vendors are read through a column map (see `column_mapping`).

Errors in the content of a file are `FileFormatError` or, for unknown columns and units, `UnknownNameError`.
Their messages name the file, the line as counted by a text editor, and the column. `Measurement.rows` counts
the rows of data instead: 1 is the first row under the header, and comments and blank lines are not counted.

Shapes: m rows of data, n joints.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..estimation.problem import CHUNK_SIZE
from ..exceptions import DhcalError, FileFormatError
from ..measurements.base import Measurement
from ..measurements.pose import Pose
from ..measurements.position import Position
from ..robot.chain import Chain
from ..units import LENGTHS, UNITS
from .measurement_columns import (
    AFTER,
    COMMANDED,
    QUATERNION,
    ROTVEC,
    SECOND_PREFIX,
    check_columns,
    check_joint_names,
    column_contents,
    find_kind,
    joint_units,
)
from .tabular import BLANK_CHARACTERS, Column, CsvTable, csv_text, parse_csv_table, read_csv_table

# Smallest accepted standard deviation [m or rad]; no instrument is as accurate.
_MIN_SIGMA = 1e-15
# Largest deviation of a quaternion's norm from 1. Rounding to three decimals stays below it.
_MAX_NORM_ERROR = 1e-3

# Samples, or a function that reads them. The function is small enough to be sent to another process.
Part = Measurement | Callable[[], Measurement]


@dataclass(frozen=True, eq=False)
class MeasurementFile:
    """Content of a measurement file.

    Attributes:
        source: Name of the file.
        data: Samples of all rows.
        fit: Samples to be fitted: all, or those whose column `set` says so.
        holdout: Samples that the column `set` holds out.
        commanded: Positions that the controller was commanded to, shape (m, 3) [m]; None without the columns.
        measured_after: Positions measured again with calibrated parameters, shape (m, 3) [m]; None without
            the columns.
        values: Columns of measured values, shape (m,) each, in SI units or as text.
        units: Unit that each column was written in.
    """

    source: str
    data: Measurement
    fit: Measurement
    holdout: Measurement
    commanded: Array | None
    measured_after: Array | None
    values: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class TargetPoses:
    """Positions or poses that a tool shall reach.

    Attributes:
        source: Name of the file.
        values: Positions, shape (m, 3) [m], or poses, shape (m, 4, 4), if the file has rotations.
        near: Joint positions near which solutions are wanted, shape (m, n) [rad or m]; None without the
            columns.
        units: Unit that each column was written in.
    """

    source: str
    values: Array
    near: Array | None
    units: Mapping[str, str]


# --- reading a measurement file --------------------------------------------------------------------


def read_measurements(path: PathLike, chain: Chain, columns: PathLike | None = None) -> Measurement:
    """Read all samples of a measurement file.

    Args:
        path: CSV file, or any text table that `columns` describes.
        chain: Robot that was measured.
        columns: Column map for a file of another vendor.

    Returns:
        Samples of the kind that the columns select.
    """
    return read_measurement_file(path, chain, columns).data


def read_measurement_file(path: PathLike, chain: Chain, columns: PathLike | None = None) -> MeasurementFile:
    """Read a measurement file with its division into fitted and held-out samples.

    Args:
        path: CSV file, or any text table that `columns` describes.
        chain: Robot that was measured.
        columns: Column map for a file of another vendor.

    Returns:
        Content of the file.
    """
    check_joint_names(chain)
    return parse_measurements(open_measurement_table(path, chain, columns), chain)


def open_measurement_table(path: PathLike, chain: Chain, columns: PathLike | None) -> CsvTable:
    """Read the table of a measurement file, through a column map if one is given.

    Args:
        path: CSV file, or any text table that `columns` describes.
        chain: Robot that was measured.
        columns: Column map for a file of another vendor; None for a CSV file of the project's own format.

    Returns:
        Table with the project's own columns.
    """
    if columns is None:
        return read_csv_table(path)
    from .column_mapping import read_map, read_mapped_table  # lazy import: only for files of other vendors

    contents = column_contents(chain)
    return read_mapped_table(path, read_map(columns, contents, chain.joint_names), set(contents))


def parse_measurements(table: CsvTable, chain: Chain) -> MeasurementFile:
    """Parse the samples of a table.

    Args:
        table: Table of a measurement file, or of a part of one.
        chain: Robot that was measured.

    Returns:
        Content of the table.
    """
    check_columns(table, chain)
    kind = find_kind(table)
    values = _parse_values(table, kind)
    _require_all_sigmas(table, kind, values)
    prefixes = ("", SECOND_PREFIX)[: kind.configurations_per_row]
    q = [parse_joint_positions(table, chain, prefix) for prefix in prefixes]
    data = _build_measurement(table, kind, q or [np.zeros((len(table.cells), chain.n_joints))], values)
    is_holdout = _parse_holdout_mask(table)
    return MeasurementFile(
        source=table.source,
        data=data,
        fit=data.take(~is_holdout),
        holdout=data.take(is_holdout),
        commanded=_parse_group(table, COMMANDED, LENGTHS),
        measured_after=_parse_group(table, AFTER, LENGTHS),
        values=values,
        units=_units(table),
    )


def _build_measurement(
    table: CsvTable, kind: type[Measurement], q: Sequence[Array], values: Mapping[str, Any]
) -> Measurement:
    """Build the samples, and put the name of the file in front of an error."""
    try:
        return kind.from_columns(q, values)
    except DhcalError as error:
        raise FileFormatError(f"{table.source}: {error}") from None


def parse_joint_positions(table: CsvTable, chain: Chain, prefix: str = "") -> Array:
    """Parse the columns of the joints.

    Args:
        table: Table with a column for each joint.
        chain: Robot with the joints.
        prefix: Text before each joint's name, such as "to:" for the second configuration of a row.

    Returns:
        Joint positions, shape (m, n) [rad or m].

    Raises:
        FileFormatError: The column of a joint is missing.
    """
    missing = [name for name in chain.joint_names if prefix + name not in table.columns]
    if missing:
        units = {name: "mm" if joint_units(chain, name) is LENGTHS else "deg" for name in chain.joint_names}
        expected = ",".join(f"{prefix}{name}[{unit}]" for name, unit in units.items())
        raise FileFormatError(
            f"{table.header_location}: no column for joint {prefix + missing[0]!r}; "
            f"this robot needs {expected}"
        )
    columns = [(table.columns[prefix + name], joint_units(chain, name)) for name in chain.joint_names]
    return np.stack([table.to_si(column, units) for column, units in columns], -1)


def _parse_values(table: CsvTable, kind: type[Measurement]) -> dict[str, Any]:
    """Parse the columns of a kind in SI units or as text; a quaternion becomes a rotation vector."""
    values: dict[str, Any] = {}
    for name, content in kind.columns.items():
        if name not in table.columns:
            continue
        column = table.columns[name]
        values[name] = table.text(column) if content == "text" else table.to_si(column, UNITS[content])
        if "sigma" in name and (too_small := np.flatnonzero(values[name] < _MIN_SIGMA)).size:
            raise FileFormatError(
                f"{table.cell_location(int(too_small[0]), name)}: must be above zero; "
                "leave the sigma columns out if they are not known"
            )
        if content == "text" and "" in values[name]:
            raise FileFormatError(
                f"{table.cell_location(values[name].index(''), name)}: is empty; write a name"
            )
    if set(QUATERNION) & set(table.columns):
        if set(ROTVEC) & set(table.columns):
            raise FileFormatError(f"{table.header_location}: both qw… and rx… given; keep one rotation")
        rotvec = se3.log3(_parse_quaternion(table))
        values |= {name: rotvec[:, i] for i, name in enumerate(ROTVEC)}
    return values


def _parse_quaternion(table: CsvTable) -> Array:
    """Parse the quaternion columns to rotation matrices, shape (m, 3, 3)."""
    quaternion = _parse_group(table, QUATERNION, None)
    assert quaternion is not None
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(np.abs(norm - 1) > _MAX_NORM_ERROR)
    if wrong.size:
        raise FileFormatError(
            f"{table.source}:{table.lines[wrong[0]]}: the quaternion's norm is {norm[wrong[0]]:.4g}; "
            "it must be 1 within a thousandth (order qw,qx,qy,qz)"
        )
    w, v = quaternion[:, 0] / norm, quaternion[:, 1:] / norm[:, None]
    # R = I + 2 w [v]x + 2 [v]x²
    cross = se3.skew(v)
    return np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def _parse_group(table: CsvTable, names: Sequence[str], units: Mapping[str, float] | None) -> Array | None:
    """Parse k columns that belong together, shape (m, k), in SI units; return None if all are absent."""
    missing = [name for name in names if name not in table.columns]
    if len(missing) == len(names):
        return None
    if missing:
        present = [name for name in names if name in table.columns]
        raise FileFormatError(
            f"{table.header_location}: {', '.join(present)} without {missing[0]!r}; "
            f"give {','.join(names)} or none"
        )
    columns = [table.columns[name] for name in names]
    if units is not None:
        return np.stack([table.to_si(column, units) for column in columns], -1)
    for column in columns:
        if column.unit:
            raise FileFormatError(
                f"{table.header_location}: column {column.name!r} is a pure number; "
                f"write {column.name} without a unit"
            )
    return np.stack([table.numbers(column) for column in columns], -1)


def _require_all_sigmas(table: CsvTable, kind: type[Measurement], values: Mapping[str, Any]) -> None:
    """Raise an error if some standard deviations are given without the others."""
    wanted = [f"sigma_{name}" for name in kind.columns if name in values and f"sigma_{name}" in kind.columns]
    wanted = wanted or [name for name in kind.columns if name.startswith("sigma_")]
    given = [name for name in wanted if name in values]
    if given and len(given) < len(wanted):
        missing = next(name for name in wanted if name not in values)
        raise FileFormatError(
            f"{table.header_location}: {', '.join(given)} without {missing!r}; "
            f"give {','.join(wanted)} or none"
        )


def _parse_holdout_mask(table: CsvTable) -> Array:
    """Parse the column `set`, shape (m,): True for samples that are held out."""
    column: Column | None = table.columns.get("set")
    if column is None:
        return np.zeros(len(table.cells), bool)
    words = table.text(column)
    for row, word in enumerate(words):
        if word not in ("fit", "holdout"):
            raise FileFormatError(f"{table.cell_location(row, 'set')}: {word!r} must be fit or holdout")
    return np.array([word == "holdout" for word in words])


def _units(table: CsvTable) -> dict[str, str]:
    return {name: column.unit for name, column in table.columns.items()}


# --- reading a measurement file in parts -----------------------------------------------------------


def iter_measurements(
    path: PathLike, chain: Chain, rows: int = CHUNK_SIZE
) -> Iterator[Callable[[], Measurement]]:
    """Divide a measurement file into parts that are read later, one by one.

    The file must be accessible under this path wherever the parts are read: on a cluster, for all workers.

    Args:
        path: CSV file of the project's own format.
        chain: Robot that was measured.
        rows: Largest number of rows of a part.

    Yields:
        Function that reads the samples to be fitted of one part.

    Raises:
        FileFormatError: The file cannot be read. Errors in its content are raised when a part is read.
    """
    source = os.fspath(path)
    blank = f"{BLANK_CHARACTERS}\r\n".encode()
    header: tuple[int, str] | None = None
    # First byte, first line and number of rows of the current part.
    start = first_line = count = 0
    try:
        with open(path, "rb") as file:
            end = 0
            for line_number, line in enumerate(file, 1):
                end += len(line)
                if not line.strip(blank) or line.lstrip().startswith(b"#"):
                    continue
                if header is None:
                    header = line_number, line.decode("utf-8-sig").rstrip("\r\n")
                    start, first_line = end, line_number + 1
                    continue
                count += 1
                if count == rows:
                    yield partial(_read_part, source, chain, header, first_line, start, end)
                    start, first_line, count = end, line_number + 1, 0
    except OSError as error:
        raise FileFormatError(
            f"{source}: cannot read it: {error.strerror}; give the path of a file"
        ) from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{source}: the header is not UTF-8; save the file as UTF-8") from error
    # A file without rows has one empty part, so that reading it raises the error.
    if header is not None and (count or first_line == header[0] + 1):
        yield partial(_read_part, source, chain, header, first_line, start, end)


def _read_part(
    source: str, chain: Chain, header: tuple[int, str], first_line: int, start: int, end: int
) -> Measurement:
    """Read the samples to be fitted between two byte positions of a file."""
    with open(source, "rb") as file:
        file.seek(start)
        data = file.read(end - start)
    try:
        lines = data.decode().splitlines()
    except UnicodeDecodeError as error:
        position = start + error.start
        raise FileFormatError(f"{source}: byte {position} is not UTF-8; save the file as UTF-8") from error
    return parse_measurements(parse_csv_table(source, [header, *enumerate(lines, first_line)]), chain).fit


# --- reading targets and joint positions -----------------------------------------------------------


def read_targets(path: PathLike, chain: Chain) -> TargetPoses:
    """Read target positions or poses of a tool.

    Args:
        path: CSV file with the columns of a position or a pose; those of the joints are optional.
        chain: Robot with the tool.

    Returns:
        The targets.

    Raises:
        FileFormatError: The columns are those of another measurement kind.
    """
    check_joint_names(chain)
    table = read_csv_table(path)
    check_columns(table, chain)
    kind = find_kind(table)
    if kind not in (Pose, Position):
        raise FileFormatError(
            f"{table.header_location}: the columns are those of a {kind.kind} measurement; targets have "
            "x[mm],y[mm],z[mm], with or without qw,qx,qy,qz or rx[rad],ry[rad],rz[rad]"
        )
    has_joints = bool(set(chain.joint_names) & set(table.columns))
    near = parse_joint_positions(table, chain) if has_joints else None
    placeholder = np.zeros((len(table.cells), chain.n_joints))
    data = _build_measurement(table, kind, [placeholder], _parse_values(table, kind))
    values = data.poses if isinstance(data, Pose) else data.positions()
    return TargetPoses(table.source, values, near, _units(table))


def read_configurations(path: PathLike, chain: Chain, columns: PathLike | None = None) -> Array:
    """Read the joint positions of a file; measured values beside them are ignored.

    Args:
        path: CSV file with a column for each joint, or a text table that `columns` describes.
        chain: Robot with the joints.
        columns: Column map for a file of another vendor.

    Returns:
        Joint positions, shape (m, n) [rad or m].
    """
    check_joint_names(chain)
    table = open_measurement_table(path, chain, columns)
    check_columns(table, chain)
    return parse_joint_positions(table, chain)


# --- writing ---------------------------------------------------------------------------------------


def measurement_text(data: Measurement, chain: Chain, comments: Sequence[str] = ()) -> str:
    """Return the CSV text of samples of any kind.

    Args:
        data: Samples to write.
        chain: Robot that was measured.
        comments: Comment lines before the header.

    Returns:
        Table in metres and radians with all digits, so that it reads back bit-identical.
    """
    check_joint_names(chain)
    count = data.configurations_per_row
    configurations = np.split(data.configurations(), max(count, 1))
    columns: dict[str, Any] = {}
    for prefix, q in zip(("", SECOND_PREFIX)[:count], configurations, strict=False):
        columns |= joint_columns(q, chain, prefix)
    for name, values in data.to_columns().items():
        unit = {"length": "[m]", "angle": "[rad]", "text": ""}[data.columns[name]]
        columns[name + unit] = list(values) if unit == "" else values.tolist()
    return csv_text(columns, comments)


def configurations_text(q: Array, chain: Chain, comments: Sequence[str]) -> str:
    """Return the CSV text of joint positions.

    Args:
        q: Joint positions, shape (m, n) [rad or m].
        chain: Robot with the joints.
        comments: Comment lines before the header.

    Returns:
        Table in metres and radians with all digits, so that it reads back bit-identical.
    """
    check_joint_names(chain)
    return csv_text(joint_columns(q, chain), comments)


def joint_columns(q: Array, chain: Chain, prefix: str = "") -> dict[str, list[float]]:
    """Return the columns of joint positions for a CSV file.

    Args:
        q: Joint positions, shape (m, n) [rad or m].
        chain: Robot with the joints.
        prefix: Text before each joint's name.

    Returns:
        Values, m each, by header.
    """
    return {
        f"{prefix}{name}[{'m' if joint_units(chain, name) is LENGTHS else 'rad'}]": q[:, j].tolist()
        for j, name in enumerate(chain.joint_names)
    }
