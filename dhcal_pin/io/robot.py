"""Robots in and out: URDF or DH file to a chain, a calibrated chain back to URDF and sidecar."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..estimation.uncertainty import Uncertainty
from ..exceptions import DhcalError
from ..robot.chain import Chain
from ..robot.dh import DHTable
from ..robot.urdf import parse_urdf
from ..robot.urdf_edit import with_origins
from ..se3 import to_xyz_rpy
from .atomic import write_files
from .dh_file import is_dh, read_dh, read_frame
from .sidecar import (
    existing_sidecar,
    payload_lines,
    read_payload,
    sidecar_path,
    sidecar_text,
    transmission_lines,
    uncertainty_lines,
    with_transmission,
)
from .tabular import read_toml
from .ur_kinematics import ORIGIN_KEYS, read_ur_kinematics

# A written URDF must read back as the same robot to this many metres and radians.
READ_BACK_TOL = 1e-12


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
        placed = placed.with_payload(read_payload(raw["payload"], os.fspath(path)))
    return with_transmission(placed, raw["joint"], os.fspath(path)) if "joint" in raw else placed


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
        chain, again = chain.with_transmission(written), again.with_transmission(written)
    rng = np.random.default_rng(0)
    q = rng.uniform(-np.pi, np.pi, (50, chain.n_joints))
    wanted = chain.poses(q)
    gap = np.abs(again.poses(q) - wanted).max()
    if not gap <= READ_BACK_TOL * max(1.0, np.abs(wanted).max()):
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


class CalibratedRobot(Protocol):
    """What `write_urdf` needs of a calibration result."""

    @property
    def chain(self) -> Chain:
        """Calibrated chain."""
        ...

    @property
    def transferable_instruments(self) -> Mapping[str, float]:
        """Instrument parameters that hold for other measurements too, by name [m or rad]."""
        ...

    @property
    def uncertainty(self) -> Uncertainty | None:
        """Uncertainty of the calibrated chain."""
        ...


def write_urdf(fit: CalibratedRobot | Chain, path: PathLike) -> None:
    """Writes the calibrated URDF, and its sidecar where base or tool need one or an old one lies there.

    Only the origins of joints that moved change; every other byte is the nominal file's.

    Raises:
        DhcalError: the path cannot be written, or is the nominal file.
    """
    chain = fit if isinstance(fit, Chain) else fit.chain
    if (
        os.path.exists(path)
        and os.path.exists(chain.urdf.source)
        and os.path.samefile(path, chain.urdf.source)
    ):
        raise DhcalError(f"{os.fspath(path)}: is the nominal robot itself; write to another file")
    instrument, known = (
        (None, None) if isinstance(fit, Chain) else (fit.transferable_instruments, fit.uncertainty)
    )
    write_files(urdf_files(chain, path, instrument, known))


def origins_text(chain: Chain) -> str:
    """CSV of every joint's own origin on the path, for people who keep their robot in xacro; m and rad."""
    moved, _ = joint_origins(chain)
    lines = ["joint," + ",".join(f"{k}[{'m' if k in 'xyz' else 'rad'}]" for k in ORIGIN_KEYS)]
    for joint in chain.urdf.path(chain.tip):
        lines.append(",".join([joint.name, *map(repr, to_xyz_rpy(moved.get(joint.name, joint.origin)))]))
    return "\n".join(lines) + "\n"
