"""Conditions at which two calibrations of one robot are compared.

Calibrations with thermal growth have a reference temperature, and those with elastic joints a payload. Both
robots are compared with those of the first one that has such errors. Directions of motion, and temperatures
around the reference, are drawn if one of the robots depends on them: else backlash and thermal growth have
no effect, and no comparison could show them.

Shapes: m configurations, n joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._typing import Array
from ..robot.chain import Chain
from ..robot.conditions import CONDITIONS, Conditions
from ..robot.error_families import COMPLIANCE, FAMILIES, THERMAL, ErrorFamily
from ..robot.transmission import Payload

# Reference temperatures are different from this difference on [K].
MIN_DIFFERENCE = 1.0


def at_reference(chains: Sequence[Chain], q: Array) -> Conditions:
    """Return the conditions (m,) of the first robot: its reference temperature, joints without direction."""
    if not any(_has(chain, THERMAL) for chain in chains):
        return Conditions(q)
    return Conditions(q, temperature=np.full(len(q), _first(chains, THERMAL).reference_temperature))


def varied(chains: Sequence[Chain], q: Array, rng: np.random.Generator) -> Conditions:
    """Draw conditions (m,) that show all errors of the robots."""
    reference = _first(chains, THERMAL).reference_temperature
    needed = {family.condition for chain in chains for family in chain.error_families}
    drawn = {
        name: condition.draw(rng, q.shape, reference)
        for name, condition in CONDITIONS.items()
        if name in needed and condition.draw
    }
    return replace(at_reference(chains, q), **drawn)


def with_common_payload(chains: Sequence[Chain]) -> list[Chain]:
    """Return robots with the payload of the first one that has elastic joints."""
    payload = _first(chains, COMPLIANCE).payload
    return [chain if chain.payload == payload else chain.with_payload(payload) for chain in chains]


def condition_remarks(chains: Sequence[Chain], names: Sequence[str]) -> list[str]:
    """Say at which conditions robots are compared if theirs differ, and which errors only one of them has."""
    remarks = []
    temperatures = [chain.reference_temperature for chain in chains]
    if all(_has(chain, THERMAL) for chain in chains) and abs(np.diff(temperatures)[0]) > MIN_DIFFERENCE:
        remarks.append(
            f"Both are compared at {temperatures[0]:.1f} °C, the reference temperature of {names[0]}; that "
            f"of {names[1]} is {temperatures[1]:.1f} °C."
        )
    loads = [chain.payload for chain in chains]
    if any(_has(chain, COMPLIANCE) for chain in chains) and loads[0] != loads[1]:
        first = chains.index(_first(chains, COMPLIANCE))
        texts = [_described(loads[i]) for i in (first, 1 - first)]
        remarks.append(
            f"Both are compared with the payload of {names[first]}, {texts[0]}; that of {names[1 - first]} "
            f"is {texts[1]}."
        )
    for family in FAMILIES.values():
        owners = [name for chain, name in zip(chains, names, strict=True) if family in chain.error_families]
        if family.condition and len(owners) == 1:
            remarks.append(f"Only {owners[0]} states {family.description}.")
    return remarks


def _has(chain: Chain, name: str) -> bool:
    """Return whether a robot has errors of a family."""
    family: ErrorFamily = FAMILIES[name]
    return family in chain.error_families


def _first(chains: Sequence[Chain], name: str) -> Chain:
    """Return the first robot that has errors of a family, else the first one."""
    return next((chain for chain in chains if _has(chain, name)), chains[0])


def _described(payload: Payload | None) -> str:
    """Describe a payload."""
    if payload is None:
        return "none"
    centre = ", ".join(f"{1e3 * value:.4g}" for value in payload.centre)
    return f"{payload.mass:g} kg at {centre} mm"
