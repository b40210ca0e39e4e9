"""Robots in and out: URDF or DH file to a chain, a calibrated chain back to URDF and sidecar."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from .._typing import PathLike
from ..estimation.uncertainty import Uncertainty
from ..exceptions import DhcalError, FileFormatError, InvalidArgumentError
from ..robot.chain import Chain
from ..robot.dh import Convention, DHTable
from ..robot.urdf import parse_urdf, read_urdf
from ..robot.urdf_edit import with_origins
from .atomic import write_files
from .dh_file import convert_to_dh, read_dh, read_frame
from .joint_origins import convert_to_origins, joint_origins
from .robot_format import ConvertedRobot, RobotFormat, RobotSource
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
from .ur_kinematics import convert_to_ur_kinematics, read_ur_kinematics

# A written URDF must read back as the same robot to this many metres and radians.
READ_BACK_TOL = 1e-12


def robot_name(path: PathLike) -> str:
    """`dir/arm.dh.toml` → `arm`."""
    return Path(path).name.split(".")[0] or "arm"


def _urdf_of_table(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a DH table to its exact URDF."""
    if robot.table is None:
        others = ", ".join(_endings(FORMATS[1:]))
        raise InvalidArgumentError(f"{os.fspath(path)}: {robot.path} is already a URDF; choose from {others}")
    if robot.convention is not None:
        raise InvalidArgumentError(f"{robot.path}: a URDF has no DH convention; leave out --convention")
    sidecar = existing_sidecar(path)
    notes = [f"{sidecar} lies beside it and is read with it"] if sidecar else []
    return ConvertedRobot(robot.chain.urdf.data.decode(), notes)


# The formats that robots are read from and written to. An ending selects its row; the longest one wins.
FORMATS = (
    RobotFormat("URDF", (".urdf",), _urdf_of_table, read_urdf=read_urdf),
    RobotFormat(
        "DH table",
        (".dh.toml", ".dh.csv"),
        convert_to_dh,
        read_table=read_dh,
        other_endings=(".toml", ".csv"),
    ),
    RobotFormat(
        "kinematics of Universal Robots",
        (".yaml",),
        convert_to_ur_kinematics,
        read_table=read_ur_kinematics,
        other_endings=(".yml",),
    ),
    RobotFormat("table of joint origins", (".origins.csv",), convert_to_origins),
)


def _endings(formats: Iterable[RobotFormat]) -> list[str]:
    return [ending for robot_format in formats for ending in robot_format.endings]


def find_format(path: PathLike) -> RobotFormat | None:
    """Find the format of a robot file by the ending of its name.

    Args:
        path: Path of the file, which need not exist.

    Returns:
        Row of `FORMATS`; None if no format has the ending.
    """
    name = os.fspath(path).lower()
    by_ending = {
        ending: robot_format
        for robot_format in FORMATS
        for ending in (*robot_format.endings, *robot_format.other_endings)
        if name.endswith(ending)
    }
    return by_ending[max(by_ending, key=len)] if by_ending else None


def formats_help() -> str:
    """Return one line per robot file format, for help texts."""
    width = max(len(robot_format.name) for robot_format in FORMATS)
    lines = []
    for robot_format in FORMATS:
        endings = ", ".join((*robot_format.endings, *robot_format.other_endings))
        note = "" if robot_format.is_readable else "; only written"
        lines.append(f"  {robot_format.name:{width}}  {endings}{note}")
    return "\n".join(["file formats of robots:", *lines])


def has_dh_table(path: PathLike) -> bool:
    """Return whether a path names a robot file that holds a DH table.

    Args:
        path: Path of the file, which need not exist.

    Returns:
        True if the robot has one tip only, so that it cannot be chosen by name.
    """
    robot_format = find_format(path)
    return robot_format is not None and robot_format.read_table is not None


def _read(path: PathLike, tip: str | None, sidecar: PathLike | None) -> tuple[Chain, DHTable | None]:
    """Read the chain of a robot file and its sidecar, and its DH table if it has one."""
    robot_format = find_format(path)
    table = None
    if robot_format is None:
        chain = Chain.from_urdf(path, tip)
    elif robot_format.read_table is not None:
        if tip is not None:
            raise InvalidArgumentError(f"{os.fspath(path)}: a DH table has one tip; leave out --tip")
        table = robot_format.read_table(path)
        chain = Chain.from_dh(table, robot_name(path))
    elif robot_format.read_urdf is not None:
        chain = Chain.from_urdf(robot_format.read_urdf(path), tip)
    else:
        readable = ", ".join(_endings(other for other in FORMATS if other.is_readable))
        raise FileFormatError(
            f"{os.fspath(path)}: a {robot_format.name} cannot be read as a robot; choose from {readable}"
        )
    sidecar = sidecar or existing_sidecar(path)
    return (chain if sidecar is None else _with_sidecar(chain, sidecar)), table


def read_robot(path: PathLike, tip: str | None = None, sidecar: PathLike | None = None) -> Chain:
    """Read a robot and its sidecar.

    Args:
        path: File in one of `FORMATS`; a file with another ending is read as a URDF.
        tip: Tip link of a URDF; the deepest leaf if None.
        sidecar: Sidecar to read in place of the one beside the robot.

    Returns:
        The chain from the base link to the tip.

    Raises:
        DhcalError: A file is missing or invalid, or a tip is given for a DH table.
    """
    return _read(path, tip, sidecar)[0]


def convert_robot(
    source: PathLike, target: PathLike, tip: str | None = None, convention: Convention | None = None
) -> ConvertedRobot:
    """Convert a robot file to another format, chosen by the ending of the target.

    Args:
        source: File to read.
        target: File to write; only its name is used.
        tip: Tip link of a URDF; the deepest leaf if None.
        convention: Convention of a DH table that is written.

    Returns:
        Text of the target file, and notes on what it could not hold.

    Raises:
        DhcalError: A file is missing or invalid, or the target's format cannot hold the robot.
    """
    robot_format = find_format(target)
    if robot_format is None:
        raise InvalidArgumentError(
            f"{os.fspath(target)}: unknown ending; choose from {', '.join(_endings(FORMATS))}"
        )
    chain, table = _read(source, tip, None)
    return robot_format.convert(RobotSource(os.fspath(source), chain, table, convention), target)


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
