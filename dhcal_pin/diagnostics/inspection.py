"""What a measurement file contains, without a fit: columns, ranges, coverage, and rows that cannot be used.

Without a robot, every column with the unit of a length or an angle that is no measured value counts as a
joint. With a robot, ranges are compared with the joint limits, and the checks of `input_checks` are made.

The coverage of a revolute joint is the share of 5° bins that its positions visited: of those within the joint
limits if the robot is known, otherwise of all bins between its smallest and its largest position. Joint
positions that differ by less than a milliradian and a millimetre are one configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import field, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from .._frozen import frozen
from .._typing import Array, PathLike
from ..exceptions import DhcalError
from ..formatting import Table, join_names
from ..io.measurement_files import columns as file_columns
from ..io.measurement_files.map_proposal import header_problem, propose_map, skip_line
from ..io.measurement_files.reading import (
    MeasurementFile,
    open_measurement_table,
    parse_measurements,
)
from ..io.servo_file import ServoFile
from ..io.tables import Column, DataTable, TextLayout, read_table
from ..measurements.mounting import MountedRig
from ..robot.chain import Chain
from ..robot.coverage import BIN_WIDTH_RAD, coverage_of
from ..units import ANGLES, LENGTHS
from .input_checks import find_input_warnings, find_payload_warnings, first_equal_rows

if TYPE_CHECKING:
    from ..calibration import Result

# Decimals to which joint positions of one configuration are equal [rad or m].
_CONFIGURATION_DECIMALS = 3
# What is estimated to find what happened during a measurement.
SESSION_PARAMETERS = "minimal,base,tool"
# A column is numeric if at least this share of its cells are numbers.
_MIN_NUMERIC_SHARE = 0.5


@frozen
class ColumnSummary:
    """Content of a column."""

    name: str  #: Name in the header, or number of a column without a name.
    unit: str  #: Unit in the header.
    #: "joint", "measured", "sigma", "condition", "other" (such as the set or commanded positions),
    #: or "ignored".
    role: str
    minimum: float | None = None  #: Smallest number, in `unit`; None for texts.
    maximum: float | None = None  #: Largest number, in `unit`; None for texts.
    lower: float | None = None  #: Lower joint limit, in `unit`; None without a robot or a limit.
    upper: float | None = None  #: Upper joint limit, in `unit`; None without a robot or a limit.
    #: Share of the 5° bins that were visited; None for columns other than revolute joints.
    coverage: float | None = None
    #: Number of rows with each text; empty for numbers.
    counts: Mapping[str, int] = field(default_factory=dict)


@frozen
class FileInspection:
    """Content of a measurement file."""

    path: str  #: Name of the file.
    form: str  #: How it is written, such as "semicolons, decimal commas".
    rows: int  #: Number of rows with values, usable or not.
    first_line: int  #: Line of the first row.
    last_line: int  #: Line of the last row.
    kind: str  #: Measurement kind; empty if the columns are those of none.
    columns: tuple[ColumnSummary, ...]  #: Content of each column.
    configurations: int | None  #: Number of different configurations; None if no joint is known.
    #: Lines that are equal to an earlier one in all joints and measured values.
    repeated_lines: tuple[int, ...]
    bad_rows: Mapping[int, str]  #: Reason why a row cannot be used, by line.
    problem: str = ""  #: Error that `dhcal calibrate` would raise; empty if it reads the file.
    #: Lines of a column map that would read a file with unknown columns; empty if not needed.
    column_map: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  #: Suspected mistakes, one sentence each.
    #: What of the file is not read, such as further sheets, and what it lacks for a calibration.
    notes: tuple[str, ...] = ()


def inspect_file(
    source: PathLike | Any,
    chain: Chain | None,
    columns: PathLike | None,
    rig: MountedRig | None,
    servos: ServoFile | None,
    sheet: str,
) -> FileInspection:
    """Say what a measurement file contains."""
    if chain is None:
        table = _below_titles(read_table(source, TextLayout(sheet=sheet)), None)
        return _inspect_table(file_columns.with_known_spelling(table, None), None)
    table = open_measurement_table(source, chain, columns, servos, sheet)
    try:
        file = parse_measurements(table, chain, skip_bad_rows=True, rig=rig)
    except DhcalError as error:
        inspection = _inspect_table(_below_titles(table, chain), chain)
        if file_columns.needs_column_map(table, chain):
            lines = tuple(propose_map(table, chain))
            way = ", or use the column map below" if lines else ""
            return replace(inspection, problem=f"{header_problem(table, chain)}{way}", column_map=lines)
        return replace(inspection, problem=str(error))
    inspection, notes = _inspect_table(table, chain), []
    warnings = [*find_input_warnings(chain, file), *find_payload_warnings(chain, file)]
    if (fit := _calibrated(chain, file)) is not None:
        # With other columns or units it may be a good calibration.
        notes = [] if warnings else _calibration_notes(fit)
        warnings += [item.finding for item in fit.session.found] if fit.session else []
    return replace(
        inspection,
        configurations=_count_configurations(file),
        bad_rows=file.bad_rows,
        warnings=tuple(warnings),
        notes=(*inspection.notes, *notes),
    )


def _below_titles(table: DataTable, chain: Chain | None) -> DataTable:
    """Return the table below lines of titles with a note, or the table itself if it has no titles."""
    below = table.below_titles
    if below is None or not file_columns.has_titles(table, chain):
        return table
    note = f"the names of the columns seem to be in line {below.header_line}; in a column map, "
    return replace(below, notes=(*below.notes, f"{note}{skip_line(below)} skips the lines above it"))


def _calibrated(chain: Chain, file: MeasurementFile) -> Result | None:
    """Calibrate with a file, to see what happened during its measurement; None if it is impossible."""
    from ..calibration import calibrate  # lazy import: slow

    try:
        return calibrate(chain, file.data, SESSION_PARAMETERS, extend="none")
    except DhcalError:
        return None


def _calibration_notes(fit: Result) -> list[str]:
    """Say what a file lacks for a calibration with it alone: joints that move, and enough poses."""
    from ..calibration.verdict import needed_poses  # lazy import, as the following: slow
    from ..identifiability.null_space import ObservabilityProbe

    notes, names = [], fit.chain.joint_names
    unmoved = [names[j] for j in ObservabilityProbe(fit.problem, fit.x).unmoved_joints()]
    if unmoved:
        joints = f"{'joint' if len(unmoved) == 1 else 'joints'} {join_names(unmoved)}"
        notes.append(
            f"{joints} never moved; a calibration with this file alone holds only where "
            f"{'it stands' if len(unmoved) == 1 else 'they stand'}"
        )
    if count := needed_poses(fit):
        notes.append(
            f"too few poses for a calibration with this file alone; measure at least {count} different ones"
        )
    return notes


def _names(table: DataTable) -> Mapping[str, Column]:
    """Return the columns by name; none if the header cannot be read."""
    try:
        return table.columns
    except DhcalError:
        return {}


def _is_numeric(table: DataTable, index: int) -> bool:
    """Return whether most cells of a column are numbers."""
    values = table.values(index)
    return np.isfinite(values).sum() >= max(1, _MIN_NUMERIC_SHARE * len(values))


def _value_table(table: DataTable, chain: Chain | None) -> DataTable:
    """Return a table without the columns of joints whose names are those of measured values."""
    if chain is not None:
        return file_columns.value_table(table, chain)
    unambiguous = table.without_columns(file_columns.AMBIGUOUS_COLUMNS)
    try:
        file_columns.find_kind(unambiguous)
    except DhcalError:
        return table
    return unambiguous


def _role(column: Column, chain: Chain | None, measured: Set[str]) -> str:
    """Return the role of a column; without a robot, an unknown column with a unit is a joint."""
    name = column.name
    if name in measured:
        return "sigma" if name.startswith("sigma_") else "measured"
    if name in file_columns.AUXILIARY_COLUMNS:
        return "other"
    if file_columns.is_condition(name, chain):
        return "condition"
    if chain is None:
        return "joint" if column.unit in {*LENGTHS, *ANGLES} else "ignored"
    return "joint" if name.removeprefix(file_columns.SECOND_PREFIX) in chain.joint_names else "ignored"


def _inspect_table(table: DataTable, chain: Chain | None) -> FileInspection:
    """Summarize the columns and rows of a table."""
    lines = sorted([*table.lines, *table.bad_rows])
    named = {column.index: column for column in _names(table).values()}
    kind, measured = "", set[str]()
    if named:
        values = _value_table(table, chain)
        measured = values.columns.keys() & file_columns.VALUE_COLUMNS
        with suppress(DhcalError):
            kind = file_columns.find_kind(values).kind
    numeric = [
        i
        for i in named
        if _role(named[i], chain, measured) not in ("other", "ignored") and _is_numeric(table, i)
    ]
    usable = table.without_bad_rows(numeric)
    summaries = tuple(
        _summarize_column(
            usable, named.get(i) or Column(str(i + 1), "", i), chain if i in named else None, measured
        )
        for i in range(len(table.headers))
        if i in named or table.has_numbers_as_header or any(row[i].strip() for row in table.cells)
    )
    compared = [
        _comparable(usable, column)
        for column in named.values()
        if _role(column, chain, measured) in ("joint", "measured")
    ]
    original = first_equal_rows(compared)
    repeated = np.flatnonzero(original < np.arange(len(original)))
    return FileInspection(
        path=table.source,
        form=table.description,
        rows=len(lines),
        first_line=lines[0],
        last_line=lines[-1],
        kind=kind,
        columns=summaries,
        configurations=None,
        repeated_lines=tuple(usable.lines[row] for row in repeated.tolist()),
        bad_rows=usable.bad_rows,
        notes=table.notes,
    )


def _comparable(table: DataTable, column: Column) -> Array:
    """Return the numbers or texts of a column, (m,)."""
    is_numeric = _is_numeric(table, column.index)
    return table.values(column.index) if is_numeric else np.array(table.text(column), str)


def _summarize_column(
    table: DataTable, column: Column, chain: Chain | None, measured: Set[str]
) -> ColumnSummary:
    """Summarize one column."""
    is_unnamed = not table.headers[column.index] or table.has_numbers_as_header
    role = "ignored" if is_unnamed else _role(column, chain, measured)
    if not _is_numeric(table, column.index):
        texts, counts = np.unique(table.text(column), return_counts=True)
        by_text = dict(zip(texts.tolist(), counts.tolist(), strict=True))
        return ColumnSummary(column.name, column.unit, role, counts=by_text)
    values = table.values(column.index)
    values = values[np.isfinite(values)]
    summary = ColumnSummary(
        column.name, column.unit, role, float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
    )
    if role != "joint":
        return summary
    name = column.name.removeprefix(file_columns.SECOND_PREFIX)
    divisor = {**LENGTHS, **ANGLES}.get(column.unit)
    if divisor is None or (chain is not None and column.unit not in file_columns.joint_units(chain, name)):
        return summary
    if chain is None:
        coverage = _coverage_of_range(values / divisor) if column.unit in ANGLES else None
        return replace(summary, coverage=coverage)
    j = chain.joint_names.index(name)
    lower, upper = (
        float(limit * divisor) if np.isfinite(limit) else None for limit in (chain.lower[j], chain.upper[j])
    )
    coverage = None if chain.is_prismatic[j] else coverage_of(chain, j, values / divisor).share
    return replace(summary, lower=lower, upper=upper, coverage=coverage)


def _coverage_of_range(values: Array) -> float:
    """Return the share of visited bins between the smallest and the largest of angles (m,) [rad]."""
    bins = np.unique(np.rint(values / BIN_WIDTH_RAD))
    return len(bins) / (bins[-1] - bins[0] + 1)


def _count_configurations(file: MeasurementFile) -> int | None:
    """Count the different configurations of a file."""
    if not file.data.configurations_per_row:
        return None
    return len(np.unique(np.round(file.data.configurations(), _CONFIGURATION_DECIMALS), axis=0))


# --- table for people ------------------------------------------------------------------------------


def column_table(columns: Sequence[ColumnSummary]) -> Table:
    """Make a table of the columns of numbers; those of one rotation, and of sigmas, share a row."""
    is_foreign = all(column.role == "ignored" for column in columns)
    numeric = [
        column
        for column in columns
        if column.minimum is not None and column.maximum is not None
        if is_foreign or column.role != "ignored"
    ]
    rows = []
    for _, group in groupby(numeric, _group_key):
        members = list(group)
        first, last = members[0], members[-1]
        names = first.name if len(members) == 1 else f"{first.name} to {last.name}"
        low = min(column.minimum for column in members if column.minimum is not None)
        high = max(column.maximum for column in members if column.maximum is not None)
        limits = [f"{limit:.6g}" if limit is not None else "–" for limit in (first.lower, first.upper)]
        has_limits = first.lower is not None or first.upper is not None
        coverage = "" if first.coverage is None else f"{100 * first.coverage:.0f} %"
        cells = [f"{low:.6g}", f"{high:.6g}", " to ".join(limits) if has_limits else "", coverage]
        rows.append([names, first.unit, *cells])
    return Table(["column", "unit", "smallest", "largest", "limits", "5° bins"], rows, n_text_columns=2)


def _group_key(column: ColumnSummary) -> tuple[str, ...]:
    """Return the key of the columns that share a row of the table."""
    name = column.name
    for group in (file_columns.QUATERNION, file_columns.ROTVEC, file_columns.COMMANDED, file_columns.AFTER):
        if name in group:
            return (*group, column.unit)
    return ("sigma", column.unit) if column.role == "sigma" else (name,)
