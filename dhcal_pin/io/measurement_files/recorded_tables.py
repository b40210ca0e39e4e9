"""Recordings in two tables: joint positions over time, and measured positions or poses over time.

Both tables have the column `time[s]`. The stops of the arm become the rows of a measurement file, see
`standstills`.
"""

from __future__ import annotations

import numpy as np

from ..._typing import Array, PathLike
from ...exceptions import DhcalError, FileFormatError
from ...formatting import format_count, list_first
from ...measurements.pose import Pose
from ...robot.chain import Chain
from ...units import TIMES
from ..tables import DataTable
from . import reading
from .columns import QUATERNION, ROTVEC
from .standstills import JointSeries, PoseSeries, describe_stops, find_stops, have_common_times, stops_text
from .targets import parse_tool_values

_TIME, _XYZ = "time", ("x", "y", "z")


def convert_tables(
    joint_path: PathLike, pose_path: PathLike, chain: Chain, columns: PathLike | None
) -> tuple[str, list[str]]:
    """Make the text of a measurement file from the stops of two recorded tables; return it, and notes."""
    joint_table = _read(joint_path, chain, columns, chain.joint_names)
    pose_table = _read(pose_path, chain, columns, (*_XYZ, *QUATERNION, *ROTVEC))
    joint_times, pose_times = _times(joint_table), _times(pose_table)
    clocks: list[str] = []
    if not have_common_times(joint_times, pose_times):
        joint_times, pose_times = joint_times - joint_times[0], pose_times - pose_times[0]
        clocks.append("the files have no time in common; their first rows are taken to be of one time")
    joints = JointSeries(
        tuple(chain.joint_names), joint_times, reading.parse_joint_positions(joint_table, chain)
    )
    data = parse_tool_values(pose_table, chain)
    rotations = data.rotations() if isinstance(data, Pose) else None
    poses = PoseSeries(pose_times, data.positions(), rotations, "")
    try:
        stops = find_stops(joints, poses)
    except DhcalError as error:
        raise FileFormatError(f"{joint_table.source}, {pose_table.source}: {error}") from None
    notes = describe_stops(stops, joint_table.source, pose_table.source, "", clocks)
    for table in (joint_table, pose_table):
        if table.bad_rows:
            (line, reason), count = next(iter(table.bad_rows.items())), len(table.bad_rows)
            notes.append(
                f"{table.source}: {format_count(count, 'row')} left out, the first in line {line}: {reason}"
            )
    return stops_text(stops, joints.names, chain, notes), notes


def _read(path: PathLike, chain: Chain, columns: PathLike | None, names: tuple[str, ...]) -> DataTable:
    """Read the rows of a table that have a time and all numbers of some columns, in the order of time."""
    table = reading.open_measurement_table(path, chain, columns)
    if _TIME not in table.columns or table.columns[_TIME].unit not in TIMES:
        headers = list_first([*map(repr, table.headers)])
        raise FileFormatError(
            f"{table.header_location}: no column `{_TIME}[s]` among {headers}; expected the time of each row "
            f"[{', '.join(TIMES)}], or a column map (--columns) that names it"
        )
    used = [table.columns[name].index for name in (_TIME, *names) if name in table.columns]
    table = table.without_bad_rows(used)
    if not len(table.lines):
        table.require_good_rows()
    steps = np.diff(_times(table))
    if (wrong := np.flatnonzero(steps < 0)).size:
        raise FileFormatError(
            f"{table.cell_location(int(wrong[0]) + 1, _TIME)}: {-steps[wrong[0]]:g} s before the row above "
            "it; expected rows in the order of time"
        )
    repeated = (np.flatnonzero(steps == 0) + 1).tolist()
    return table.without_rows(dict.fromkeys(repeated, "its time is that of the row above it"))


def _times(table: DataTable) -> Array:
    """Return the times of a table [s]."""
    column = table.columns[_TIME]
    # Times of a day or since 1970 are large.
    return table.finite_numbers(column) / column.divisor(TIMES, table.header_location)
