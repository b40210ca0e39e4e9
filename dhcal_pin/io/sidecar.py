"""Sidecar files: what a calibration found and a URDF cannot hold.

The sidecar of `arm.urdf` is the TOML file `arm.calibration.toml` beside it. `SIDECAR_KEYS` declares its
tables, which docs/reference/robot_files.md explains, except for those that programs write for programs:

    [uncertainty]                      # `estimation.Uncertainty`
    joints = ["elbow_joint"]
    terms = ["elbow_joint.gain"]
    sqrt_covariance = "..."            # rows of little-endian doubles in base64
    unbounded_directions = "..."
    frame_part = "..."                 # absent if the measurements determine base and tool
    temperature = 75.8                 # factor on the variance of the residuals that the covariance contains
    model_std_m = 1.1e-4               # errors that the model lacks: of the position, per axis
    model_std_rad = 1e-4               # the same of the orientation
    chi_square = 512.3                 # of the residuals with the stated noise; absent if it is not stated
    degrees_of_freedom = 498.0         # of the residuals
    residual_std_m = 5e-5              # standard deviation of the residuals per axis: of lengths
    residual_std_rad = 0.0             # the same of angles; 0 without
    left_out = [["harmonics", 31.2, 24, 474]]   # families that the model lacks: `estimation.FamilyGain`

    [uncertainty.information]          # in place of the three arrays: `estimation.information`
    factor = 0.09                      # on the information of the samples
    units = [...]                      # of the columns of `roots`
    roots = "..."                      # rows of 16-bit integers, compressed, in base85
    geometry = "..."                   # rows of doubles, compressed, in base85; so are `prior` and `gauge`
    added = "..."                      # rows of 32-bit floats, compressed, in base85

    [uncertainty.information.conditions]
    q = "..."                          # conditions of the samples by name, as `added`

    [measured]                         # `measurements.MeasuredRegion`
    joints = ["elbow_joint"]
    lower = [-1.5]                     # smallest and largest measured values [rad or m]
    upper = [0.5]
    spread = [0.6]                     # standard deviations of the measured values [rad or m]
    radius = 0.9                       # of the region, and how far its accuracy was judged, in spreads
    reach = 1.5
    centres = "..."                    # configurations: rows of 32-bit floats in base64, one per joint

Absent tables mean identity frames, ideal joints and unknown uncertainty. Numbers are written with all digits
and read back bit-identical. Errors in the content of a file are `FileFormatError`, unknown joints
`UnknownNameError`.
"""

from __future__ import annotations

import base64
import binascii
import glob
import hashlib
import lzma
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from .._typing import Array, PathLike
from ..estimation.information import Information, Samples
from ..estimation.parameters import PARAMETER_SETS, fold_harmonics
from ..estimation.uncertainty import FamilyGain, ModelFit, Uncertainty, compact, expand
from ..exceptions import FileFormatError, UnknownNameError
from ..measurements.measured_region import MeasuredRegion
from ..measurements.mounting import MountedRig
from ..messages import quote
from ..robot.chain import Chain
from ..robot.conditions import MAX_PAYLOAD, TEMPERATURE_RANGE, Conditions
from ..robot.error_families import (
    COUPLING,
    FAMILIES,
    GAIN,
    HARMONICS,
    JOINT_TERMS,
    LINK_TERMS,
    THERMAL,
)
from ..robot.transmission import (
    MAX_CURVE_ORDER,
    Payload,
    Transmission,
    coefficient_indices,
    n_coefficients,
    split_coefficients,
)
from ..robot.urdf import Urdf, suggest_names
from ..saving import complete_interrupted_save
from . import toml_table as toml
from .rig_file import rig_content
from .tabular import MAX_SIDECAR_BYTES, read_toml
from .toml_table import Key, TomlTable

