"""Checks of the arguments of public functions: a chain first, then measurements, and no paths or arrays."""

from __future__ import annotations

import os
from collections.abc import Iterable
from numbers import Real
from typing import Any

from ..exceptions import InvalidArgumentError
from ..robot.chain import Chain
from .base import Measurement


def require_chain(value: Any) -> None:
    """Raise an error if a value is not a chain."""
    if isinstance(value, Chain):
        return
    hint = ""
    if isinstance(value, Measurement):
        hint = "; the chain comes first, then the measurements"
    elif isinstance(value, str | os.PathLike):
        hint = "; read a robot with Chain.from_urdf(path, tip) or read_robot(path, tip)"
    raise InvalidArgumentError(f"chain: expected a Chain, got {_describe(value)}{hint}")


def as_measurements(
    value: Measurement | Iterable[Measurement], name: str = "data"
) -> tuple[Measurement, ...]:
    """Return one measurement or several as a tuple."""
    if isinstance(value, Measurement):
        return (value,)
    is_collection = isinstance(value, Iterable) and not isinstance(value, str | bytes)
    items: tuple[Any, ...] = tuple(value) if is_collection else (value,)
    for item in items:
        if not isinstance(item, Measurement):
            hint = ", such as Pose(q, poses) or Position(q, positions)"
            if isinstance(item, Chain):
                hint = "; the chain comes first, then the measurements"
            elif isinstance(item, str | os.PathLike):
                hint = "; read a file with read_measurements(path, chain)"
            elif isinstance(item, Real) and name == "holdout":
                hint = "; dhcal_pin.split(data, fraction) holds out a fraction of the samples"
            raise InvalidArgumentError(f"{name}: expected measurements, got {_describe(item)}{hint}")
    return items


def _describe(value: Any) -> str:
    """Name the type of a value, with a path in quotes."""
    if isinstance(value, str | os.PathLike):
        return f"the path {os.fspath(value)!r}"
    return f"an object of type {type(value).__name__}"
