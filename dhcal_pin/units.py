"""Text files read and tables written: units, and sheets with a header."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from .exceptions import DhcalError

# Divisors, so that 606.8 mm is the double nearest to 0.6068 m. Both signs for micro are in use.
LENGTHS = {"m": 1.0, "cm": 1e2, "mm": 1e3, "um": 1e6, "\u00b5m": 1e6, "\u03bcm": 1e6, "in": 1 / 0.0254}


ANGLES = {"rad": 1.0, "mrad": 1e3, "deg": 180.0 / np.pi}


# What a column of ours holds, and the units it can have.
UNITS: Mapping[str, Mapping[str, float]] = {"length": LENGTHS, "angle": ANGLES, "number": {}, "text": {}}
# Readings beyond a thousand kilometres are mistakes of unit.
_MOST = 1e6


def parse_noise(text: str, what: str = "--noise") -> tuple[float, float]:
    """Standard deviations in m and rad from a text such as `0.1mm` or `0.1mm,0.01deg`.

    Args:
        text: one length, one angle, or both.
        what: what an error calls it.

    Raises:
        DhcalError: not a number with a unit, a negative one, or one quantity twice.
    """
    out: dict[str, float] = {}
    for part in text.split(","):
        where = f"{what} {part.strip()!r}"
        match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([a-z\u00b5\u03bc]+)\s*", part)
        kind = "length" if match and match[2] in LENGTHS else "angle"
        units = LENGTHS if kind == "length" else ANGLES
        if not match or match[2] not in units:
            raise DhcalError(f"{where}: write a number with a unit, as 0.1mm or 0.1mm,0.01deg")
        if kind in out:
            raise DhcalError(f"{where}: a second {kind}; write one length and one angle, as 0.1mm,0.01deg")
        try:
            out[kind] = float(match[1]) / units[match[2]]
        except ValueError:
            raise DhcalError(f"{where}: {match[1]!r} is not a number; write one such as 0.1") from None
        if not 0 <= out[kind] <= _MOST:
            raise DhcalError(f"{where}: must be between 0 and {_MOST:g} m or rad")
    return out.get("length", 0.0), out.get("angle", 0.0)