# Heaviest payload [kg] and farthest centre [m]; beyond them the unit is wrong.
MAX_PAYLOAD_KG, MAX_PAYLOAD_DISTANCE_M = MAX_PAYLOAD, 1e2
# Largest coefficient of a joint error, in its unit.
_MAX_COEFFICIENT = 1e6
_COEFFICIENT = toml.number(-_MAX_COEFFICIENT, _MAX_COEFFICIENT, description="a finite number", default=0.0)
_HARMONIC = Key(
    f"[order, sin_rad, cos_rad] with an order from 1 to {MAX_CURVE_ORDER}, such as [1, 2e-4, -1e-4]",
    {"type": "array", "minItems": 3, "maxItems": 3, "items": {"type": "number"}},
    lambda value: (
        isinstance(value, list)
        and len(value) == 3
        and all(toml.is_number(entry) and abs(entry) <= _MAX_COEFFICIENT for entry in value)
        and isinstance(value[0], int)
        and 1 <= value[0] <= MAX_CURVE_ORDER
    ),
)
_FAMILY_GAIN = Key(
    '[family, gain, added, remaining], such as ["harmonics", 31.2, 24, 474]',
    {"type": "array", "minItems": 4, "maxItems": 4},
    lambda value: (
        isinstance(value, list)
        and len(value) == 4
        and isinstance(value[0], str)
        and value[0] in FAMILIES
        and all(toml.is_number(each) and each >= 0 for each in value[1:])
        and all(isinstance(each, int) and each > 0 for each in value[2:])
    ),
)
_NAMES = Key("a list of names", {"type": "array", "items": {"type": "string"}})
_BASE64 = Key("base64 text", {"type": "string"})
_PAYLOAD_KEYS = {
    "mass_kg": toml.number(above=0, at_most=MAX_PAYLOAD_KG),
    "centre_m": toml.vector(3, MAX_PAYLOAD_DISTANCE_M, default=(0.0, 0.0, 0.0)),
}
_MANIFEST_KEYS = {
    "urdf_sha256": toml.text(),
    "joints_sha256": toml.text(default=""),
    "fitted_sha256": replace(_NAMES, default=()),
    "fitted_rows": replace(_BASE64, default=""),
}
_ENDING = ".calibration.toml"
# Keys of the families of joint errors.
_GAIN, _HARMONICS, _COUPLING = (FAMILIES[name].sidecar_key for name in (GAIN, HARMONICS, COUPLING))
_JOINT_TERM_KEYS = [FAMILIES[name].sidecar_key for name in JOINT_TERMS]
# Temperature at which the links have the lengths of the URDF [°C].
_REFERENCE = toml.number(*TEMPERATURE_RANGE)
# Tables of the families of links, by their names.
_LINK_KEYS = {
    name: {
        **({"reference_degc": _REFERENCE} if name == THERMAL else {}),
        FAMILIES[name].sidecar_key: toml.table_by_name(_COEFFICIENT),
    }
    for name in LINK_TERMS
}
# A prismatic joint has the first of these keys only.
_JOINT_KEYS = {
    _GAIN: _COEFFICIENT,
    _HARMONICS: toml.list_of(_HARMONIC, default=()),
    **dict.fromkeys(_JOINT_TERM_KEYS, _COEFFICIENT),
    _COUPLING: toml.table_by_name(_COEFFICIENT),
}
# Types of the numbers of arrays that are compressed.
_INFORMATION_TYPES = {
    "geometry": "<f8",
    "prior": "<f8",
    "added": "<f4",
    "removed": "<f4",
    "gauge": "<f8",
    "coordinates": "<f8",
}
_ROOTS_TYPE, _CONDITION_TYPE = "<i2", "<f4"
# Rows of the upper part of a root, and shape of the conditions of a sample that are matrices.
_N_UPPER = 21
_CONDITION_SHAPES = {"base_motion": (4, 4), "tool_motion": (4, 4), "temperature": (), "payload": ()}
# Largest number of columns of such an array.
_MAX_COLUMNS = 1 << 18
_INFORMATION_KEYS = {
    "factor": toml.number(above=0),
    "units": toml.vector(6),
    "roots": _BASE64,
    **dict.fromkeys(_INFORMATION_TYPES, _BASE64),
    "conditions": toml.table_by_name(_BASE64),
}
_UNCERTAINTY_KEYS = {
    "joints": _NAMES,
    "terms": _NAMES,
    # Either the first three of these or the last one.
    "sqrt_covariance": replace(_BASE64, is_optional=True),
    "unbounded_directions": replace(_BASE64, is_optional=True),
    "frame_part": replace(_BASE64, is_optional=True),
    "information": toml.table_of(_INFORMATION_KEYS),
    "temperature": toml.number(1, default=1.0),
    "model_std_m": toml.number(0, default=0.0),
    "model_std_rad": toml.number(0, default=0.0),
    "chi_square": toml.number(0, is_optional=True),
    "degrees_of_freedom": toml.number(0, is_optional=True),
    "residual_std_m": toml.number(0, is_optional=True),
    "residual_std_rad": toml.number(0, is_optional=True),
    "left_out": toml.list_of(_FAMILY_GAIN, default=()),
}
_MEASURED_KEYS = {
    "joints": _NAMES,
    # One number per joint.
    **{key: toml.list_of(toml.number()) for key in ("lower", "upper", "spread")},
    "radius": toml.number(0),
    "reach": toml.number(0),
    # Smallest and largest payload; absent if none is stated.
    "payload_kg": toml.vector(2, is_optional=True),
    # Rows of 32-bit floats; former files have doubles.
    "centres": replace(_BASE64, is_optional=True),
    "configurations": replace(_BASE64, is_optional=True),
}
_FRAME_KEYS = {
    "tip": toml.text(is_optional=True),
    "base": toml.table_of(toml.POSE_KEYS),
    "tool": toml.table_of(toml.POSE_KEYS),
    "link": toml.table_by_name(toml.table_of(toml.POSE_KEYS)),
    "payload": toml.table_of(_PAYLOAD_KEYS),
    "manifest": toml.table_of(_MANIFEST_KEYS),
}
# Tables of a sidecar; those of cameras and boards are those of rig files.
SIDECAR_KEYS = {
    **_FRAME_KEYS,
    "joint": toml.table_by_name(toml.table_of(_JOINT_KEYS)),
    **{name: toml.table_of(keys) for name, keys in _LINK_KEYS.items()},
    "instrument": toml.table_by_name(toml.number()),
    "uncertainty": toml.table_of(_UNCERTAINTY_KEYS),
    "measured": toml.table_of(_MEASURED_KEYS),
    "camera": toml.table_by_name(Key()),
    "board": toml.table_by_name(Key()),
}
# Keys of single harmonics, which the key `harmonics` replaces.
_FORMER_HARMONIC_KEYS = ("sin_rad", "cos_rad", "sin2_rad", "cos2_rad")
# Entry of `harmonics` as tomli_w writes it.
_HARMONIC_LINES = re.compile(r"^ {4}\[\n +(\d+),\n +(\S+),\n +(\S+),\n {4}\]", re.MULTILINE)
# Lines of base64 or base85 text, and the number of such a text as tomli_w writes it.
_ENCODED_LINES, _TEXT_NUMBER = re.compile(r"[!-&(-~\n]*\n"), re.compile(r'"""\n(\d+)\n"""')
# Decimals of the numbers [m or rad] that the hash of the joints depends on.
_DIGEST_DECIMALS = 12
# What stands between the first and the last name of successive terms.
_RANGE = " ... "
# Length of the lines of encoded text [characters].
_LINE_LENGTH = 76

