"""Text of measurement files: samples of any kind, and joint positions alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..._typing import Array
from ...exceptions import FileFormatError
from ...measurements.base import Measurement
from ...robot.chain import Chain
from ...robot.conditions import CONDITIONS
from ...units import ANGLES, LENGTHS, UNITS, column_header
from ..tabular import csv_text
from .columns import ISO_POINT, SECOND_PREFIX, check_joint_names, condition_columns, joint_units

# Unit of prismatic joints beside the unit of revolute joints.
_LENGTH_UNITS = {"rad": "m", "deg": "mm"}
# Decimals of planned joint positions in degrees and millimetres: 0.36 arc seconds.
_DEGREE_DECIMALS = 4


def measurement_text(data: Measurement, chain: Chain, comments: Sequence[str] = ()) -> str:
    """Return the CSV text of samples of any kind."""
    check_joint_names(chain)
    values = data.to_columns()
    if clashes := sorted(set(values) & set(chain.joint_names)):
        raise FileFormatError(
            f"{chain.urdf.source}: joint {clashes[0]!r} has the name of a column of kind {data.kind}; "
            "rename the joint"
        )
    count = data.configurations_per_row
    configurations = np.split(data.configurations(), max(count, 1))
    columns: dict[str, Any] = {}
    for prefix, q in zip(("", SECOND_PREFIX)[:count], configurations, strict=False):
        columns |= joint_columns(q, chain, prefix)
    return csv_text(columns | value_columns(data) | _condition_columns(data, chain), comments)


def value_columns(data: Measurement) -> dict[str, list[Any]]:
    """Return the columns of measured values and standard deviations, in metres, radians and pixels."""
    columns: dict[str, list[Any]] = {}
    for name, values in data.to_columns().items():
        unit = next(iter(UNITS[data.columns[name]]), "")
        columns[column_header(name, unit)] = values.tolist() if unit else list(values)
    return columns


def _condition_columns(data: Measurement, chain: Chain) -> dict[str, list[Any]]:
    """Return the columns of the conditions that are known of the samples."""
    columns: dict[str, list[Any]] = {}
    for name, names in condition_columns(chain).items():
        values = getattr(data.recorded, name, None)
        if values is not None:
            unit = next(iter(UNITS[CONDITIONS[name].quantity]), "")
            by_column = zip(names, values.reshape(len(values), -1).T.tolist(), strict=True)
            columns |= {column_header(column, unit): numbers for column, numbers in by_column}
    return columns


def configurations_text(
    q: Array,
    chain: Chain,
    comments: Sequence[str],
    angle_unit: str,
    iso_points: Sequence[str] = (),
) -> str:
    """Return the CSV text of joint positions, with the points of a test according to ISO 9283 if given."""
    check_joint_names(chain)
    decimals = _DEGREE_DECIMALS if angle_unit == "deg" else None
    columns = joint_columns(q, chain, angle_unit=angle_unit, decimals=decimals)
    return csv_text({ISO_POINT: iso_points} | columns if iso_points else columns, comments)


def joint_columns(
    q: Array, chain: Chain, prefix: str = "", angle_unit: str = "rad", decimals: int | None = None
) -> dict[str, list[float]]:
    """Return the columns of joint positions for a CSV file."""
    columns = {}
    for name, values in zip(chain.joint_names, q.T, strict=True):
        is_length = joint_units(chain, name) is LENGTHS
        unit = _LENGTH_UNITS[angle_unit] if is_length else angle_unit
        factor = LENGTHS[unit] if is_length else ANGLES[unit]
        scaled = values * factor
        columns[f"{prefix}{name}[{unit}]"] = (
            scaled if decimals is None else np.round(scaled, decimals) + 0.0
        ).tolist()
    return columns
