"""Units of lengths and angles in files and options.

All computations use SI units. A value v in a unit with divisor d is v/d in m or rad.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from .exceptions import InvalidArgumentError

# Units per metre and units per radian. They divide because 606.8/1000 is the double nearest to 0.6068, while
# 606.8·0.001 is not. Micro has two code points in Unicode: U+00B5 and U+03BC.
LENGTHS = {"m": 1.0, "cm": 1e2, "mm": 1e3, "um": 1e6, "\u00b5m": 1e6, "\u03bcm": 1e6, "in": 1 / 0.0254}
ANGLES = {"rad": 1.0, "mrad": 1e3, "deg": 180.0 / np.pi}
# Units of accelerations, per m/s².
ACCELERATIONS = {"m/s2": 1.0, "g": 1 / 9.80665, "mg": 1e3 / 9.80665}
# Units of image coordinates.
PIXELS = {"px": 1.0}
# Units per second, per kilogram, and of temperatures.
TIMES = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60, "h": 1 / 3600}
MASSES = {"kg": 1.0, "g": 1e3}
TEMPERATURES = {"degC": 1.0, "°C": 1.0}
# Units allowed for each content type of a column.
UNITS: Mapping[str, Mapping[str, float]] = {
    "length": LENGTHS,
    "angle": ANGLES,
    "acceleration": ACCELERATIONS,
    "pixel": PIXELS,
    "time": TIMES,
    "mass": MASSES,
    "temperature": TEMPERATURES,
    "direction": {},
    "number": {},
    "text": {},
    "remark": {},
}
# Largest accepted length or angle [m or rad]; a larger value has the wrong unit.
MAX_SI_VALUE = 1e6


def column_header(name: str, unit: str) -> str:
    """Return the header cell of a column."""
    return f"{name}[{unit}]" if unit else name


def parse_noise(text: str, label: str = "--noise") -> tuple[float, float]:
    """Parse standard deviations of position and orientation."""
    out: dict[str, float] = {}
    for part in text.split(","):
        where = f"{label} {part.strip()!r}"
        match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([a-z\u00b5\u03bc]+)\s*", part)
        quantity = "length" if match and match[2] in LENGTHS else "angle"
        units = LENGTHS if quantity == "length" else ANGLES
        if not match or match[2] not in units:
            raise InvalidArgumentError(
                f"{where}: not a number with a unit; expected for example 0.1mm or 0.1mm,0.01deg"
            )
        if quantity in out:
            raise InvalidArgumentError(
                f"{where}: second {quantity}; expected one length and one angle, for example 0.1mm,0.01deg"
            )
        try:
            out[quantity] = float(match[1]) / units[match[2]]
        except ValueError:
            raise InvalidArgumentError(
                f"{where}: {match[1]!r} is not a number; expected for example 0.1"
            ) from None
        if not 0 <= out[quantity] <= MAX_SI_VALUE:
            raise InvalidArgumentError(
                f"{where}: standard deviation must lie in [0, {MAX_SI_VALUE:g}] m or rad"
            )
    return out.get("length", 0.0), out.get("angle", 0.0)
