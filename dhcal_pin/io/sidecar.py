"""Robots in and out: URDF or DH file to a chain, a calibrated chain back to URDF and sidecar."""

from __future__ import annotations

import base64
import binascii
import json
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..estimation.parameters import EXTENSIONS, PARAMETER_SETS
from ..estimation.uncertainty import Uncertainty
from ..exceptions import DhcalError
from ..robot.chain import Chain
from ..robot.transmission import COUPLING_TERM, TERMS, Payload, Transmission
from .tabular import read_toml


def sidecar_path(path: PathLike) -> str:
    """`arm.urdf` → `arm.calibration.toml`."""
    return f"{os.path.splitext(os.fspath(path))[0]}.calibration.toml"


def existing_sidecar(path: PathLike) -> str | None:
    """The sidecar beside a robot, if there is one."""
    return sidecar_path(path) if os.path.exists(sidecar_path(path)) else None


def read_instrument(path: PathLike) -> dict[str, float]:
    """Values in m and rad of instruments' unknowns by name: a file's [instrument] table, or nothing.

    Raises:
        DhcalError: a value is not a finite number.
    """
    values = read_toml(path).get("instrument", {})
    if not isinstance(values, dict):
        raise DhcalError(f"{os.fspath(path)}: [instrument] must be a table")
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise DhcalError(f"{os.fspath(path)}: [instrument] {name} = {value!r} is not a finite number")
    return {name: float(value) for name, value in values.items()}


def sidecar_text(
    tip: str,
    base: Array,
    tool: Array,
    instrument: Mapping[str, float],
    joints: Sequence[str] = (),
    uncertainty: Sequence[str] = (),
    payload: Sequence[str] = (),
) -> str:
    """The sidecar's TOML of base and tool (4, 4), the tool being on `tip`, and of what else is known.

    Args:
        tip: the link that holds the tool.
        base: (4, 4) base link in the measuring frame.
        tool: (4, 4) measured point in the tip frame.
        instrument: its values by name, m and rad.
        joints: lines of `transmission_lines`.
        uncertainty: lines of `uncertainty_lines`.
        payload: lines of `payload_lines`.
    """
    out = [
        "# What the URDF cannot hold. base: the robot's base link in the measuring frame;",
        "# tool: the measured point in the tip frame. Metres; rotation vectors in radians.",
        *(
            ["# joint: what a joint adds to its commanded value q, by q and gravity's torque."]
            if joints
            else []
        ),
        f"tip = {json.dumps(tip)}",
    ]
    for name, pose in (("base", base), ("tool", tool)):
        xyz, turn = pose[:3, 3].tolist(), se3.log3(pose[:3, :3]).tolist()
        out += ["", f"[{name}]", f"xyz_m = {xyz}", f"rotvec_rad = {turn}"]
    out += [*payload, *joints]
    if instrument:
        out += [
            "",
            "[instrument]",
            *(f"{json.dumps(name)} = {value!r}" for name, value in instrument.items()),
        ]
    return "\n".join([*out, *uncertainty]) + "\n"


_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


_TEXT = re.compile(rf"({_NUMBER})kg(?:@({_NUMBER}),({_NUMBER}),({_NUMBER})(mm|cm|m))?")


# Heavier loads and longer arms are slips of the unit.
_MAX_MASS_KG, _MAX_DISTANCE_M = 1e5, 1e2


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
    if not 0 < mass <= _MAX_MASS_KG:
        raise DhcalError(f"{where}: a mass of {mass:g} kg; write a positive one")
    if not all(abs(value) <= _MAX_DISTANCE_M for value in centre):
        off = max(map(abs, centre))
        raise DhcalError(f"{where}: its centre is {off:g} m off the tip; write its place in the tip frame")
    x, y, z = centre
    return Payload(mass, (x, y, z))


_MAX_VALUE = 1e6


