"""Robot files: reading robots of all formats, converting between formats, writing calibrated robots.

`FORMATS` lists the formats; the ending of a file name selects one. Whatever the format, the sidecar beside a
robot is read with it. A calibrated robot is written as its nominal URDF with changed joint origins, plus a
sidecar.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import DhcalError, FileFormatError, InvalidArgumentError, RefusedCalibrationError
from ..messages import escape_control_characters, quote
from ..robot.chain import Chain, without_mimics
from ..robot.dh import Convention, DHTable
from ..robot.formats import mjcf_edit
from ..robot.formats.mjcf import Mjcf, parse_mjcf, read_mjcf
from ..robot.urdf import Urdf, parse_urdf, read_urdf, suggest_names
from ..robot.urdf_edit import with_origins
from ..robot.urdf_path import default_tip
from ..ros_packages import validated_package_dirs
from ..saving import complete_interrupted_save, write_files
from .dh_file import convert_to_dh, read_dh
from .makers.staubli_arm import correct_staubli_arm
from .makers.ur_kinematics import convert_to_ur_kinematics, read_ur_kinematics
from .measurement_files.fitted_rows import fitted_row_digests
from .origins_file import convert_to_origins, joint_origins, without_negligible_moves
from .read_back import require_agreement
from .robot_format import ConvertedRobot, RobotFormat, RobotSource
from .shipped_files import resolve_robot_file
from .sidecar import (
    NO_FINDINGS,
    Findings,
    Fitted,
    belongs_to,
    existing_sidecar,
    read_tip,
    sidecar_path,
    sidecar_text,
    with_sidecar,
)
from .tables import WORKBOOK_ENDINGS
from .template import with_kinematics

# Smaller entries of an addition to a joint origin are rounding errors [m or rad].
ADDITION_TOL = 1e-14
# Largest difference between the poses of a chain and of its written URDF, relative to the largest entry of
# the poses or 1.
READ_BACK_TOL = 1e-12
# Largest difference of a tip after the kinematics were written into another file [m].
TEMPLATE_TOL = 1e-9
# Number of random configurations at which they are compared.
N_READ_BACK_SAMPLES = 50


# Why nothing but an MJCF becomes an MJCF.
_NEEDS_TEMPLATE = "an MJCF holds more than kinematics; give the MJCF of the robot with --template"


def robot_name(path: PathLike) -> str:
    """Return the name of a robot from the path of its file."""
    return escape_control_characters(Path(path).name.split(".")[0]) or "arm"


def _urdf_of_table(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Convert a DH table to its exact URDF."""
    return ConvertedRobot(robot.chain.urdf.data.decode(), _notes_beside(path, robot.chain.urdf))


def _mjcf_needs_template(robot: RobotSource, path: PathLike) -> ConvertedRobot:
    """Refuse to make an MJCF of a DH table."""
    raise InvalidArgumentError(f"{os.fspath(path)}: {_NEEDS_TEMPLATE}")


def _copy(source: PathLike, target: PathLike, urdf: Urdf) -> ConvertedRobot:
    """Copy a URDF or an MJCF, or translate an MJCF to a URDF; no single deepest tip is needed."""
    notes = [*_notes_beside(target, urdf), *_notes_on_sidecar(source)]
    if not is_mjcf_path(target):
        if isinstance(urdf, Mjcf):
            notes.append(
                f"{os.fspath(target)} has the kinematics and the stated masses of the MJCF, no meshes"
            )
        return ConvertedRobot(urdf.data.decode(), notes)
    if not isinstance(urdf, Mjcf):
        raise InvalidArgumentError(f"{os.fspath(target)}: {_NEEDS_TEMPLATE}")
    return ConvertedRobot(urdf.file.decode(), notes)


def _notes_beside(path: PathLike, urdf: Urdf) -> list[str]:
    """Note a sidecar beside a robot that is to be written; require that it was written with this robot."""
    sidecar = existing_sidecar(path)
    if sidecar and not belongs_to(sidecar, urdf):
        raise InvalidArgumentError(
            f"{os.fspath(path)}: {sidecar} lies beside it, belongs to another robot file and would be "
            "read with it; choose another name"
        )
    return [f"{sidecar} lies beside it and is read with it"] if sidecar else []


def _notes_on_sidecar(source: PathLike) -> list[str]:
    """Note the sidecar of a robot that is written to another file."""
    sidecar = existing_sidecar(source)
    return [f"{sidecar} is not copied; it holds base, tool and joint errors"] if sidecar else []


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
    RobotFormat("MJCF", (".xml",), _mjcf_needs_template, read_urdf=read_mjcf, other_endings=(".mjcf",)),
    RobotFormat("joint offsets of Stäubli", (".cfx",), correct=correct_staubli_arm),
)


