"""Measurement CSV files: joints under their URDF names, units in the header, readings by column name."""

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
from ..exceptions import DhcalError
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
    find_kind,
    quantities,
    units_of,
)
from .tabular import Column, CsvTable, csv_text, parse_csv_table, read_csv_table

# No instrument is that good: m or rad.
_MIN_SIGMA = 1e-15


@dataclass(frozen=True, eq=False)
class MeasurementFile:
    """A measurement file.

    Attributes:
        source: the file's name.
        data: all its rows.
        fit, holdout: the rows by the column `set`; all are to be fitted without it.
        commanded: (m, 3) positions the controller was told, m; None without the columns.
        measured_after: (m, 3) positions reached once more with calibrated parameters, m; None without.
        values: the columns (m,) of the readings as they stood in the file, in SI or as text.
        units: the unit that each column was written in.
    """

    source: str
    data: Measurement
    fit: Measurement
    holdout: Measurement
    commanded: Array | None
    measured_after: Array | None
    values: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


def _group(sheet: CsvTable, names: Sequence[str], units: Mapping[str, float] | None) -> Array | None:
    """Columns (m, k) in SI; None if none of them is there, DhcalError if only some are."""
    missing = [name for name in names if name not in sheet.columns]
    if len(missing) == len(names):
        return None
    where = f"{sheet.source}:{sheet.header}"
    if missing:
        there = [name for name in names if name in sheet.columns]
        raise DhcalError(
            f"{where}: {', '.join(there)} without {missing[0]!r}; give {','.join(names)} or none"
        )
    if units is None:
        for name in names:
            if sheet.columns[name].unit:
                raise DhcalError(f"{where}: column {name!r} is a pure number; write {name} without a unit")
        return np.stack([sheet.numbers(sheet.columns[name]) for name in names], -1)
    return np.stack([sheet.to_si(sheet.columns[name], units) for name in names], -1)


def joint_values(sheet: CsvTable, chain: Chain, prefix: str = "") -> Array:
    """Joint values (m, n) under the joints' names, each with `before` in front."""
    missing = [name for name in chain.joint_names if prefix + name not in sheet.columns]
    if missing:
        units = {name: "mm" if units_of(chain, name) is LENGTHS else "deg" for name in chain.joint_names}
        every = ",".join(f"{prefix}{name}[{unit}]" for name, unit in units.items())
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: no column for joint {prefix + missing[0]!r}; "
            f"this robot needs {every}"
        )
    columns = [(sheet.columns[prefix + name], units_of(chain, name)) for name in chain.joint_names]
    return np.stack([sheet.to_si(column, units) for column, units in columns], -1)


def _values(sheet: CsvTable, kind: type[Measurement]) -> dict[str, Any]:
    """The kind's columns in SI, or as text; a quaternion as a rotation vector."""
    out: dict[str, Any] = {}
    for name, what in kind.columns.items():
        if name not in sheet.columns:
            continue
        column = sheet.columns[name]
        out[name] = sheet.text(column) if what == "text" else sheet.to_si(column, UNITS[what])
        if "sigma" in name and (bad := np.flatnonzero(out[name] < _MIN_SIGMA)).size:
            raise DhcalError(
                f"{sheet.source}:{sheet.lines[bad[0]]}: column {name!r}: must be above zero; "
                "leave the sigma columns out where they are not known"
            )
        if what == "text" and "" in out[name]:
            line = sheet.lines[out[name].index("")]
            raise DhcalError(f"{sheet.source}:{line}: column {name!r}: is empty; write a name")
    if set(QUATERNION) & set(sheet.columns):
        if set(ROTVEC) & set(sheet.columns):
            raise DhcalError(f"{sheet.source}:{sheet.header}: both qw… and rx… given; keep one rotation")
        turn = se3.log3(_from_quaternion(sheet, _group(sheet, QUATERNION, None)))
        out |= {name: turn[:, i] for i, name in enumerate(ROTVEC)}
    return out


def _whole_sigmas(sheet: CsvTable, kind: type[Measurement], values: Mapping[str, Any]) -> None:
    """Complains about some sigmas without the others."""
    wanted = [f"sigma_{name}" for name in kind.columns if name in values and f"sigma_{name}" in kind.columns]
    wanted = wanted or [name for name in kind.columns if name.startswith("sigma_")]
    given = [name for name in wanted if name in values]
    if given and len(given) < len(wanted):
        lacking = next(name for name in wanted if name not in values)
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: {', '.join(given)} without {lacking!r}; "
            f"give {','.join(wanted)} or none"
        )