_HEADER = """\
# What the URDF cannot hold. base: pose of the robot's base link in the measuring frame.
# tool: pose of the measured point in the tip frame. Metres; rotation vectors in radians.
"""
# Comments on single tables.
_TABLE_HEADERS = {
    "link": """\
# link: what the complete model adds to the origin of the joint before each link, in the frame of that origin.
# The URDF alone is the best robot without this file; with it, robot and file are the calibrated model.
""",
    "joint": """\
# joint: what is added to the commanded position q of a joint, by q and the torque of gravity. harmonics:
# k and the factors of sin(k q) and cos(k q) in radians.
""",
    THERMAL: """\
# thermal: relative growth of the length of each link per kelvin above the reference temperature.
""",
    "uncertainty": """\
# uncertainty: square root of the covariance of the errors, and directions that neither the measurements nor
# a prior determine; frame_part: what of both is only another pose of base or tool, which the measurements
# leave free. Rows: six per link (motion in m and rad; the base link's in the measuring frame), then the
# terms. Little-endian doubles in base64. information: samples and priors from which they follow, for hundreds
# of terms.
""",
    "measured": """\
# measured: configurations that represent the measured region of joint space. A configuration is in the region
# if its distance to one of them, in spreads of the joints, is at most the radius. The accuracy beyond it was
# judged up to the distance `reach`. Rows: the joints.
""",
}


def sidecar_path(path: PathLike) -> str:
    """Return the path of the sidecar of a robot."""
    return os.path.splitext(os.fspath(path))[0] + _ENDING


def existing_sidecar(path: PathLike) -> str | None:
    """Return the path of the sidecar of a robot if the file exists."""
    complete_interrupted_save(path)
    return sidecar_path(path) if os.path.exists(sidecar_path(path)) else None


def robots_of_sidecar(sidecar: PathLike) -> list[str]:
    """Return the robot files beside a sidecar that it was written with."""
    path = Path(sidecar)
    if not os.access(path, os.R_OK):
        return []
    content, name = path.read_bytes(), glob.escape(path.name.removesuffix(_ENDING))
    return [
        str(other)
        for other in sorted(path.parent.glob(f"{name}.*"))
        if os.access(other, os.R_OK)
        and other.is_file()
        and f'urdf_sha256 = "{hashlib.sha256(other.read_bytes()).hexdigest()}"'.encode() in content
    ]


def belongs_to(sidecar: PathLike, urdf: Urdf) -> bool:
    """Return whether a sidecar was written with a URDF; one without a manifest belongs to any."""
    read = TomlTable.read(sidecar, MAX_SIDECAR_BYTES).some_values(_FRAME_KEYS)
    manifest, tip = read["manifest"], read["tip"]
    return manifest is None or (tip in urdf.links and _is_of(manifest, urdf, tip))


# --- reading ---------------------------------------------------------------------------------------


def with_sidecar(chain: Chain, path: PathLike) -> Chain:
    """Return a chain with the frames, the payload and the joint errors of a sidecar."""
    table = TomlTable.read(path, MAX_SIDECAR_BYTES)
    read = table.some_values(_FRAME_KEYS)
    tip = chain.tip if read["tip"] is None else read["tip"]
    if tip not in chain.urdf.links:
        raise UnknownNameError(
            f"{table.where}: tip = {quote(tip)}: no such link; {suggest_names(tip, chain.urdf.links)}"
        )
    frames = {key: toml.pose_of(read[key]) for key in ("base", "tool") if read[key] is not None}
    links = {name: table.table(name) for name in LINK_TERMS if name in table}
    if read["manifest"] is not None:
        _check_manifest(read["manifest"], table.path, chain.urdf, tip)
    # `read_instrument`, `read_uncertainty` and `read_measured_region` read the other tables; those of cameras
    # and boards are for people, and for rig files.
    for key in SIDECAR_KEYS:
        table.get(key, {})
    table.finish()
    if tip != chain.tip:
        frames.pop("tool", None)
    chain = replace(chain, **frames)
    if read["payload"] is not None:
        if tip != chain.tip:
            raise FileFormatError(
                f"{table.where}: [payload] is carried by {tip!r}; select that link with --tip"
            )
        payload = read["payload"]
        chain = chain.with_payload(Payload(payload["mass_kg"], tuple(payload["centre_m"])))
    if THERMAL in links:
        chain = replace(chain, reference_temperature=_REFERENCE.read(links[THERMAL], "reference_degc"))
    if "joint" in table or links:
        chain = chain.with_transmission(_read_transmission(chain, table.table("joint"), links))
    additions = {name: toml.pose_of(pose) for name, pose in read["link"].items()}
    known = [joint.child for joint in chain.urdf.joints]
    if unknown := [name for name in additions if name not in known]:
        raise UnknownNameError(
            f"{table.where}: [link] has {quote(unknown[0])}, no link with a joint before it; "
            f"{suggest_names(unknown[0], known)}"
        )
    return chain.with_added_origins(additions) if additions else chain


