"""What the tip carries: as an option's text, and as the sidecar's `[payload]`."""

from __future__ import annotations

import re
from typing import Any

from .errors import DhcalError
from .transmission import Payload

_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_TEXT = re.compile(rf"({_NUMBER})kg(?:@({_NUMBER}),({_NUMBER}),({_NUMBER})(mm|cm|m))?")
# Heavier loads and longer arms are slips of the unit.
_HEAVIEST, _FARTHEST = 1e5, 1e2


def parse_payload(text: str, what: str = "--payload") -> Payload:
    """A mass and its centre in the tip frame from `5kg` or `5kg@0,0,80mm`.

    Raises:
        DhcalError: another form, or a mass that is none.
    """
    found = _TEXT.fullmatch(text.replace(" ", ""))
    if not found:
        raise DhcalError(
            f"{what} {text}: write the mass and, in the tip frame, its centre, as 5kg or 5kg@0,0,80mm"
        )
    mass, x, y, z, unit = found.groups()
    scale = _UNITS[unit or "m"]
    return _checked(float(mass), [scale * float(value or 0) for value in (x, y, z)], f"{what} {text}")


def read_payload(table: Any, source: str) -> Payload:
    """The sidecar's table.

    Raises:
        DhcalError: it lacks a key, or holds another or no numbers.
    """
    values = table if isinstance(table, dict) else {}
    mass, centre = values.get("mass_kg"), values.get("centre_m", [0.0, 0.0, 0.0])
    good = isinstance(centre, list) and len(centre) == 3 and all(map(_is_number, [mass, *centre]))
    if not good or set(values) - {"mass_kg", "centre_m"}:
        raise DhcalError(f"{source}: [payload] needs mass_kg = 5.0 and centre_m = [0.0, 0.0, 0.08]")
    return _checked(float(values["mass_kg"]), [float(value) for value in centre], f"{source}: [payload]")


def payload_lines(payload: Payload | None) -> list[str]:
    """The sidecar's lines of it; none where nothing is carried."""
    if payload is None:
        return []
    return ["", "[payload]", f"mass_kg = {payload.mass!r}", f"centre_m = {list(payload.centre)}"]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _checked(mass: float, centre: list[float], where: str) -> Payload:
    if not 0 < mass <= _HEAVIEST:
        raise DhcalError(f"{where}: a mass of {mass:g} kg; write a positive one")
    if not all(abs(value) <= _FARTHEST for value in centre):
        off = max(map(abs, centre))
        raise DhcalError(f"{where}: its centre is {off:g} m off the tip; write its place in the tip frame")
    x, y, z = centre
    return Payload(mass, (x, y, z))
