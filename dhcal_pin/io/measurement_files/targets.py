"""Files of targets that a tool shall reach, and of joint positions alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..._frozen import frozen
from ..._typing import Array, PathLike
from ...exceptions import FileFormatError
from ...measurements.pose import Pose
from ...measurements.position import Position
from ...robot.chain import Chain
from ...robot.conditions import Conditions
from ..tables import DataTable, TextLayout, read_table
from . import reading
from .columns import check_columns, check_joint_names, find_kind, value_table

# Layout of files of targets.
TARGETS = TextLayout(header_example="x[mm],y[mm],z[mm]")


@frozen(eq=False)
class TargetPoses:
    """Positions or poses that a tool shall reach."""

    source: str  # Name of the file
    values: Array  # Positions, shape (m, 3) [m], or poses, shape (m, 4, 4), if the file has rotations
    # Joint positions near which solutions are wanted, shape (m, n) [rad or m]; None without the columns.
    near: Array | None
    units: Mapping[str, str]  # Unit that each column was written in
    lines: Array  # Line of each target in the file, shape (m,)
    notes: tuple[str, ...]  # Sentences on what of the file is not used
    conditions: Conditions | None  # Conditions at the targets; None without columns of conditions


def read_targets(path: PathLike, chain: Chain) -> TargetPoses:
    """Read target positions or poses of a tool.

    Args:
        path: File with the columns of a position or a pose; those of the joints are optional.
        chain: Robot with the tool.

    Returns:
        The targets.

    Raises:
        FileFormatError: The columns are those of another measurement kind.
    """
    check_joint_names(chain)
    table = read_table(path, TARGETS)
    table.require_good_rows()
    ignored = check_columns(table, chain)
    data = parse_tool_values(table, chain)
    has_joints = bool(set(chain.joint_names) & set(table.columns))
    near = reading.parse_joint_positions(table, chain) if has_joints else None
    values = data.poses if isinstance(data, Pose) else data.positions()
    conditions = reading.with_conditions(data, table, chain).recorded
    notes = (*table.notes, *reading.ignored_columns_note(ignored))
    return TargetPoses(table.source, values, near, reading.column_units(table), data.rows, notes, conditions)


def parse_tool_values(table: DataTable, chain: Chain) -> Pose | Position:
    """Parse the positions or poses of a table, without joint positions."""
    measured = value_table(table, chain)
    kind = find_kind(measured)
    if kind not in (Pose, Position):
        raise FileFormatError(
            f"{table.header_location}: the columns are those of kind {kind.kind}; expected "
            "x[mm],y[mm],z[mm], with or without qw,qx,qy,qz or rx[rad],ry[rad],rz[rad]"
        )
    placeholder = np.zeros((len(table.lines), chain.n_joints))
    data = reading.build_measurement(table, kind, [placeholder], reading.parse_values(measured, kind), chain)
    assert isinstance(data, Pose | Position)
    return data


def read_configurations(
    path: PathLike, chain: Chain, columns: PathLike | None = None, sheet: str = ""
) -> Array:
    """Read the joint positions of a file; measured values beside them are ignored."""
    table = reading.open_measurement_table(path, chain, columns, sheet=sheet)
    with table.notes_in_errors():
        table.require_good_rows()
        check_columns(table, chain)
        return reading.parse_joint_positions(table, chain)