def open_measurement_table(path: PathLike, chain: Chain, columns: PathLike | None) -> CsvTable:
    """A measurement file as it is, or another maker's by its map."""
    if columns is None:
        return read_csv_table(path)
    from .column_mapping import (
        read_map,  # a part of the start-up, for other makers' files alone
        read_mapped_table,
    )

    known = quantities(chain)
    return read_mapped_table(path, read_map(columns, known, chain.joint_names), set(known))


def read_measurement_file(path: PathLike, chain: Chain, columns: PathLike | None = None) -> MeasurementFile:
    """A measurement file of any kind, for a chain's joints.

    Args:
        path: a CSV file of the project's own form, or any table of text that `columns` describes.
        chain: the robot.
        columns: a map as in `column_maps`, for a file of another maker.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    check_joint_names(chain)
    return parse_measurements(open_measurement_table(path, chain, columns), chain)


def parse_measurements(sheet: CsvTable, chain: Chain) -> MeasurementFile:
    """The readings of a sheet, which may be a part of a file; as `read_readings`."""
    check_columns(sheet, chain)
    kind = find_kind(sheet)
    values = _values(sheet, kind)
    _whole_sigmas(sheet, kind, values)
    q = [joint_values(sheet, chain, before) for before in ("", SECOND_PREFIX)[: kind.configurations_per_row]]
    try:
        data = kind.from_columns(q or [np.zeros((len(sheet.cells), chain.n_joints))], values)
    except DhcalError as error:
        raise DhcalError(f"{sheet.source}: {error}") from None
    held = _holdout_mask(sheet)
    return MeasurementFile(
        sheet.source,
        data,
        data.take(~held),
        data.take(held),
        _group(sheet, COMMANDED, LENGTHS),
        _group(sheet, AFTER, LENGTHS),
        values,
        {name: column.unit for name, column in sheet.columns.items()},
    )


def _from_quaternion(sheet: CsvTable, quaternion: Array | None) -> Array:
    assert quaternion is not None
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 1e-3)
    if bad.size:
        raise DhcalError(
            f"{sheet.source}:{sheet.lines[bad[0]]}: the quaternion's norm is {norm[bad[0]]:.4g}; "
            "it must be 1 within a thousandth (order qw,qx,qy,qz)"
        )
    w, v = quaternion[:, 0] / norm, quaternion[:, 1:] / norm[:, None]
    cross = se3.skew(v)
    return np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def _holdout_mask(sheet: CsvTable) -> Array:
    column: Column | None = sheet.columns.get("set")
    if column is None:
        return np.zeros(len(sheet.cells), bool)
    words = sheet.text(column)
    for word, line in zip(words, sheet.lines, strict=True):
        if word not in ("fit", "holdout"):
            raise DhcalError(f"{sheet.source}:{line}: column 'set': {word!r} must be fit or holdout")
    return np.array([word == "holdout" for word in words])


def read_measurements(path: PathLike, chain: Chain, columns: PathLike | None = None) -> Measurement:
    """All rows of a measurement file, of the kind that its columns tell; `columns` as in `read_readings`.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    return read_measurement_file(path, chain, columns).data


@dataclass(frozen=True, eq=False)
class TargetPoses:
    """Where a tool is wanted.

    Attributes:
        source: the file's name.
        values: (m, 3) positions in m, or (m, 4, 4) poses where the file has rotations.
        near: (m, n) joint values of the file, near which solutions are wanted; None without them.
        units: the unit that each column was written in.
    """

    source: str
    values: Array
    near: Array | None
    units: Mapping[str, str]


