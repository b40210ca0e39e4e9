"""Sidecar files: what a calibration found and a URDF cannot hold.

The sidecar of `arm.urdf` is the TOML file `arm.calibration.toml` beside it:

    tip = "tool0"                      # link that holds the tool

    [base]                             # pose of the base link in the measuring frame
    xyz_m = [0.0, 0.0, 0.0]
    rotvec_rad = [0.0, 0.0, 0.0]

    [tool]                             # pose of the measured point in the tip frame; keys as in [base]

    [payload]                          # point mass at the tip
    mass_kg = 5.0
    centre_m = [0.0, 0.0, 0.08]

    [joint.elbow_joint]                # coefficients of `robot.transmission.TERMS`
    gain = 0.001

    [joint.elbow_joint.coupling]       # coefficients of other joints' positions
    wrist_1_joint = 0.0001

    [instrument]                       # parameters of instruments [m or rad]
    "wire1.x" = 1.25

    [uncertainty]                      # `estimation.Uncertainty`
    joints = ["elbow_joint"]
    terms = ["elbow_joint.gain"]
    sqrt_covariance = "..."            # rows of little-endian doubles in base64
    unbounded_directions = "..."

Absent tables mean identity frames, ideal joints and unknown uncertainty. Numbers are written with all digits
and read back bit-identical. Errors in the content of a file are `FileFormatError`, unknown joints
`UnknownNameError`.
"""

from __future__ import annotations

import base64
import binascii
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import tomli_w

from .._typing import Array, PathLike
from ..estimation.parameters import EXTENSIONS, PARAMETER_SETS
from ..estimation.uncertainty import Uncertainty
from ..exceptions import FileFormatError, UnknownNameError
from ..robot.chain import Chain
from ..robot.transmission import COUPLING_TERM, TERMS, Payload, Transmission
from .toml_table import TomlTable, pose_content, read_pose

# Heaviest payload [kg] and farthest centre [m]; beyond them the unit is wrong.
MAX_PAYLOAD_KG, MAX_PAYLOAD_DISTANCE_M = 1e5, 1e2
# Largest coefficient of a joint error, in its unit.
_MAX_COEFFICIENT = 1e6
# Length of the lines of base64 text [characters].
_LINE_LENGTH = 76

_HEADER = """\
# What the URDF cannot hold. base: pose of the robot's base link in the measuring frame.
# tool: pose of the measured point in the tip frame. Metres; rotation vectors in radians.
"""
_JOINT_HEADER = """\
# joint: what is added to the commanded position q of a joint, by q and the torque of gravity.
"""
_UNCERTAINTY_HEADER = """\
# uncertainty: square root of the covariance of the errors, and directions that neither the measurements nor
# a prior determine. Rows: six per link (motion in m and rad; the base link's in the measuring frame), then
# the terms. Little-endian doubles in base64.
"""


def sidecar_path(path: PathLike) -> str:
    """Return the path of the sidecar of a robot.

    Args:
        path: Path of the robot, such as `arm.urdf`.

    Returns:
        Path with another ending, such as `arm.calibration.toml`.
    """
    return f"{os.path.splitext(os.fspath(path))[0]}.calibration.toml"


def existing_sidecar(path: PathLike) -> str | None:
    """Return the path of the sidecar of a robot if the file exists.

    Args:
        path: Path of the robot.

    Returns:
        Path of the sidecar; None if there is none.
    """
    return sidecar_path(path) if os.path.exists(sidecar_path(path)) else None


# --- reading ---------------------------------------------------------------------------------------


def with_sidecar(chain: Chain, path: PathLike) -> Chain:
    """Return a chain with the frames, the payload and the joint errors of a sidecar.

    Args:
        chain: Robot as read from its URDF or DH table.
        path: Path of the sidecar.

    Returns:
        The chain. If its tip is not the tip of the sidecar, its tool stays.

    Raises:
        FileFormatError: The sidecar is invalid, or its payload is carried by another tip.
    """
    table = TomlTable.read(path)
    tip = table.text("tip", chain.tip)
    frames = {key: read_pose(table.table(key)) for key in ("base", "tool") if key in table}
    payload = _read_payload(table.table("payload")) if "payload" in table else None
    joints = table.table("joint") if "joint" in table else None
    # `read_instrument` and `read_uncertainty` read the tables [instrument] and [uncertainty].
    for key in ("instrument", "uncertainty"):
        table.get(key, {})
    table.finish()
    if tip != chain.tip:
        frames.pop("tool", None)
    chain = replace(chain, **frames)
    if payload is not None:
        if tip != chain.tip:
            raise FileFormatError(
                f"{table.where}: [payload] is carried by {tip!r}; select that link with --tip"
            )
        chain = chain.with_payload(payload)
    if joints is not None:
        chain = chain.with_transmission(_read_transmission(chain, joints))
    return chain