def is_mjcf_path(path: PathLike) -> bool:
    """Return whether a path has the ending of an MJCF."""
    robot_format = find_format(path)
    return robot_format is not None and robot_format.read_urdf is read_mjcf


def _endings(formats: Iterable[RobotFormat]) -> list[str]:
    return [ending for robot_format in formats for ending in robot_format.endings]


def find_format(path: PathLike) -> RobotFormat | None:
    """Find the format of a robot file by the ending of its name."""
    name = os.fspath(path).lower()
    by_ending = {
        ending: robot_format
        for robot_format in FORMATS
        for ending in (*robot_format.endings, *robot_format.other_endings)
        if name.endswith(ending)
    }
    return by_ending[max(by_ending, key=len)] if by_ending else None


def has_robot_ending(path: PathLike) -> bool:
    """Return whether a path has a recommended ending of a robot file; measurements end in .csv, too."""
    robot_format = find_format(path)
    return robot_format is not None and os.fspath(path).lower().endswith(robot_format.endings)


def has_dh_table(path: PathLike) -> bool:
    """Return whether a path names a robot file that holds a DH table."""
    robot_format = find_format(path)
    return robot_format is not None and robot_format.read_table is not None


def _read_urdf(path: PathLike) -> Urdf:
    """Read a URDF or an MJCF; a file with an unknown ending is read as a URDF."""
    robot_format = find_format(path)
    if robot_format is None:
        if os.fspath(path).lower().endswith(WORKBOOK_ENDINGS):
            raise FileFormatError(
                f"{os.fspath(path)}: a workbook holds no robot; save a DH table as .dh.csv or .dh.toml"
            )
        return read_urdf(path)
    if robot_format.correct is not None:
        raise FileFormatError(
            f"{os.fspath(path)}: holds corrections of a robot; apply them to the nominal one with dhcal "
            "convert and --template"
        )
    if robot_format.read_urdf is None:
        readable = ", ".join(_endings(other for other in FORMATS if other.is_readable))
        raise FileFormatError(
            f"{os.fspath(path)}: a {robot_format.name} cannot be read as a robot; choose from {readable}"
        )
    return robot_format.read_urdf(path)


def _read(
    path: PathLike,
    tip: str | None,
    sidecar: PathLike | None,
    package_dirs: Sequence[PathLike] = (),
    root: str | None = None,
) -> tuple[Chain, DHTable | None]:
    """Read the chain of a robot file and its sidecar, and its DH table if it has one."""
    path, folders = resolve_robot_file(path), validated_package_dirs(package_dirs)
    complete_interrupted_save(path)
    sidecar = sidecar or existing_sidecar(path)
    robot_format = find_format(path)
    table = None
    if robot_format is not None and robot_format.read_table is not None:
        table = robot_format.read_table(path)
        if tip is not None:
            raise InvalidArgumentError(f"{os.fspath(path)}: a DH table has one tip; leave out --tip")
        if root is not None:
            raise InvalidArgumentError(f"{os.fspath(path)}: a DH table has one root; leave out --root")
        chain = Chain.from_dh(table, robot_name(path))
        # Messages name the file of the table.
        chain = replace(chain, urdf=replace(chain.urdf, source=os.fspath(path)))
    else:
        urdf = replace(_read_urdf(path), package_dirs=folders)
        chain = Chain.from_urdf(urdf, _default_tip(urdf, sidecar) if tip is None else tip, root)
    return (chain if sidecar is None else with_sidecar(chain, sidecar)), table


def _default_tip(urdf: Urdf, sidecar: PathLike | None) -> str:
    """Return the link that the sidecar states, or else the deepest leaf."""
    stated = read_tip(sidecar) if sidecar else None
    return stated if stated is not None and stated in urdf.links else default_tip(urdf)


def read_robot(
    path: PathLike,
    tip: str | None = None,
    sidecar: PathLike | None = None,
    package_dirs: Sequence[PathLike] = (),
    root: str | None = None,
) -> Chain:
    """Read a robot and its sidecar.

    Args:
        path: File in one of `FORMATS`; a file with another ending is read as a URDF. `example:NAME` is a
            robot of example-robot-data, and `flange.urdf` a flange at any pose that ships with the package.
        tip: Tip link of a URDF; that of the sidecar if None, or else the deepest leaf.
        sidecar: Sidecar to read in place of the one beside the robot.
        package_dirs: Folders in which packages with meshes are searched first.
        root: Link of a URDF where the chain begins; the root of the URDF if None.

    Returns:
        The chain from the root to the tip. A file that is missing or invalid, and a tip given for a DH
        table, raise a `DhcalError`.
    """
    return _read(path, tip, sidecar, package_dirs, root)[0]


