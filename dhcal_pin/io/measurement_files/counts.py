"""Columns with counts of servos, `NAME[ticks]`: converted to joint values by a servo file."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..._typing import Array
from ...exceptions import FileFormatError, UnknownNameError
from ...messages import quote
from ...robot.chain import Chain
from ..tables import Column, DataTable
from .columns import SECOND_PREFIX

if TYPE_CHECKING:
    from ..servo_file import Servo, ServoFile

# Unit of counts in a header.
TICKS = "ticks"


def with_joint_values(table: DataTable, chain: Chain, servos: ServoFile | None) -> DataTable:
    """Return a table with the values of joints [rad] in place of counts, under the names of the joints."""
    if table.has_numbers_as_header or not any(TICKS in header for header in table.headers):
        return table
    counts = [column for column in table.columns.values() if column.unit == TICKS]
    if not counts:
        return table
    headers, numbers = list(table.headers), dict(table.numbers)
    for column in counts:
        name = column.name.removeprefix(SECOND_PREFIX)
        servo = _find_servo(table, chain, servos, column, name)
        prefix = column.name[: len(column.name) - len(name)]
        headers[column.index] = f"{prefix}{servo.joint}[rad]"
        numbers[column.index] = servo.angles(_checked_counts(table, column, servo))
    written = table.written_headers
    return replace(table, headers=tuple(headers), numbers=numbers, file_headers=written, has_counts=True)


def _find_servo(table: DataTable, chain: Chain, servos: ServoFile | None, column: Column, name: str) -> Servo:
    """Find the servo of a column and check that the robot has its joint."""
    where = f"{table.header_location}: column '{column.name}[{TICKS}]'"
    if servos is None:
        raise FileFormatError(
            f"{where} has counts of a servo; expected --servos FILE (calibrate, validate, inspect) with "
            "LeRobot's calibration (.json) or a servo file (.toml)"
        )
    servo = servos.of_column(name)
    if servo is None:
        motors = ", ".join(f"{each.name} (joint {each.joint})" for each in servos.servos)
        raise UnknownNameError(
            f"{where}: {servos.path} has no motor of {quote(name)}; its motors are {motors}"
        )
    servos.require_joint(
        servo, [joint.name for joint in chain.urdf.joints if joint.type != "fixed"], chain.urdf.source
    )
    if chain.urdf.joint(servo.joint).type == "prismatic":
        raise FileFormatError(
            f"{where}: joint {quote(servo.joint)} is prismatic; expected its value, such as [mm]"
        )
    return servo


def _checked_counts(table: DataTable, column: Column, servo: Servo) -> Array:
    """Return the counts of a column; those that are no number are left to the reader."""
    values = table.values(column.index)
    is_number = np.isfinite(values)
    for is_wrong, problem in (
        (values != np.round(values), "is not a whole number"),
        ((values < 0) | (values >= servo.resolution), "is out of range"),
    ):
        if (rows := np.flatnonzero(is_wrong & is_number)).size:
            row = int(rows[0])
            text = table.cells[row][column.index].strip()
            raise FileFormatError(
                f"{table.cell_location(row, column.name)}: {quote(text)} {problem}; expected counts from 0 "
                f"to {servo.resolution - 1}"
            )
    return values
