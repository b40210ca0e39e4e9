"""Settings that command-line options and TOML files give to a calibration: bounds, priors, payload."""

from __future__ import annotations

import os
import re

from .._typing import PathLike
from ..estimation.priors import MAX_PRIOR_STD, MIN_PRIOR_STD, Priors
from ..exceptions import InvalidArgumentError
from ..robot.transmission import Payload
from . import toml_table as toml
from .sidecar import MAX_PAYLOAD_DISTANCE_M, MAX_PAYLOAD_KG
from .toml_table import Key, TomlTable

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PAYLOAD = re.compile(rf"({_NUMBER})kg(?:@({_NUMBER}),({_NUMBER}),({_NUMBER})(mm|cm|m))?")
# Bounds of a parameter. Unlike other numbers, a bound may be infinite.
BOUNDS = Key(
    'the least and the largest value in m or rad, such as "d2" = [0.12, 0.13]',
    {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
    lambda value: (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(bound, float) or toml.is_number(bound) for bound in value)
        and value[0] < value[1]
    ),
    lambda value: (float(value[0]), float(value[1])),
)
# Prior standard deviation of a parameter.
PRIOR = toml.number(
    MIN_PRIOR_STD,
    MAX_PRIOR_STD,
    description=f"a positive standard deviation in m or rad from {MIN_PRIOR_STD:g} to {MAX_PRIOR_STD:g}, "
    'such as "theta*" = 0.01; use --fix for a parameter that is known exactly',
)
# Metres per unit of the centre of a payload.
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def read_bounds(path: PathLike | None) -> dict[str, tuple[float, float]]:
    """Read the bounds of parameters."""
    return TomlTable.read(path).values_by_name(BOUNDS) if path else {}


def read_priors(choice: str | None) -> Priors | None:
    """Read the prior standard deviations of parameters."""
    if choice is None or choice == "default" or choice == "none":
        return choice
    if not os.path.exists(choice):
        raise InvalidArgumentError(
            f"--priors {choice}: unknown choice; expected default, none, or a file of standard deviations"
        )
    return TomlTable.read(choice).values_by_name(PRIOR)


def parse_payload(text: str) -> Payload:
    """Parse a mass and its centre in the tip frame."""
    match = _PAYLOAD.fullmatch(text.replace(" ", ""))
    if not match:
        raise InvalidArgumentError(
            f"--payload {text}: write the mass and, in the tip frame, its centre, as 5kg or 5kg@0,0,80mm"
        )
    mass, *position, unit = match.groups()
    x, y, z = (_METRES[unit or "m"] * float(value or 0) for value in position)
    if not 0 < float(mass) <= MAX_PAYLOAD_KG:
        raise InvalidArgumentError(
            f"--payload {text}: the mass must be positive and at most {MAX_PAYLOAD_KG:g} kg"
        )
    if not max(abs(x), abs(y), abs(z)) <= MAX_PAYLOAD_DISTANCE_M:
        raise InvalidArgumentError(
            f"--payload {text}: the centre must be within {MAX_PAYLOAD_DISTANCE_M:g} m of the tip; "
            "write its position in the tip frame"
        )
    return Payload(float(mass), (x, y, z))