def convert_robot(
    source: PathLike,
    target: PathLike,
    tip: str | None = None,
    convention: Convention | None = None,
    template: PathLike | None = None,
    template_tip: str | None = None,
    root: str | None = None,
) -> ConvertedRobot:
    """Convert a robot file to the format of the ending of the target; return its text, and notes."""
    robot_format = find_format(target)
    if robot_format is None or robot_format.convert is None:
        written = _endings(other for other in FORMATS if other.convert)
        raise InvalidArgumentError(f"{os.fspath(target)}: unknown ending; choose from {', '.join(written)}")
    source_format = find_format(source)
    if robot_format.read_urdf is not None:
        if convention is not None:
            raise InvalidArgumentError(
                f"{os.fspath(target)}: a URDF has no DH convention; leave out --convention"
            )
        if template is not None:
            return _with_template(source, target, tip, template, template_tip, root)
        if source_format is None or source_format.read_urdf is not None:
            return _copy(source, target, _read_urdf(source))
    elif template is not None:
        raise InvalidArgumentError(f"{os.fspath(target)}: only a URDF or an MJCF has a template")
    chain, table = _read(source, tip, None, root=root)
    robot = RobotSource(chain.urdf_alone, table, convention)
    converted = robot_format.convert(robot, target)
    return ConvertedRobot(converted.text, [*converted.notes, *_notes_on_sidecar(source)])


def _with_template(
    source: PathLike,
    target: PathLike,
    tip: str | None,
    template: PathLike,
    template_tip: str | None,
    root: str | None,
) -> ConvertedRobot:
    """Write the kinematics of a robot into another file of it."""
    nominal = None if has_dh_table(template) else _read_urdf(resolve_robot_file(template))
    if nominal is None or is_mjcf_path(target) != isinstance(nominal, Mjcf):
        raise InvalidArgumentError(
            f"{os.fspath(target)}: {os.fspath(template)} has another format; expected a URDF for a .urdf "
            "and an MJCF for an .xml"
        )
    notes: list[str] = []
    source_format = find_format(source)
    if source_format is not None and source_format.correct is not None:
        robot, applied = source_format.correct(source, Chain.from_urdf(nominal, template_tip or tip, root))
        notes += applied
    else:
        robot = _read(source, tip, None, root=root)[0].urdf_alone
    if template_tip is None and robot.tip not in nominal.links:
        raise InvalidArgumentError(
            f"{nominal.source}: no link {quote(robot.tip)} as in {robot.urdf.source}; name the same frame "
            f"with --template-tip: {suggest_names(robot.tip, nominal.links)}"
        )
    nominal_chain = Chain.from_urdf(nominal, template_tip or robot.tip, root)
    filled = with_kinematics(nominal_chain, robot, template)
    data, urdf = with_written_origins(nominal, joint_origins(filled)[0], target)
    parsed = Chain.from_urdf(urdf, filled.tip, root)
    q = _random_positions(len(robot.moving_joints))
    ideal = replace(robot, base=np.eye(4), tool=np.eye(4))
    difference = np.abs(without_mimics(parsed).poses(q) - without_mimics(ideal).poses(q)).max()
    if not difference <= TEMPLATE_TOL:
        raise InvalidArgumentError(
            f"{nominal.source}: cannot hold the tip of {robot.urdf.source}, which would be {difference:.2g} "
            "off; choose a --template-tip behind a fixed joint, or a site"
        )
    require_agreement(parsed, nominal_chain, target)
    notes += _notes_beside(target, urdf)
    return ConvertedRobot(data.decode(), [*notes, *_notes_on_sidecar(source)])


def _random_positions(n_joints: int) -> Array:
    """Return the joint positions at which a written robot is compared, shape (m, n)."""
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (N_READ_BACK_SAMPLES, n_joints))


def complete_geometry(chain: Chain, path: PathLike) -> bytes:
    """Return the robot file with the joint origins of the complete model, to use with joint corrections."""
    geometry = replace(chain, transmission=None, urdf_origins=None)
    return with_written_origins(chain.urdf, joint_origins(geometry)[0], path)[0]


def with_written_origins(urdf: Urdf, origins: Mapping[str, Array], path: PathLike) -> tuple[bytes, Urdf]:
    """Return the bytes of a robot file with new joint origins, and the robot that is read from them."""
    if not is_mjcf_path(path):
        data = with_origins(urdf, origins)
        return data, parse_urdf(data, os.fspath(path))
    if not isinstance(urdf, Mjcf):
        raise InvalidArgumentError(
            f"{os.fspath(path)}: {urdf.source} is no MJCF; write a .urdf, and convert it with --template"
        )
    data = mjcf_edit.with_origins(urdf, origins)
    return data, parse_mjcf(data, os.fspath(path))