def _read_payload(table: TomlTable) -> Payload:
    mass = table.number("mass_kg", above=0, at_most=MAX_PAYLOAD_KG)
    x, y, z = table.vector("centre_m", 3, (0.0, 0.0, 0.0), at_most=MAX_PAYLOAD_DISTANCE_M)
    table.finish()
    return Payload(mass, (x, y, z))


def _read_transmission(chain: Chain, table: TomlTable) -> Transmission:
    """Read the tables [joint.NAME]; joints of the robot that are not on the chain are ignored."""
    coefficients = Transmission.zero(chain.loads).coefficients
    for name in table.keys():
        joint = table.table(name)
        if name in chain.joint_names:
            _read_joint(chain, chain.joint_names.index(name), joint, coefficients)
        elif name not in _joints_off_path(chain):
            raise UnknownNameError(
                f"{table.where}: unknown joint {name!r}; choose from {', '.join(chain.joint_names)}"
            )
    return Transmission(coefficients, chain.loads)


def _joints_off_path(chain: Chain) -> set[str]:
    """Return the robot's joints that are not on the chain."""
    return {joint.name for joint in chain.urdf.joints} - set(chain.moving_joints)


def _read_joint(chain: Chain, i: int, table: TomlTable, coefficients: Array) -> None:
    """Read the table of joint i into the coefficients, shape (t, n, n)."""
    if chain.is_prismatic[i]:
        table.name += " (prismatic)"
    for t, term in enumerate(TERMS):
        if term.applies_to_prismatic or not chain.is_prismatic[i]:
            coefficients[t, i, i] = _coefficient(table, term.key)
    if not chain.is_prismatic[i]:
        coupling = table.table("coupling")
        others = {name: j for j, name in enumerate(chain.joint_names) if j != i}
        for name in coupling.keys():
            value = _coefficient(coupling, name)
            if name in others:
                coefficients[COUPLING_TERM, i, others[name]] = value
            elif name not in _joints_off_path(chain):
                raise UnknownNameError(
                    f"{coupling.where}: {name!r} is not another joint; choose from {', '.join(others)}"
                )
    table.finish()


def _coefficient(table: TomlTable, key: str) -> float:
    return table.number(
        key, 0.0, at_least=-_MAX_COEFFICIENT, at_most=_MAX_COEFFICIENT, expected="a finite number"
    )


def read_instrument(path: PathLike) -> dict[str, float]:
    """Read the table [instrument] of a sidecar or of a file of surveyed values.

    Args:
        path: TOML file.

    Returns:
        Values of instrument parameters by name [m or rad]; empty without the table.
    """
    table = TomlTable.read(path).table("instrument")
    return {name: table.number(name) for name in table.keys()}


def read_uncertainty(path: PathLike, chain: Chain) -> Uncertainty | None:
    """Read the table [uncertainty] of a sidecar.

    Args:
        path: The sidecar.
        chain: Calibrated robot, as read with the sidecar.

    Returns:
        Uncertainty of the robot; None without the table.

    Raises:
        UnknownNameError: A term is unknown.
    """
    document = TomlTable.read(path)
    if "uncertainty" not in document:
        return None
    table = document.table("uncertainty")
    joints, terms = (table.get(key, expected="a list of names") for key in ("joints", "terms"))
    texts = {
        key: table.get(key, expected="base64 text") for key in ("sqrt_covariance", "unbounded_directions")
    }
    table.finish()
    if joints != list(chain.moving_joints):
        raise table.error("joints", f"expected the joints of this robot: {', '.join(chain.moving_joints)}")
    indices = _coefficient_indices(chain)
    if not isinstance(terms, list) or not all(isinstance(name, str) and name in indices for name in terms):
        raise UnknownNameError(f"{table.where}: terms = {terms!r}; choose from {', '.join(indices)}")
    n_rows = 6 * (len(chain.moving_joints) + 1) + len(terms)
    sqrt_covariance, unbounded_directions = (
        _decode_rows(text, n_rows, f"{table.where}: {key}") for key, text in texts.items()
    )
    if terms and chain.transmission is None:
        chain = chain.with_transmission(Transmission.zero(chain.loads))
    entries = np.array([indices[name] for name in terms], int)
    return Uncertainty(chain, entries, sqrt_covariance, unbounded_directions)