class Fitted(NamedTuple):
    """What identifies measurements that were fitted."""

    files: Sequence[str] = ()  # SHA-256 of the measurement files
    rows: bytes = b""  # Digests of the rows, see `fitted_rows`; empty if they are not known


class Findings(NamedTuple):
    """What a calibration found beside the robot itself."""

    instrument: Mapping[str, float] = {}  # Instrument parameters by name [m or rad]
    uncertainty: Uncertainty | None = None
    measured_region: MeasuredRegion | None = None
    rig: MountedRig | None = None  # Cameras and boards with their estimated poses and lenses
    fitted: Fitted = Fitted()


NO_FINDINGS = Findings()


def read_fitted(path: PathLike) -> Fitted:
    """Read what identifies the measurements that the calibration of a sidecar fitted."""
    manifest = read_toml(path, MAX_SIDECAR_BYTES).get("manifest", {})
    rows = _decode(manifest.get("fitted_rows", ""), f"{os.fspath(path)}: [manifest] fitted_rows")
    return Fitted(manifest.get("fitted_sha256", ()), rows)


def read_tip(path: PathLike) -> str | None:
    """Read the link at which the calibrated chain ends; None if the sidecar does not state it."""
    return TomlTable.read(path, MAX_SIDECAR_BYTES).some_values({"tip": _FRAME_KEYS["tip"]})["tip"]


def read_tool(path: PathLike) -> Array:
    """Read the pose of a tool."""
    table = TomlTable.read(path, MAX_SIDECAR_BYTES)
    if "tool" in table:
        return toml.read_pose(table.table("tool"))
    if "xyz_m" not in table and "rotvec_rad" not in table:
        raise FileFormatError(f"{table.where}: no tool; expected xyz_m and rotvec_rad, or a table [tool]")
    return toml.read_pose(table)


def _check_manifest(manifest: Mapping[str, str], path: str, urdf: Urdf, tip: str) -> None:
    """Require that the sidecar was written with a URDF of the same joints from the root to the tip."""
    if not _is_of(manifest, urdf, tip):
        actual = hashlib.sha256(urdf.data).hexdigest()
        raise FileFormatError(
            f"{path}: does not belong to {urdf.source}: it was written with another content of that "
            "file; calibrate again, restore the other file, or, if you edited the robot yourself, write "
            f'urdf_sha256 = "{actual}" in [manifest]'
        )


def _is_of(manifest: Mapping[str, str], urdf: Urdf, tip: str) -> bool:
    """Return whether a manifest states the bytes of a URDF or its joints from the root to the tip."""
    is_same = manifest["urdf_sha256"] == hashlib.sha256(urdf.data).hexdigest()
    return is_same or manifest["joints_sha256"] == _joints_digest(urdf, tip)


def _manifest_content(urdf: Urdf, tip: str, fitted: Fitted) -> dict[str, Any]:
    """Return the table [manifest] for a URDF that is written with the sidecar."""
    digest = hashlib.sha256(urdf.data).hexdigest()
    content = {"urdf_sha256": digest, "joints_sha256": _joints_digest(urdf, tip)}
    content |= {"fitted_sha256": list(fitted.files)} if fitted.files else {}
    return content | ({"fitted_rows": _encode(fitted.rows)} if fitted.rows else {})


def _joints_digest(urdf: Urdf, tip: str) -> str:
    """Return the SHA-256 of the joints from the root to a link."""
    lines = []
    for joint in urdf.path(tip):
        # Rounded, because sines and cosines differ in the last digit between computers.
        numbers = np.round([*joint.origin.ravel(), *joint.axis], _DIGEST_DECIMALS) + 0.0
        lines.append(repr((joint.name, joint.type, joint.parent, joint.child, numbers.tolist(), joint.mimic)))
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _read_transmission(chain: Chain, joints: TomlTable, links: Mapping[str, TomlTable]) -> Transmission:
    """Read the tables [joint.NAME] and those of links; joints and links not on the chain are ignored."""
    coefficients = np.zeros(n_coefficients(*chain.mimic_matrix.shape))
    for name in joints.keys():
        joint = joints.table(name)
        if name in chain.joint_names:
            _read_joint(chain, chain.joint_names.index(name), joint, coefficients)
        elif name not in _joints_off_path(chain):
            raise UnknownNameError(
                f"{joints.where}: unknown joint {name!r}; choose from {', '.join(chain.joint_names)}"
            )
    *_, link_terms = split_coefficients(coefficients, chain.n_joints)
    for row, family in zip(link_terms, LINK_TERMS, strict=True):
        if family not in links:
            continue
        key, table = FAMILIES[family].sidecar_key, links[family]
        for name, value in table.values(_LINK_KEYS[family])[key].items():
            if name in chain.link_names:
                row[chain.link_names.index(name)] = value
            elif name not in chain.urdf.links:
                raise UnknownNameError(
                    f"{table.table(key).where}: unknown link {name!r}; choose from "
                    f"{', '.join(chain.link_names)}"
                )
    return Transmission(coefficients, chain.loads)


