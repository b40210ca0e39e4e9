"""Robots in and out: URDF or DH file to a chain, a calibrated chain back to URDF and sidecar."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from . import se3
from .chain import Chain
from .dh import DHTable
from .dh_files import is_dh, read_dh, read_frame
from .errors import DhcalError
from .files import PathLike, read_toml
from .payload_files import payload_lines, read_payload
from .priors import Priors
from .result import Result
from .saving import save
from .se3 import Array
from .transmission_files import transmission_lines, with_transmission
from .uncertainty import Uncertainty
from .uncertainty_files import uncertainty_lines
from .ur_kinematics import read_ur_kinematics
from .urdf import parse_urdf
from .urdf_origins import with_origins

# A written URDF must read back as the same robot to this many metres and radians.
READ_BACK = 1e-12
_WIDEST = 1e300


def sidecar_path(path: PathLike) -> str:
    """`arm.urdf` → `arm.calibration.toml`."""
    return f"{os.path.splitext(os.fspath(path))[0]}.calibration.toml"


def existing_sidecar(path: PathLike) -> str | None:
    """The sidecar beside a robot, if there is one."""
    return sidecar_path(path) if os.path.exists(sidecar_path(path)) else None


def robot_name(path: PathLike) -> str:
    """`dir/arm.dh.toml` → `arm`."""
    return Path(path).name.split(".")[0] or "arm"


def is_table(path: PathLike) -> bool:
    """Whether a path names a DH file or UR's kinematics YAML."""
    return is_dh(path) or os.fspath(path).lower().endswith((".yaml", ".yml"))


def read_table(path: PathLike) -> DHTable:
    """A DH table from a DH file, or from UR's kinematics YAML.

    Raises:
        DhcalError: the file is missing or wrong.
    """
    return read_dh(path) if is_dh(path) else read_ur_kinematics(path)


def paper_file(name: str) -> Path:
    """A file that ships with the package, such as the paper's tables, installed or in the source tree."""
    here = Path(__file__).resolve().parent
    for folder in (here / "paper", here.parent / "urdf"):
        if (folder / name).exists():
            return folder / name
    raise DhcalError(f"{name}: no such file, nor one that ships with dhcal-pin; check its name")


def read_robot(path: PathLike, tip: str | None = None, sidecar: PathLike | None = None) -> Chain:
    """A chain from a URDF or a DH file, with what its sidecar holds where there is one.

    Args:
        path: `.urdf`, a DH table as `.toml` or `.csv`, or UR's kinematics as `.yaml`.
        tip: the tip link of a URDF.
        sidecar: another sidecar than the one beside the robot.

    Raises:
        DhcalError: a file is missing or wrong.
    """
    if is_table(path):
        if tip is not None:
            raise DhcalError(f"{os.fspath(path)}: a DH table has one tip; leave out --tip")
        chain = Chain.from_dh(read_table(path), robot_name(path))
    else:
        chain = Chain.from_urdf(path, tip)
    sidecar = sidecar or existing_sidecar(path)
    return chain if sidecar is None else _with_sidecar(chain, sidecar)


def _with_sidecar(chain: Chain, path: PathLike) -> Chain:
    raw = read_toml(path)
    tip = raw.pop("tip", chain.tip)
    if unknown := set(raw) - {"base", "tool", "payload", "joint", "instrument", "uncertainty"}:
        raise DhcalError(
            f"{os.fspath(path)}: unknown key {min(unknown)!r}; "
            "allowed: tip, [base], [tool], [payload], [joint.NAME], [instrument], [uncertainty]"
        )
    frames = {key: read_frame(raw[key], os.fspath(path), key) for key in ("base", "tool") if key in raw}
    if tip != chain.tip:
        # The tool is a place on another link.
        frames.pop("tool", None)
    placed = replace(chain, **frames)
    if "payload" in raw:
        if tip != chain.tip:
            raise DhcalError(f"{os.fspath(path)}: [payload] is carried by {tip!r}; name that with --tip")
        placed = placed.carrying(read_payload(raw["payload"], os.fspath(path)))
    return with_transmission(placed, raw["joint"], os.fspath(path)) if "joint" in raw else placed


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


def joint_origins(chain: Chain) -> tuple[dict[str, Array], Array]:
    """Each changed joint's own origin in its parent link, and the tool (4, 4) with what found no joint.

    Fixed joints before a moving one stay, so that one's own origin takes up the change. A change of the
    tip goes to the last fixed joint behind the last moving one, or to the tool where there is none.
    """
    nominal = Chain.from_urdf(chain.urdf, chain.tip)
    out: dict[str, Array] = {}
    before, moving, last = np.eye(4), 0, None
    for joint in chain.urdf.path(chain.tip):
        if joint.type != "fixed":
            if not np.array_equal(chain.origins[moving], nominal.origins[moving]):
                out[joint.name] = se3.inverse(before) @ chain.origins[moving]
            before, moving, last = np.eye(4), moving + 1, None
        else:
            last = joint.name, before
            before = before @ joint.origin
    if np.array_equal(chain.origins[-1], nominal.origins[-1]):
        return out, chain.tool
    if last is None:
        return out, se3.inverse(nominal.origins[-1]) @ chain.origins[-1] @ chain.tool
    out[last[0]] = se3.inverse(last[1]) @ chain.origins[-1]
    return out, chain.tool


