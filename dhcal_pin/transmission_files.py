"""Joints' transmission errors in the sidecar: tables `[joint.NAME]`, and `[joint.NAME.coupling]`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from .chain import Chain
from .errors import DhcalError
from .se3 import Array
from .transmission import COUPLED, TERMS, Transmission

_MOST = 1e6


def transmission_lines(chain: Chain) -> list[str]:
    """The TOML lines of every coefficient of a chain that is not zero."""
    if chain.transmission is None:
        return []
    held, names = chain.transmission.coefficients, chain.joint_names
    out = []
    for i, name in enumerate(names):
        own = [f"{term.key} = {held[t, i, i].item()!r}" for t, term in enumerate(TERMS) if held[t, i, i]]
        others = [
            f"{json.dumps(names[j])} = {held[COUPLED, i, j].item()!r}"
            for j in np.flatnonzero(held[COUPLED, i])
            if j != i
        ]
        if own or others:
            out += ["", f"[joint.{json.dumps(name)}]", *own]
        if others:
            out += [f"[joint.{json.dumps(name)}.coupling]", *others]
    return out


def with_transmission(chain: Chain, tables: object, source: str) -> Chain:
    """A chain whose joints miss their values as the sidecar's `[joint.NAME]` tables say.

    Joints of the robot that are not on the chain's path are passed over.

    Raises:
        DhcalError: an unknown joint or key, or a value that is not a finite number.
    """
    held = Transmission.ideal(chain.loads).coefficients
    for name, table in _table(tables, f"{source}: [joint]").items():
        if name in chain.joint_names:
            i = chain.joint_names.index(name)
            _read_joint(chain, i, _table(table, f"{source}: [joint.{name}]"), held, source)
        elif name not in _elsewhere(chain):
            raise DhcalError(
                f"{source}: [joint.{name}]: no joint of this robot; there are {', '.join(chain.joint_names)}"
            )
    return chain.driven(Transmission(held, chain.loads))


def _elsewhere(chain: Chain) -> set[str]:
    """The robot's joints off the path."""
    return {joint.name for joint in chain.urdf.joints} - set(chain.moving)


def _read_joint(chain: Chain, i: int, table: Mapping[str, Any], held: Array, source: str) -> None:
    """Enters one joint's table into coefficients (t, n, n)."""
    here = f"{source}: [joint.{chain.joint_names[i]}]"
    keys = {term.key: t for t, term in enumerate(TERMS) if term.sliding or not chain.sliding[i]}
    others = {name: j for j, name in enumerate(chain.joint_names) if j != i}
    for key, value in table.items():
        if key == "coupling" and not chain.sliding[i]:
            for name, share in _table(value, f"{here} coupling").items():
                number = _number(share, f"{here} coupling {name}")
                if name in others:
                    held[COUPLED, i, others[name]] = number
                elif name not in _elsewhere(chain):
                    raise DhcalError(
                        f"{here} coupling: {name!r} is no other joint; there are {', '.join(others)}"
                    )
        elif key not in keys:
            kind = "a sliding joint" if chain.sliding[i] else "a joint"
            allowed = [*keys, *([] if chain.sliding[i] else ["coupling"])]
            raise DhcalError(f"{here}: unknown key {key!r}; {kind} has {', '.join(allowed)}")
        else:
            held[keys[key], i, i] = _number(value, f"{here} {key}")


def _table(value: object, here: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise DhcalError(f"{here} must be a table, not {value!r}")
    return value


def _number(value: object, here: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _MOST:
        raise DhcalError(f"{here} = {value!r} is not a finite number")
    return float(value)