def _joints_off_path(chain: Chain) -> set[str]:
    """Return the robot's joints that are not on the chain."""
    return {joint.name for joint in chain.urdf.joints} - set(chain.moving_joints)


def _read_joint(chain: Chain, i: int, table: TomlTable, coefficients: Array) -> None:
    """Read the table of joint i into the coefficients of a transmission, shape (c,)."""
    linear, harmonics, joint_terms, _ = split_coefficients(coefficients, chain.n_joints)
    if chain.is_prismatic[i]:
        table.name += " (prismatic)"
        linear[i, i] = table.values({_GAIN: _COEFFICIENT})[_GAIN]
        return
    for key in _FORMER_HARMONIC_KEYS:
        if key in table.keys():
            raise FileFormatError(
                f"{table.where}: unknown key {key!r}; write harmonics = [[order, sin_rad, cos_rad], ...]"
            )
    values = table.values(_JOINT_KEYS)
    linear[i, i] = values[_GAIN]
    joint_terms[:, i] = [values[key] for key in _JOINT_TERM_KEYS]
    others = {name: j for j, name in enumerate(chain.joint_names) if j != i}
    for name, value in values[_COUPLING].items():
        if name in others:
            linear[i, others[name]] = value
        elif name not in _joints_off_path(chain):
            raise UnknownNameError(
                f"{table.table(_COUPLING).where}: {name!r} is not another joint; choose from "
                f"{', '.join(others)}"
            )
    orders = [order for order, *_ in values[_HARMONICS]]
    for order, *factors in values[_HARMONICS]:
        if orders.count(order) > 1:
            raise FileFormatError(f"{table.where}: harmonics has the order {order} twice; write it once")
        harmonics[order - 1, :, i] = factors


def read_instrument(path: PathLike) -> dict[str, float]:
    """Read the table [instrument] of a sidecar or of a file of surveyed values."""
    return SIDECAR_KEYS["instrument"].read(TomlTable.read(path, MAX_SIDECAR_BYTES), "instrument")


def read_uncertainty(path: PathLike, chain: Chain) -> Uncertainty | None:
    """Read the table [uncertainty] of a sidecar."""
    document = TomlTable.read(path, MAX_SIDECAR_BYTES)
    if "uncertainty" not in document:
        return None
    table = document.table("uncertainty")
    values = table.values(_UNCERTAINTY_KEYS)
    terms = values["terms"]
    if values["joints"] != list(chain.moving_joints):
        raise table.error("joints", f"expected the joints of this robot: {', '.join(chain.moving_joints)}")
    indices = _coefficient_indices(chain)
    if not isinstance(terms, list):
        raise table.error("terms", "expected a list of names")
    terms = _unfolded(terms, list(indices))
    if unknown := [name for name in terms if not isinstance(name, str) or name not in indices]:
        choices = ", ".join(fold_harmonics(indices))
        raise UnknownNameError(f"{table.where}: terms has {quote(unknown[0])}; choose from {choices}")
    n_rows = 6 * (len(chain.moving_joints) + 1) + len(terms)
    entries = np.array([indices[name] for name in terms], int)
    if terms and chain.transmission is None:
        chain = chain.with_transmission(Transmission.zero(chain.loads))
    model_std = (values["model_std_m"], values["model_std_rad"])
    nothing = np.empty((n_rows, 0))
    gains = {name: FamilyGain(*numbers) for name, *numbers in values["left_out"]}
    freedom = values["degrees_of_freedom"]
    residual_std = values["residual_std_m"], values["residual_std_rad"]
    noise = None if None in residual_std else residual_std
    fit = None if freedom is None else ModelFit(values["chi_square"], freedom, gains, noise)
    known = Uncertainty(chain, entries, nothing, nothing, values["temperature"], model_std, fit=fit)
    if values["information"] is not None:
        return _read_information(table.table("information"), values["information"], known)
    if missing := [key for key in ("sqrt_covariance", "unbounded_directions") if values[key] is None]:
        raise table.error(missing[0], "expected base64 text, or a table [uncertainty.information]")
    columns = {
        key: _as_rows(_decode(values[key], f"{table.where}: {key}"), n_rows, "<f8", f"{table.where}: {key}")
        for key in ("sqrt_covariance", "unbounded_directions", "frame_part")
        if values[key] is not None
    }
    n_columns = columns["sqrt_covariance"].shape[1] + columns["unbounded_directions"].shape[1]
    if "frame_part" in columns and columns["frame_part"].shape[1] != n_columns:
        raise table.error("frame_part", f"expected {n_columns} columns, as in the other two arrays together")
    return replace(known, **columns)