def transmission_lines(chain: Chain) -> list[str]:
    """The TOML lines of every coefficient of a chain that is not zero."""
    if chain.transmission is None:
        return []
    held, names = chain.transmission.coefficients, chain.joint_names
    out = []
    for i, name in enumerate(names):
        own = [f"{term.key} = {held[t, i, i].item()!r}" for t, term in enumerate(TERMS) if held[t, i, i]]
        others = [
            f"{json.dumps(names[j])} = {held[COUPLING_TERM, i, j].item()!r}"
            for j in np.flatnonzero(held[COUPLING_TERM, i])
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
    held = Transmission.zero(chain.loads).coefficients
    for name, table in _table(tables, f"{source}: [joint]").items():
        if name in chain.joint_names:
            i = chain.joint_names.index(name)
            _read_joint(chain, i, _table(table, f"{source}: [joint.{name}]"), held, source)
        elif name not in _joints_off_path(chain):
            raise DhcalError(
                f"{source}: [joint.{name}]: no joint of this robot; there are {', '.join(chain.joint_names)}"
            )
    return chain.with_transmission(Transmission(held, chain.loads))


def _joints_off_path(chain: Chain) -> set[str]:
    """The robot's joints off the path."""
    return {joint.name for joint in chain.urdf.joints} - set(chain.moving_joints)


def _read_joint(chain: Chain, i: int, table: Mapping[str, Any], held: Array, source: str) -> None:
    """Enters one joint's table into coefficients (t, n, n)."""
    here = f"{source}: [joint.{chain.joint_names[i]}]"
    keys = {
        term.key: t for t, term in enumerate(TERMS) if term.applies_to_prismatic or not chain.is_prismatic[i]
    }
    others = {name: j for j, name in enumerate(chain.joint_names) if j != i}
    for key, value in table.items():
        if key == "coupling" and not chain.is_prismatic[i]:
            for name, share in _table(value, f"{here} coupling").items():
                number = _number(share, f"{here} coupling {name}")
                if name in others:
                    held[COUPLING_TERM, i, others[name]] = number
                elif name not in _joints_off_path(chain):
                    raise DhcalError(
                        f"{here} coupling: {name!r} is no other joint; there are {', '.join(others)}"
                    )
        elif key not in keys:
            kind = "a sliding joint" if chain.is_prismatic[i] else "a joint"
            allowed = [*keys, *([] if chain.is_prismatic[i] else ["coupling"])]
            raise DhcalError(f"{here}: unknown key {key!r}; {kind} has {', '.join(allowed)}")
        else:
            held[keys[key], i, i] = _number(value, f"{here} {key}")


def _table(value: object, here: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise DhcalError(f"{here} must be a table, not {value!r}")
    return value


def _number(value: object, here: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _MAX_VALUE:
        raise DhcalError(f"{here} = {value!r} is not a finite number")
    return float(value)


_KEYS = ("joints", "terms", "sqrt_covariance", "unbounded_directions")


_COLUMNS = 76


def uncertainty_lines(known: Uncertainty) -> list[str]:
    """The TOML lines of an uncertainty; none where no noise could be told, and so nothing is known of it."""
    if not np.isfinite(known.sqrt_covariance).all():
        return []
    names = {entry: name for name, entry in _entries(known.chain).items()}
    terms = [names[int(entry)] for entry in known.entries]
    out = [
        "",
        "# Roots of the errors' covariance, and directions that nothing tells, by rows: six of each link's",
        "# motion (m, rad; the base's in the measuring frame), then the terms; doubles, base64.",
        "[uncertainty]",
        f"joints = {json.dumps(list(known.chain.moving_joints), ensure_ascii=False)}",
        f"terms = {json.dumps(terms, ensure_ascii=False)}",
    ]
    for key, rows in (
        ("sqrt_covariance", known.sqrt_covariance),
        ("unbounded_directions", known.unbounded_directions),
    ):
        text = base64.b64encode(np.ascontiguousarray(rows, "<f8").tobytes()).decode()
        wrapped = [text[i : i + _COLUMNS] for i in range(0, len(text), _COLUMNS)]
        out += [f'{key} = """', *wrapped, '"""']
    return out


def read_uncertainty(path: PathLike, chain: Chain) -> Uncertainty | None:
    """What a sidecar knows of its arm's uncertainty, if it does.

    Args:
        path: the sidecar.
        chain: the calibrated arm, as read with it.

    Raises:
        DhcalError: the table is wrong, or another arm's.
    """
    here, table = f"{path}: [uncertainty]", read_toml(path).get("uncertainty")
    if table is None:
        return None
    if not isinstance(table, dict) or set(table) != set(_KEYS):
        raise DhcalError(f"{here} must be a table of {', '.join(_KEYS)}")
    if table["joints"] != list(chain.moving_joints):
        raise DhcalError(
            f"{here} is of joints {table['joints']}; the arm's are {', '.join(chain.moving_joints)}"
        )
    entries, terms = _entries(chain), table["terms"]
    if not isinstance(terms, list) or not all(isinstance(name, str) and name in entries for name in terms):
        raise DhcalError(f"{here} terms = {terms!r}: every one must be one of {', '.join(entries)}")
    count = 6 * (len(chain.moving_joints) + 1) + len(terms)
    root, hidden = (
        _rows(table[key], count, f"{here} {key}") for key in ("sqrt_covariance", "unbounded_directions")
    )
    if terms and chain.transmission is None:
        chain = chain.with_transmission(Transmission.zero(chain.loads))
    return Uncertainty(chain, np.array([entries[name] for name in terms], int), root, hidden)


def _entries(chain: Chain) -> dict[str, int]:
    """Flat entries of the transmission's coefficients by parameter."""
    every = (p for name in EXTENSIONS for p in PARAMETER_SETS[name](chain))
    return {p.name: p.coefficient_index for p in every if p.coefficient_index is not None}


def _rows(text: Any, count: int, here: str) -> Array:
    """The rows (count, ·) of a text."""
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
    except (AttributeError, binascii.Error, ValueError):
        data = b"?"
    if len(data) % (8 * count):
        raise DhcalError(f"{here} is no base64 of {count} rows of doubles; calibrate again to have it right")
    out = np.frombuffer(data, "<f8").reshape(count, -1).astype(float)
    if not np.isfinite(out).all():
        raise DhcalError(f"{here} has numbers that are not finite; calibrate again to have it right")
    return out
