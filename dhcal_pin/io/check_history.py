"""History of checks of a calibrated robot: a file with one JSON object per line.

{"time": "2026-03-01T08:30:00+00:00", "robot": "arm.urdf", "data": ["check.csv"], "verdict": "changed",
 "what": "joint elbow_joint", "size": 0.00087, "std": 0.00006, "unit": "rad", "residual_rms_m": 0.00041,
 "expected_rms_m": 0.00009, "samples": 10}
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from datetime import UTC, datetime
from typing import Any

from .._frozen import frozen
from .._typing import PathLike
from ..exceptions import FileFormatError
from ..session import Recheck
from .tabular import read_text

VERDICTS = ("ok", "changed", "cannot say")
# Types of the fields of a line.
_NUMBER, _OPTIONAL_NUMBER = (int, float), (int, float, type(None))
_TYPES: dict[str, Any] = {
    "time": str,
    "robot": str,
    "data": list,
    "verdict": str,
    "what": str,
    "size": _OPTIONAL_NUMBER,
    "std": _OPTIONAL_NUMBER,
    "unit": (str, type(None)),
    "residual_rms_m": _NUMBER,
    "expected_rms_m": _OPTIONAL_NUMBER,
    "samples": int,
}


@frozen
class Check:
    """One check of a robot."""

    time: str  #: Time stamp with its zone.
    robot: str  #: File of the robot.
    data: list[str]  #: Files of the measurements.
    verdict: str  #: "ok", "changed" or "cannot say".
    what: str  #: What changed; empty if nothing is known to have changed.
    size: float | None  #: Size of the change, in `unit`.
    std: float | None  #: Standard deviation of the size.
    unit: str | None  #: "m" or "rad".
    residual_rms_m: float  #: RMS distance of the measured positions from those of the robot [m].
    expected_rms_m: float | None  #: RMS distance that noise and uncertainty explain [m]; None if unknown.
    samples: int  #: Number of samples.

    @classmethod
    def of(cls, result: Recheck, robot: str, data: Sequence[str]) -> Check:
        """Describe a check that was made now."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        known = result.to_dict()
        given = {"time": now, "robot": robot, "data": list(data)}
        return cls(**given, **{name: known[name] for name in _TYPES if name not in given})


def read_history(path: PathLike) -> list[Check]:
    """Read a history."""
    names = [field.name for field in fields(Check)]
    checks = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if not line.strip():
            continue
        where = f"{path}:{number}"
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):
            raise FileFormatError(f"{where}: not JSON; expected one check per line") from None
        if not isinstance(values, dict):
            raise FileFormatError(f"{where}: not a JSON object; expected one check per line")
        for name in names:
            if name not in values or not isinstance(values[name], _TYPES[name]):
                raise FileFormatError(f"{where}: {name} is missing or of a wrong type; expected a check")
        try:
            time = datetime.fromisoformat(values["time"])
        except ValueError:
            time = None
        if time is None or time.tzinfo is None or values["verdict"] not in VERDICTS:
            raise FileFormatError(f"{where}: time or verdict is wrong; expected a check")
        checks.append(Check(**{name: values[name] for name in names}))
    return checks


def history_text(checks: Sequence[Check]) -> str:
    """Return the content of a history."""
    return "".join(json.dumps(asdict(check)) + "\n" for check in checks)