def _read_information(table: TomlTable, values: Mapping[str, Any], known: Uncertainty) -> Uncertainty:
    """Read the table [uncertainty.information] of an uncertainty without columns."""
    n_rows, texts = len(known.sqrt_covariance), values["conditions"]
    n_bodies, where = n_rows - len(known.entries), f"{table.where}: conditions"
    n_of = _condition_sizes(known.chain)
    if "q" not in texts:
        raise FileFormatError(f"{where}: q is missing; calibrate again to replace it")
    if unknown := [name for name in texts if name not in n_of]:
        raise FileFormatError(
            f"{where}: unknown condition {quote(unknown[0])}; choose from {', '.join(n_of)}"
        )
    conditions = {
        name: _read_compressed(text, n_of[name], _CONDITION_TYPE, f"{where}: {name}")
        for name, text in texts.items()
    }
    roots = _read_compressed(values["roots"], _N_UPPER, _ROOTS_TYPE, f"{table.where}: roots")
    if len({array.shape[1] for array in (roots, *conditions.values())}) > 1:
        raise table.error("roots", "expected as many columns as each of the conditions")
    shaped = {
        name: array.T.reshape(-1, *_CONDITION_SHAPES.get(name, array.shape[:1]))
        for name, array in conditions.items()
    }
    samples = Samples(Conditions(**shaped), roots, np.array(values["units"]))
    arrays: dict[str, Array] = {}
    n_parameters = 0
    for key, number in _INFORMATION_TYPES.items():
        rows = {"geometry": n_bodies, "gauge": n_rows}.get(key, n_parameters)
        arrays[key] = _read_compressed(values[key], rows, number, f"{table.where}: {key}")
        n_parameters = arrays["geometry"].shape[1] + len(known.entries)
    if arrays["prior"].shape[1] != 1:
        raise table.error("prior", f"expected {n_parameters} numbers")
    arrays["prior"] = arrays["prior"][:, 0]
    found = expand(Information(samples, factor=values["factor"], **arrays), known)
    if found is None:
        raise FileFormatError(f"{table.where} has no finite covariance; calibrate again to replace it")
    return found


def _condition_sizes(chain: Chain) -> dict[str, int]:
    """Return the numbers per sample of the conditions that the model of a robot depends on."""
    n = chain.n_joints
    sizes = {"q": n, "approach": n, "zeros": n, "temperature": 1, "payload": 1}
    return {**sizes, "base_motion": 16, "tool_motion": 16, "growth": len(chain.moving_joints) + 1}


def _read_compressed(text: str, n_rows: int, number: str, where: str) -> Array:
    """Return an array with n rows from the text of `_compressed_text`."""
    size = np.dtype(number).itemsize
    max_bytes = size * n_rows * _MAX_COLUMNS
    decompressor = lzma.LZMADecompressor(lzma.FORMAT_XZ, MAX_SIDECAR_BYTES << 2)
    try:
        content = decompressor.decompress(base64.b85decode("".join(text.split())), max_bytes + 1)
    except (lzma.LZMAError, ValueError):
        content = b""
    if not decompressor.eof or len(content) > max_bytes or len(content) % size:
        raise FileFormatError(f"{where} is not a compressed array; calibrate again to replace it")
    data = np.frombuffer(content, np.uint8).reshape(size, -1).T.tobytes()
    if np.dtype(number).kind == "i":
        folded = np.frombuffer(data, number.replace("i", "u")).astype(np.int64)
        data = ((folded >> 1) ^ -(folded & 1)).astype(number).tobytes()
    return _as_rows(data, n_rows, number, where)


def _folded(terms: Sequence[str], order: Sequence[str]) -> list[str]:
    """Write successive names of an order as `FIRST ... LAST`."""
    position = {name: number for number, name in enumerate(order)}
    runs: list[list[str]] = []
    for name in terms:
        if runs and position[name] == position[runs[-1][-1]] + 1:
            runs[-1].append(name)
        else:
            runs.append([name])
    return [name for run in runs for name in (run if len(run) < 3 else [f"{run[0]}{_RANGE}{run[-1]}"])]


def _unfolded(terms: Sequence[Any], order: Sequence[str]) -> list[Any]:
    """Replace each `FIRST ... LAST` by the names of an order from the first to the last one."""
    position = {name: number for number, name in enumerate(order)}
    names: list[Any] = []
    for term in terms:
        first, _, last = term.partition(_RANGE) if isinstance(term, str) else (term, "", "")
        is_range = first in position and last in position
        names += order[position[first] : position[last] + 1] if is_range else [term]
    return names