def urdf_files(
    chain: Chain,
    path: PathLike,
    findings: Findings = NO_FINDINGS,
    edit: Callable[[bytes], bytes] = lambda data: data,
) -> dict[PathLike, str | bytes]:
    """Return the contents of a calibrated URDF and its sidecar, which are read again and compared."""
    # A sidecar that exists already is always replaced, because it would be read with the new URDF.
    robot_format = find_format(path)
    if robot_format is None or robot_format.read_urdf is None:
        expected = " or ".join(_endings(other for other in FORMATS if other.read_urdf))
        raise InvalidArgumentError(f"{os.fspath(path)}: unknown file extension; expected {expected}")
    alone = without_negligible_moves(chain.urdf_alone)
    complete = chain if chain.urdf_origins is not None else replace(chain, origins=alone.origins)
    data, urdf = with_written_origins(chain.urdf, joint_origins(alone)[0], path)
    parsed = Chain.from_urdf(urdf, chain.tip, chain.root)
    moved, tool = joint_origins(replace(complete, urdf=urdf))
    added = {
        urdf.joint(name).child: se3.inverse(urdf.joint(name).origin) @ origin
        for name, origin in (moved if chain.urdf_origins is not None else {}).items()
    }
    additions = {name: pose for name, pose in added.items() if np.abs(pose - np.eye(4)).max() > ADDITION_TOL}
    written = replace(
        parsed,
        base=chain.base,
        tool=tool,
        payload=chain.payload,
        reference_temperature=chain.reference_temperature,
    )
    chain = complete
    if chain.transmission is not None:
        # The torque of gravity on the joints follows from the masses of the written URDF.
        transmission = replace(chain.transmission, loads=written.loads)
        chain, written = chain.with_transmission(transmission), written.with_transmission(transmission)
    if additions:
        written = written.with_added_origins(additions)
    q = _random_positions(chain.n_joints)
    poses = chain.poses(q)
    difference = np.abs(written.poses(q) - poses).max()
    if not difference <= READ_BACK_TOL * max(1.0, np.abs(poses).max()):
        raise DhcalError(
            f"{os.fspath(path)}: not written: the tool of the URDF as read back differs by {difference:.2g}; "
            "please report it"
        )
    require_agreement(parsed, alone.nominal(), path)
    data = edit(data)
    contents: dict[PathLike, str | bytes] = {path: data}
    is_replaced = existing_sidecar(path) is not None
    # The sidecar of an MJCF belongs to its translation.
    hashed = urdf.data if isinstance(urdf, Mjcf) else data
    if isinstance(urdf, Mjcf) or hashed != urdf.data:
        urdf = parse_urdf(hashed, "")
    sidecar = sidecar_text(chain, tool, urdf, findings, additions, required=is_replaced)
    if sidecar is not None:
        contents[sidecar_path(path)] = sidecar
    return contents


def findings_of(fit: Any, digests: Sequence[str] = ()) -> Findings:
    """Return what a sidecar says of a `Result`; `digests` are those of the measurement files."""
    fitted = Fitted(digests, fitted_row_digests(fit.data))
    return Findings(fit.transferable_instruments, fit.uncertainty, fit.measured_region, fit.rig, fitted)


def write_urdf(fit: Any, path: PathLike, force: bool = False) -> None:
    """Write a calibrated URDF and its sidecar.

    Only the origins of joints that moved change; every other byte is that of the nominal file. `urdf_files`
    says when a sidecar is written.

    Args:
        fit: `Result` of a calibration, or a chain alone.
        path: Path of the file to write, `.urdf`; `.xml` if the nominal robot is an MJCF.
        force: Write the robot even if the verdict on its calibration is "refused".

    Raises:
        InvalidArgumentError: The path is the nominal robot itself, or its ending is another one.
        RefusedCalibrationError: The verdict is "refused".
    """
    if not (force or isinstance(fit, Chain)) and fit.verdict.is_refused:
        reasons = " ".join(fit.verdict.reasons)
        raise RefusedCalibrationError(
            f"{os.fspath(path)}: not written, the calibration was refused: {reasons} Pass force=True to "
            "write it nevertheless."
        )
    chain = fit if isinstance(fit, Chain) else fit.chain
    nominal = chain.urdf.source
    if os.path.exists(path) and os.path.exists(nominal) and os.path.samefile(path, nominal):
        raise InvalidArgumentError(f"{os.fspath(path)}: is the nominal robot itself; write to another file")
    findings = NO_FINDINGS if isinstance(fit, Chain) else findings_of(fit)
    write_files(urdf_files(chain, path, findings))