def read_targets(path: PathLike, chain: Chain) -> TargetPoses:
    """Target positions or poses for a chain's tool: columns as in measurements, the joints' not needed.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    check_joint_names(chain)
    sheet = read_csv_table(path)
    check_columns(sheet, chain)
    kind = find_kind(sheet)
    if kind not in (Pose, Position):
        raise DhcalError(
            f"{sheet.source}:{sheet.header}: these are readings of kind {kind.kind}; targets have "
            "x[mm],y[mm],z[mm], with or without qw,qx,qy,qz or rx[rad],ry[rad],rz[rad]"
        )
    near = joint_values(sheet, chain) if set(chain.joint_names) & set(sheet.columns) else None
    nowhere = np.zeros((len(sheet.cells), chain.n_joints))
    values = _values(sheet, kind)
    try:
        data = kind.from_columns([nowhere], values)
    except DhcalError as error:
        raise DhcalError(f"{sheet.source}: {error}") from None
    targets = data.poses if isinstance(data, Pose) else data.positions()
    return TargetPoses(
        sheet.source, targets, near, {name: column.unit for name, column in sheet.columns.items()}
    )


def measurement_text(data: Measurement, chain: Chain, comments: Sequence[str] = ()) -> str:
    """The CSV text of readings of any kind in metres and radians, exact to the last digit.

    Raises:
        DhcalError: a joint's name cannot head a column.
    """
    check_joint_names(chain)
    columns: dict[str, Any] = {}
    for before, q in zip(
        ("", SECOND_PREFIX)[: data.configurations_per_row],
        np.split(data.configurations(), max(data.configurations_per_row, 1)),
        strict=False,
    ):
        columns |= joint_columns(q, chain, before)
    for name, values in data.to_columns().items():
        unit = {"length": "[m]", "angle": "[rad]", "text": ""}[data.columns[name]]
        columns[name + unit] = list(values) if unit == "" else values.tolist()
    return csv_text(columns, comments)


def joint_columns(q: Array, chain: Chain, prefix: str = "") -> dict[str, list[float]]:
    """Columns (m,) of joint values (m, n), each name with `before` in front, in metres and radians."""
    return {
        f"{prefix}{name}[{'m' if units_of(chain, name) is LENGTHS else 'rad'}]": q[:, j].tolist()
        for j, name in enumerate(chain.joint_names)
    }


def read_configurations(path: PathLike, chain: Chain, columns: PathLike | None = None) -> Array:
    """Joint values (m, n) of a file that has a column for each joint; readings beside them are not looked at.

    Raises:
        DhcalError: what is wrong, with file, line and column, and what would be right.
    """
    check_joint_names(chain)
    sheet = open_measurement_table(path, chain, columns)
    check_columns(sheet, chain)
    return joint_values(sheet, chain)


def configurations_text(q: Array, chain: Chain, comments: Sequence[str]) -> str:
    """The CSV text of joint values (m, n) in metres and radians, exact to the last digit.

    Raises:
        DhcalError: a joint's name cannot head a column.
    """
    check_joint_names(chain)
    return csv_text(joint_columns(q, chain), comments)


# A part of the samples, or what reads it; the second one travels light.
Part = Measurement | Callable[[], Measurement]


def iter_measurements(
    path: PathLike, chain: Chain, rows: int = CHUNK_SIZE
) -> Iterator[Callable[[], Measurement]]:
    """The fitted rows of a measurement file, at most so many a part, each read only when it is called.

    The file must lie where the parts are read: on a cluster, on a disk that all workers see.

    Raises:
        DhcalError: as `measurement_files.read_readings`, when a part is read.
    """
    source = os.fspath(path)
    head: tuple[int, str] | None = None
    start = first = count = 0
    try:
        with open(path, "rb") as file:
            place = 0
            for number, line in enumerate(file, 1):
                place += len(line)
                if not line.strip(b" \t,;\r\n") or line.lstrip().startswith(b"#"):
                    continue
                if head is None:
                    head, start, first = (number, line.decode("utf-8-sig").rstrip("\r\n")), place, number + 1
                    continue
                count += 1
                if count == rows:
                    yield partial(_file_part, source, chain, head, first, start, place)
                    start, first, count = place, number + 1, 0
    except OSError as error:
        raise DhcalError(f"{source}: cannot read it: {error.strerror}; give the path of a file") from error
    except UnicodeDecodeError as error:
        raise DhcalError(f"{source}: the header is not UTF-8; save the file as UTF-8") from error
    if head is not None and (count or first == head[0] + 1):
        yield partial(_file_part, source, chain, head, first, start, place)


def _file_part(
    source: str, chain: Chain, head: tuple[int, str], first: int, start: int, end: int
) -> Measurement:
    """The rows of a file from one byte to another."""
    with open(source, "rb") as file:
        file.seek(start)
        data = file.read(end - start)
    try:
        lines = data.decode().splitlines()
    except UnicodeDecodeError as error:
        place = start + error.start
        raise DhcalError(f"{source}: byte {place} is not UTF-8; save the file as UTF-8") from error
    return parse_measurements(parse_csv_table(source, [head, *enumerate(lines, first)]), chain).fit