def read_measured_region(path: PathLike, chain: Chain) -> MeasuredRegion | None:
    """Read the table [measured] of a sidecar."""
    document = TomlTable.read(path, MAX_SIDECAR_BYTES)
    if "measured" not in document:
        return None
    table = document.table("measured")
    sides = ("lower", "upper", "spread")
    values = table.values(_MEASURED_KEYS | dict.fromkeys(sides, toml.vector(chain.n_joints)))
    if values["joints"] != list(chain.joint_names):
        raise table.error("joints", f"expected the joints of this robot: {', '.join(chain.joint_names)}")
    key, number = ("configurations", "<f8") if values["centres"] is None else ("centres", "<f4")
    where = f"{table.where}: {key}"
    rows = _as_rows(_decode(values[key], where), chain.n_joints, number, where)
    if not rows.size:
        raise table.error(key, "expected at least one configuration")
    lower, upper, spread = (np.array(values[key]) for key in sides)
    payloads = None if values["payload_kg"] is None else tuple(values["payload_kg"])
    return MeasuredRegion(
        chain.is_prismatic, lower, upper, spread, rows.T.copy(), values["radius"], values["reach"], payloads
    )


def _coefficient_indices(chain: Chain) -> dict[str, int]:
    """Return the index of each transmission coefficient, those of the parameters of the chain first."""
    parameters = (parameter for name in FAMILIES for parameter in PARAMETER_SETS[name](chain))
    found = {p.name: p.coefficient_index for p in parameters if p.coefficient_index is not None}
    # Gravity may have loaded other joints of the nominal robot.
    parts = coefficient_indices(*chain.mimic_matrix.shape)
    return found | {
        f"{(chain.link_names if family.link_term else chain.joint_names)[c.owner]}.{c.name}": c.entry
        for family in FAMILIES.values()
        for c in family.coefficients(chain, parts)
    }


def _decode(text: Any, where: str) -> bytes:
    """Decode base64 text."""
    try:
        return base64.b64decode("".join(text.split()), validate=True)
    except (AttributeError, binascii.Error, ValueError):
        raise FileFormatError(f"{where} is not base64 text; calibrate again to replace it") from None


def _as_rows(data: bytes, n_rows: int, number: str, where: str) -> Array:
    """Return the numbers of an array with n rows."""
    size = np.dtype(number).itemsize
    if len(data) % (size * n_rows) if n_rows else data:
        raise FileFormatError(
            f"{where} does not hold {n_rows} rows of {8 * size}-bit numbers; calibrate again to replace it"
        )
    rows = np.frombuffer(data, number).reshape(n_rows, -1 if n_rows else 0).astype(float)
    if not np.isfinite(rows).all():
        raise FileFormatError(f"{where} has numbers that are not finite; calibrate again to replace it")
    return rows


# --- writing ---------------------------------------------------------------------------------------


def sidecar_text(
    chain: Chain,
    tool: Array,
    urdf: Urdf,
    findings: Findings,
    additions: Mapping[str, Array],
    *,
    required: bool = False,
) -> str | None:
    """Return the text of the sidecar of a calibrated robot."""
    tables = {
        "link": {name: toml.pose_content(pose) for name, pose in additions.items()},
        "payload": (load := chain.payload) and {"mass_kg": load.mass, "centre_m": list(load.centre)},
        "joint": _transmission_content(chain),
        **_link_content(chain),
        "instrument": {name: float(value) for name, value in findings.instrument.items()},
        "uncertainty": _uncertainty_content(findings.uncertainty),
        "measured": _measured_content(chain, findings.measured_region),
        **(rig_content(rig.cameras, rig.boards) if (rig := findings.rig) else {}),
    }
    tables = {key: table for key, table in tables.items() if table}
    has_frames = not all(np.array_equal(pose, np.eye(4)) for pose in (chain.base, tool))
    if not (required or tables or has_frames):
        return None
    header = _HEADER + "".join(text for key, text in _TABLE_HEADERS.items() if key in tables)
    content = {
        "tip": chain.tip,
        "base": toml.pose_content(chain.base),
        "tool": toml.pose_content(tool),
        "manifest": _manifest_content(urdf, chain.tip, findings.fitted),
        **tables,
    }
    # tomli_w writes each number on a line of its own; one line per harmonic is easier to read.
    return header + _HARMONIC_LINES.sub(r"    [\1, \2, \3]", _toml_text(content))


def _toml_text(content: dict[str, Any]) -> str:
    """Return TOML text; base64 texts are inserted at the end, as tomli_w takes half a minute for 7 MB."""
    inserted: list[str] = []

    def with_numbers(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: with_numbers(each) for key, each in value.items()}
        if isinstance(value, str) and _ENCODED_LINES.fullmatch(value):
            inserted.append(value)
            return f"{len(inserted) - 1}\n"
        return value

    text = tomli_w.dumps(with_numbers(content), multiline_strings=True)
    # Texts in single quotes have no escapes, which makes them faster to read.
    return _TEXT_NUMBER.sub(lambda match: f"'''\n{inserted[int(match[1])]}'''", text)


def _transmission_content(chain: Chain) -> dict[str, Any]:
    """Return the tables [joint.NAME] of all coefficients that are not zero."""
    if chain.transmission is None:
        return {}
    transmission, names = chain.transmission, chain.joint_names
    content: dict[str, Any] = {}
    for i, name in enumerate(names):
        harmonics = transmission.harmonics[:, :, i]
        joint: dict[str, Any] = {
            _GAIN: transmission.linear[i, i].item(),
            _HARMONICS: [[k + 1, *harmonics[k].tolist()] for k in np.flatnonzero(harmonics.any(1)).tolist()],
            **{
                key: row[i].item()
                for key, row in zip(_JOINT_TERM_KEYS, transmission.joint_terms, strict=True)
            },
            _COUPLING: {
                names[j]: transmission.linear[i, j].item()
                for j in np.flatnonzero(transmission.linear[i])
                if j != i
            },
        }
        if joint := {key: value for key, value in joint.items() if value}:
            content[name] = joint
    return content


