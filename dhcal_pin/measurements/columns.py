"""Columns of measurement files.

A measurement kind declares its columns once, in `Measurement.COLUMNS`. Reading, writing and checking of files
follow from this declaration. Each numeric column `NAME` may be accompanied by a column `sigma_NAME` with its
standard deviations. Values are in metres and radians; units are the concern of the package `io`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..exceptions import InvalidArgumentError

# Largest plausible distance from the tip to a measured point of the tool [m].
MAX_TOOL_OFFSET = 1.0
# Largest plausible distance from the robot to an instrument [m]; a wire may cross a hall.
MAX_INSTRUMENT_DISTANCE = 50.0
# Smallest plausible length [m]; nobody sets up shorter ones on purpose.
MIN_LENGTH = 2e-3

# Map from the reach of a robot [m] to the smallest and largest plausible value [m].
PlausibleRange = Callable[[float], tuple[float, float]]


def displacement_range(reach: float) -> tuple[float, float]:
    """Return the plausible distances [m] between two positions of the tool point."""
    return 0.0, 2 * (reach + MAX_TOOL_OFFSET)


def point_distance_range(reach: float) -> tuple[float, float]:
    """Return the plausible distances [m] between two points that the tool can touch."""
    return MIN_LENGTH, 2 * (reach + MAX_TOOL_OFFSET)


def instrument_range(reach: float) -> tuple[float, float]:
    """Return the plausible distances [m] between the tool point and a part of an instrument."""
    return MIN_LENGTH, reach + MAX_INSTRUMENT_DISTANCE


@frozen
class Column:
    """Column of a measurement file."""

    name: str  # Name in the header, without the unit
    # "length" [m], "angle" [rad], "acceleration" [m/s2], "pixel" [px], "text", or "remark": a text that only
    # people need, so that it may be empty, and files of other kinds may have it, too.
    quantity: Literal["length", "angle", "acceleration", "pixel", "text", "remark"]
    # Argument of the kind's constructor that the column fills. Several numeric columns with the same argument
    # are stacked, (m, k).
    argument: str = ""
    # Whether the value is zero by definition, so that files have only its standard deviation.
    is_implied: bool = False
    is_common: bool = False  # Whether all rows of a file must have the same text; the argument is that text
    # Plausible values of a length; None if it is not checked by itself.
    plausible_range: PlausibleRange | None = None

    @property
    def is_numeric(self) -> bool:
        """Whether the column has numbers, and therefore may have standard deviations."""
        return self.quantity not in ("text", "remark")

    @property
    def sigma_name(self) -> str:
        """Name of the column with the standard deviations."""
        return f"sigma_{self.name}"


def length_columns(
    argument: str, *names: str, is_implied: bool = False, plausible_range: PlausibleRange | None = None
) -> tuple[Column, ...]:
    """Declare columns of lengths that fill one argument of the constructor."""
    return tuple(
        Column(name, "length", argument, is_implied=is_implied, plausible_range=plausible_range)
        for name in names
    )


def angle_columns(argument: str, *names: str) -> tuple[Column, ...]:
    """Declare columns of angles that fill one argument of the constructor."""
    return tuple(Column(name, "angle", argument) for name in names)


def text_column(argument: str, name: str, is_common: bool = False) -> tuple[Column, ...]:
    """Declare a column of text."""
    return (Column(name, "text", argument, is_common=is_common),)


def file_columns(columns: Sequence[Column]) -> dict[str, str]:
    """Return the quantity of each column of a file, in the order in which files are written."""
    sigmas = {column.sigma_name: column.quantity for column in columns if column.is_numeric}
    # The columns of standard deviations follow the last numeric column.
    last = max((i for i, column in enumerate(columns) if column.is_numeric), default=-1)
    out: dict[str, str] = {}
    for i, column in enumerate(columns):
        if not column.is_implied:
            out[column.name] = column.quantity
        if i == last:
            out |= sigmas
    return out


def stack_columns(values: Mapping[str, Any], names: Iterable[str]) -> Array:
    """Stack numeric columns of a file."""
    columns = [values[name] for name in names]
    return columns[0] if len(columns) == 1 else np.stack(columns, -1)


def stack_sigmas(values: Mapping[str, Any], columns: Iterable[Column]) -> Array | None:
    """Stack the standard deviations of some columns of a file."""
    names = [column.sigma_name for column in columns]
    return stack_columns(values, names) if names and all(name in values for name in names) else None


def common_text(texts: Sequence[str], where: str) -> str:
    """Return the text that all rows of a column have."""
    distinct = sorted(set(texts))
    if len(distinct) != 1:
        raise InvalidArgumentError(
            f"column {where!r} has the names {', '.join(distinct)}; expected one name per file: "
            "split the file by name"
        )
    return distinct[0]