def urdf_files(
    chain: Chain,
    path: PathLike,
    instrument: Mapping[str, float] | None = None,
    known: Uncertainty | None = None,
) -> dict[PathLike, str | bytes]:
    """The calibrated URDF, read back and compared, and its sidecar; by path, not yet written.

    Identity base and tool and ideal joints need no sidecar; one that is there already would be read with
    the new URDF, and is replaced.

    Args:
        chain: the calibrated arm.
        path: of the URDF.
        instrument: its values by name, m and rad.
        known: how well the arm is known.

    Raises:
        DhcalError: the written text would not be the same robot.
    """
    origins, tool = joint_origins(chain)
    data = with_origins(chain.urdf, origins)
    read = Chain.from_urdf(parse_urdf(data, os.fspath(path)), chain.tip)
    again = replace(read, base=chain.base, tool=tool, payload=chain.payload)
    joints, carried = transmission_lines(chain), payload_lines(chain.payload)
    if chain.transmission is not None:
        # From here on the written masses load the joints.
        written = replace(chain.transmission, loads=again.loads)
        chain, again = chain.driven(written), again.driven(written)
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (50, chain.size))
    wanted = chain.poses(q)
    gap = np.abs(again.poses(q) - wanted).max()
    if not gap <= READ_BACK * max(1.0, np.abs(wanted).max()):
        raise DhcalError(
            f"{os.fspath(path)}: not written: read back, the tool is off by {gap:.2g}; please report it"
        )
    out: dict[PathLike, str | bytes] = {path: data}
    plain = np.array_equal(chain.base, np.eye(4)) and np.array_equal(tool, np.eye(4))
    doubt = uncertainty_lines(known) if known else []
    if not plain or joints or carried or instrument or doubt or existing_sidecar(path):
        known_values = instrument or {}
        out[sidecar_path(path)] = sidecar_text(
            chain.tip, chain.base, tool, known_values, joints, doubt, carried
        )
    return out


def write_urdf(fit: Result | Chain, path: PathLike) -> None:
    """Writes the calibrated URDF, and its sidecar where base or tool need one or an old one lies there.

    Only the origins of joints that moved change; every other byte is the nominal file's.

    Raises:
        DhcalError: the path cannot be written, or is the nominal file.
    """
    chain = fit.chain if isinstance(fit, Result) else fit
    if (
        os.path.exists(path)
        and os.path.exists(chain.urdf.source)
        and os.path.samefile(path, chain.urdf.source)
    ):
        raise DhcalError(f"{os.fspath(path)}: is the nominal robot itself; write to another file")
    instrument, known = (fit.portable, fit.uncertainty) if isinstance(fit, Result) else (None, None)
    save(urdf_files(chain, path, instrument, known))


def read_bounds(path: PathLike | None) -> dict[str, tuple[float, float]]:
    """A TOML file of least and largest values in m and rad by parameter name or pattern; none without it.

    Raises:
        DhcalError: a value is not a pair of numbers in order.
    """
    raw = read_toml(path) if path else {}
    for name, value in raw.items():
        pair = value if isinstance(value, list) and len(value) == 2 else []
        numbers = [v for v in pair if isinstance(v, int | float) and not isinstance(v, bool)]
        if len(numbers) != 2 or not numbers[0] < numbers[1]:
            raise DhcalError(
                f"{path}: {name} = {value!r} are no bounds; write the least and the largest value "
                'in m or rad, such as "d2" = [0.12, 0.13]'
            )
    return {name: (float(low), float(high)) for name, (low, high) in raw.items()}


def read_priors(choice: str | None) -> Priors | None:
    """`default`, `none`, or a TOML file of sigmas in m and rad by parameter name or pattern.

    Raises:
        DhcalError: neither, or a sigma is not a positive number.
    """
    if choice is None or choice in ("default", "none"):
        return choice  # pyright: ignore[reportReturnType]
    if not os.path.exists(choice):
        raise DhcalError(f"--priors {choice}: neither default, none, nor a file of sigmas by parameter")
    raw = read_toml(choice)
    for name, value in raw.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= _WIDEST:
            raise DhcalError(
                f"{choice}: {name} = {value!r} is not a sigma; write a positive number in m or rad, "
                'such as "theta*" = 0.01'
            )
    return {name: float(value) for name, value in raw.items()}