def _coefficient_indices(chain: Chain) -> dict[str, int]:
    """Return the index of each parameter in the flat coefficients of the transmission."""
    parameters = (parameter for name in EXTENSIONS for parameter in PARAMETER_SETS[name](chain))
    return {p.name: p.coefficient_index for p in parameters if p.coefficient_index is not None}


def _decode_rows(text: Any, n_rows: int, where: str) -> Array:
    """Decode base64 text to an array with n rows."""
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
    except (AttributeError, binascii.Error, ValueError):
        raise FileFormatError(f"{where} is not base64 text; calibrate again to replace it") from None
    if len(data) % (8 * n_rows):
        raise FileFormatError(
            f"{where} does not hold {n_rows} rows of doubles; calibrate again to replace it"
        )
    rows = np.frombuffer(data, "<f8").reshape(n_rows, -1).astype(float)
    if not np.isfinite(rows).all():
        raise FileFormatError(f"{where} has numbers that are not finite; calibrate again to replace it")
    return rows


# --- writing ---------------------------------------------------------------------------------------


def sidecar_text(
    chain: Chain,
    tool: Array,
    instrument: Mapping[str, float] | None = None,
    uncertainty: Uncertainty | None = None,
    *,
    required: bool = False,
) -> str | None:
    """Return the text of the sidecar of a calibrated robot.

    Args:
        chain: Calibrated robot, whose base, payload and joint errors are written.
        tool: Pose of the measured point in the tip frame, shape (4, 4) [m].
        instrument: Instrument parameters by name [m or rad].
        uncertainty: Uncertainty of the robot.
        required: Return the text even if the URDF alone holds everything.

    Returns:
        TOML text with explanations at the top; None if the URDF alone holds everything.
    """
    tables = {
        "payload": _payload_content(chain.payload),
        "joint": _transmission_content(chain),
        "instrument": {name: float(value) for name, value in (instrument or {}).items()},
        "uncertainty": _uncertainty_content(uncertainty),
    }
    tables = {key: table for key, table in tables.items() if table}
    has_frames = not all(np.array_equal(pose, np.eye(4)) for pose in (chain.base, tool))
    if not (required or tables or has_frames):
        return None
    header = _HEADER
    header += _JOINT_HEADER if "joint" in tables else ""
    header += _UNCERTAINTY_HEADER if "uncertainty" in tables else ""
    frames = {"base": pose_content(chain.base), "tool": pose_content(tool)}
    return header + tomli_w.dumps({"tip": chain.tip, **frames, **tables}, multiline_strings=True)


def _payload_content(payload: Payload | None) -> dict[str, Any]:
    return {} if payload is None else {"mass_kg": payload.mass, "centre_m": list(payload.centre)}


def _transmission_content(chain: Chain) -> dict[str, Any]:
    """Return the tables [joint.NAME] of all coefficients that are not zero."""
    if chain.transmission is None:
        return {}
    coefficients, names = chain.transmission.coefficients, chain.joint_names
    content: dict[str, Any] = {}
    for i, name in enumerate(names):
        joint: dict[str, Any] = {
            term.key: coefficients[t, i, i].item() for t, term in enumerate(TERMS) if coefficients[t, i, i]
        }
        coupling = {
            names[j]: coefficients[COUPLING_TERM, i, j].item()
            for j in np.flatnonzero(coefficients[COUPLING_TERM, i])
            if j != i
        }
        if coupling:
            joint["coupling"] = coupling
        if joint:
            content[name] = joint
    return content


def _uncertainty_content(uncertainty: Uncertainty | None) -> dict[str, Any]:
    """Return the table [uncertainty]; empty if the noise, and with it the covariance, is unknown."""
    if uncertainty is None or not np.isfinite(uncertainty.sqrt_covariance).all():
        return {}
    names = {index: name for name, index in _coefficient_indices(uncertainty.chain).items()}
    return {
        "joints": list(uncertainty.chain.moving_joints),
        "terms": [names[int(index)] for index in uncertainty.entries],
        "sqrt_covariance": _encode_rows(uncertainty.sqrt_covariance),
        "unbounded_directions": _encode_rows(uncertainty.unbounded_directions),
    }


def _encode_rows(rows: Array) -> str:
    """Encode an array as lines of base64 text."""
    text = base64.b64encode(np.ascontiguousarray(rows, "<f8").tobytes()).decode()
    return "\n".join([*(text[i : i + _LINE_LENGTH] for i in range(0, len(text), _LINE_LENGTH)), ""])