def _link_content(chain: Chain) -> dict[str, Any]:
    """Return the tables of the families of links that have a coefficient that is not zero."""
    if chain.transmission is None:
        return {}
    content: dict[str, Any] = {}
    for family, row in zip(LINK_TERMS, chain.transmission.link_terms, strict=True):
        if not row.any():
            continue
        reference = {"reference_degc": chain.reference_temperature} if family == THERMAL else {}
        values = {chain.link_names[j]: row[j].item() for j in np.flatnonzero(row).tolist()}
        content[family] = {**reference, FAMILIES[family].sidecar_key: values}
    return content


def _uncertainty_content(uncertainty: Uncertainty | None) -> dict[str, Any]:
    """Return the table [uncertainty]; empty if the noise, and with it the covariance, is unknown."""
    if uncertainty is None or not np.isfinite(uncertainty.sqrt_covariance).all():
        return {}
    indices = _coefficient_indices(uncertainty.chain) if len(uncertainty.entries) else {}
    names = {index: name for name, index in indices.items()}
    found = compact(uncertainty)
    if found is None:
        columns: dict[str, Any] = {
            "sqrt_covariance": _encode(uncertainty.sqrt_covariance),
            "unbounded_directions": _encode(uncertainty.unbounded_directions),
            **({"frame_part": _encode(uncertainty.frame_part)} if uncertainty.has_free_frames else {}),
        }
    else:
        columns = {"information": _information_content(found)}
    return {
        "joints": list(uncertainty.chain.moving_joints),
        "terms": _folded([names[int(index)] for index in uncertainty.entries], list(indices)),
        "temperature": uncertainty.temperature,
        "model_std_m": uncertainty.model_std[0],
        "model_std_rad": uncertainty.model_std[1],
        **_fit_content(uncertainty.fit),
        **columns,
    }


def _fit_content(fit: ModelFit | None) -> dict[str, Any]:
    """Return the keys of [uncertainty] that say how well the model explains its measurements."""
    if fit is None:
        return {}
    left_out = [[name, *astuple(each)] for name, each in fit.gains.items()]
    return {
        **({} if fit.chi_square is None else {"chi_square": fit.chi_square}),
        "degrees_of_freedom": float(fit.freedom),
        **dict(zip(("residual_std_m", "residual_std_rad"), fit.residual_std or (), strict=False)),
        **({"left_out": left_out} if left_out else {}),
    }


def _information_content(found: Information) -> dict[str, Any]:
    """Return the table [uncertainty.information]."""
    samples = found.samples
    texts = {key: _compressed_text(getattr(found, key), number) for key, number in _INFORMATION_TYPES.items()}
    conditions = {
        name: getattr(samples.conditions, name).reshape(len(samples.conditions.q), -1).T
        for name in sorted(samples.conditions.names | {"q"})
    }
    return {
        "factor": found.factor,
        "units": samples.units.tolist(),
        **texts,
        "roots": _compressed_text(samples.roots, _ROOTS_TYPE),
        "conditions": {name: _compressed_text(rows, _CONDITION_TYPE) for name, rows in conditions.items()},
    }


def _measured_content(chain: Chain, region: MeasuredRegion | None) -> dict[str, Any]:
    """Return the table [measured]; empty without a region."""
    if region is None:
        return {}
    return {
        "joints": list(chain.joint_names),
        "lower": region.lower.tolist(),
        "upper": region.upper.tolist(),
        "spread": region.spread.tolist(),
        "radius": region.radius,
        "reach": region.reach,
        **({} if region.payloads is None else {"payload_kg": list(region.payloads)}),
        "centres": _encode(region.configurations.T, "<f4"),
    }


def _compressed_text(rows: Array, number: str) -> str:
    """Compress an array and encode it as lines of base85 text."""
    values = np.ascontiguousarray(rows, number)
    if values.dtype.kind == "i":
        # Small integers of both signs become small ones without a sign: 0, -1, 1, -2 to 0, 1, 2, 3.
        wide = values.astype(np.int64)
        values = ((wide << 1) ^ (wide >> 63)).astype(number.replace("i", "u"))
    # The first bytes of all numbers stand together, then the second ones: equal bytes become neighbours.
    planes = values.reshape(-1, 1).view(np.uint8).T.tobytes()
    return _lines(base64.b85encode(lzma.compress(planes, check=lzma.CHECK_CRC32)).decode())


def _encode(data: bytes | Array, number: str = "<f8") -> str:
    """Encode bytes, or the numbers of an array, as lines of base64 text."""
    data = data if isinstance(data, bytes) else np.ascontiguousarray(data, number).tobytes()
    return _lines(base64.b64encode(data).decode())


def _lines(text: str) -> str:
    """Divide a text into lines."""
    return "\n".join([*(text[i : i + _LINE_LENGTH] for i in range(0, len(text), _LINE_LENGTH)), ""])
