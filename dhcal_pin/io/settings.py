"""Robots in and out: URDF or DH file to a chain, a calibrated chain back to URDF and sidecar."""

from __future__ import annotations

import os

from .._typing import PathLike
from ..estimation.priors import Priors
from ..exceptions import DhcalError
from .tabular import read_toml

_MAX_VALUE = 1e300


def read_bounds(path: PathLike | None) -> dict[str, tuple[float, float]]:
    """A TOML file of least and largest values in m and rad by parameter name or pattern; none without it.

    Raises:
        DhcalError: a value is not a pair of numbers in order.
    """
    raw = read_toml(path) if path else {}
    for name, value in raw.items():
        pair = value if isinstance(value, list) and len(value) == 2 else []
        numbers = [v for v in pair if isinstance(v, int | float) and not isinstance(v, bool)]
        if len(numbers) != 2 or not numbers[0] < numbers[1]:
            raise DhcalError(
                f"{path}: {name} = {value!r} are no bounds; write the least and the largest value "
                'in m or rad, such as "d2" = [0.12, 0.13]'
            )
    return {name: (float(low), float(high)) for name, (low, high) in raw.items()}


def read_priors(choice: str | None) -> Priors | None:
    """`default`, `none`, or a TOML file of sigmas in m and rad by parameter name or pattern.

    Raises:
        DhcalError: neither, or a sigma is not a positive number.
    """
    if choice is None or choice in ("default", "none"):
        return choice  # pyright: ignore[reportReturnType]
    if not os.path.exists(choice):
        raise DhcalError(f"--priors {choice}: neither default, none, nor a file of sigmas by parameter")
    raw = read_toml(choice)
    for name, value in raw.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= _MAX_VALUE:
            raise DhcalError(
                f"{choice}: {name} = {value!r} is not a sigma; write a positive number in m or rad, "
                'such as "theta*" = 0.01'
            )
    return {name: float(value) for name, value in raw.items()}
