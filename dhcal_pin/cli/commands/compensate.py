"""`dhcal compensate`: compute joint values and targets that correct the errors of a calibrated robot."""

from __future__ import annotations

import math
import os
from argparse import Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ... import io, robot
from ...exceptions import InvalidArgumentError
from ...formatting import texts_by_file
from .. import screens
from ..options import JSON, ROBOT, URDF_OPTIONS, Options, motion_options, read_robot_or_table

if TYPE_CHECKING:
    from ..._typing import Array
    from ...compensation import Compensation
    from ...programs import Program

EXAMPLE = "dhcal compensate ur10.urdf ur10_calibrated.urdf targets.csv --tip tool0 -o corrected.csv"

# Frames of the targets; the first is the default.
FRAMES = BASE, MEASURING = "base", "measuring"
# A number of a URDF with this many significant digits was computed and not typed.
_COMPUTED_DIGITS = 15
# Numbers that differ from a multiple of this angle by less than the tolerance are design values [rad].
_DESIGN_ANGLE, _DESIGN_TOL = math.pi / 12, 1e-6

# Share of the targets below which most are not reached, and number of those that are tried in another unit.
_MIN_REACHED, _N_TRIED = 0.5, 20

ARGUMENTS: Options = {
    "nominal NOMINAL.urdf": {"type": ROBOT["type"], "help": "robot model of the controller"},
    "calibrated CALIBRATED.urdf": {"type": ROBOT["type"], "help": "the same robot, calibrated"},
    "targets targets.csv": "positions or poses of the tool",
    "-o --output corrected.csv": {
        "required": True,
        "help": "joint values and corrected targets to write, one row per target",
    },
    **URDF_OPTIONS,
    "--frame": {
        "choices": FRAMES,
        "default": BASE,
        "help": "frame of the targets: base (root link of the nominal robot, default) or measuring "
        "(measuring frame of the calibration)",
    },
    "--tcp FRAME|FILE": "tool that reaches the targets: a link fixed to the tip, or a TOML file with xyz_m "
    "and rotvec_rad in the tip link (default: the tip; with --frame measuring the measured point)",
    **motion_options("rad"),
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Correct targets, write them, and show which could not be reached."""
    from ...compensation import compensate  # lazy import, as the following: they load Pinocchio
    from ...programs import FORMATS, program_text
    from ..output_table import Output, numbered
    from ..outputs import checked_files, existing_sidecars, write_with_json

    robots = [args.nominal, args.calibrated]
    tcp_file = [args.tcp] if args.tcp and os.path.exists(args.tcp) else []
    inputs = [*robots, *existing_sidecars(robots), args.targets, *tcp_file]
    table = {
        "output": Output("corrected targets", (".csv",)),
        "export": Output("a program", tuple(FORMATS)),
        "json": Output(),
    }
    checked_files(args, table, inputs)
    chains = read_robots(args)
    nominal, calibrated = in_frame_of_targets(args, *chains)
    targets = io.read_targets(args.targets, calibrated)
    with screens.progress_bar("compensating", len(targets.values)) as progress:
        result = compensate(nominal, calibrated, targets.values, targets.near, progress, targets.conditions)
    contents = {args.output: corrected_text(result, calibrated, targets, args.joint_units)}
    for path in args.export:
        contents[path] = program_text(_program(result, nominal), path)
    frame = f"the root link {nominal.root}" if args.frame == BASE else "the measuring frame"
    notes = [
        f"{targets.source}: {text}"
        for text in (
            *([] if args.frame == MEASURING else _frame_notes(*chains)),
            *_unstated_conditions(args, calibrated, targets),
        )
    ]
    warning = robots_warning(args.nominal, args.calibrated, nominal, calibrated)
    warnings = {args.nominal: [warning]} if warning else {}
    write_with_json(
        contents,
        args.json,
        {"output": args.output, **numbered("export", args.export)},
        inputs,
        targets=len(result.status),
        reached=int(result.reached.sum()),
        status=list(result.status),
        warnings=[*notes, *texts_by_file(warnings)],
    )
    screen = screens.compensation_screen(
        f"targets: {_tool_text(args, calibrated)} in {frame}",
        result,
        calibrated,
        targets,
        notes,
        warnings,
        _hint(args, nominal, calibrated, targets, result),
        contents,
    )
    screens.show(screen, args.verbosity)
    return 0


def read_robots(args: Namespace) -> tuple[robot.Chain, robot.Chain]:
    """Read both robots, which must have the same tip."""
    calibrated = read_robot_or_table(args.calibrated, args)
    nominal = read_robot_or_table(args.nominal, args, calibrated.tip)
    if nominal.tip != calibrated.tip and args.tip is None:
        raise InvalidArgumentError(
            f"{args.calibrated}: its tip is {calibrated.tip!r}; expected {nominal.tip!r}, the tip of "
            f"{args.nominal}"
        )
    return nominal, calibrated


def _frame_notes(nominal: robot.Chain, calibrated: robot.Chain) -> list[str]:
    """Say that poses in the root link are less accurate if the calibration estimated base or tool."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...compensation import nominal_root_pose

    estimated = {
        "base": (calibrated.base @ nominal_root_pose(nominal, calibrated), nominal.base),
        "tool": (calibrated.tool, nominal.tool),
    }
    hidden = {
        "base": f"how the first axis lies in {nominal.root}",
        "tool": f"how {nominal.tip} lies behind the last axis",
    }
    names = [name for name, poses in estimated.items() if not np.allclose(*poses, rtol=0, atol=1e-12)]
    if not names:
        return []
    unknown = " and ".join(hidden[name] for name in names)
    return [
        f"the calibration estimated the {' and the '.join(names)}, and does not show {unknown}: the error at "
        "these targets can be larger than it states; targets of the measured point in the measuring frame "
        "do not have this error: --frame measuring"
    ]


def in_frame_of_targets(
    args: Namespace, nominal: robot.Chain, calibrated: robot.Chain
) -> tuple[robot.Chain, robot.Chain]:
    """Return both robots with the base and the tool that the targets refer to."""
    from dataclasses import replace  # lazy import, as the following: they are slow to load

    import numpy as np

    from ... import se3
    from ...compensation import nominal_root_pose

    chains = nominal, calibrated
    if args.frame == BASE:
        bases = np.eye(4), se3.inverse(nominal_root_pose(nominal, calibrated))
        chains = tuple(
            replace(chain, base=base, tool=np.eye(4)) for chain, base in zip(chains, bases, strict=True)
        )
    if args.tcp:
        is_link = args.tcp in calibrated.urdf.links
        if not is_link and not os.path.exists(args.tcp):
            raise InvalidArgumentError(
                f"--tcp {args.tcp}: neither a link of {args.calibrated} nor a file; expected a link fixed to "
                "the tip, or a TOML file with xyz_m and rotvec_rad"
            )
        chains = tuple(
            replace(chain, tool=chain.pose_in_tip(args.tcp) if is_link else io.read_tool(args.tcp))
            for chain in chains
        )
    return chains[0], chains[1]


def _unstated_conditions(args: Namespace, calibrated: robot.Chain, targets: io.TargetPoses) -> list[str]:
    """Name the conditions that the calibrated robot depends on, and that the targets do not state."""
    from ... import diagnostics  # lazy import: slow to load

    sidecar = io.existing_sidecar(args.calibrated)
    region = io.read_measured_region(sidecar, calibrated) if sidecar else None
    known = targets.conditions.names if targets.conditions else ()
    return diagnostics.find_unstated_conditions(calibrated, known, region and region.payloads)


def _tool_text(args: Namespace, chain: robot.Chain) -> str:
    """Describe the tool that reaches the targets."""
    if args.tcp:
        return f"the tool {args.tcp}"
    return f"the tip {chain.tip}" if args.frame == BASE else "the measured point"


def _hint(
    args: Namespace,
    nominal: robot.Chain,
    calibrated: robot.Chain,
    targets: io.TargetPoses,
    result: Compensation,
) -> str:
    """Suggest a remedy if most targets are not reached: another unit, or --frame measuring with a sidecar."""
    if result.reached.mean() >= _MIN_REACHED:
        return ""
    if unit := _fitting_unit(nominal, calibrated, targets):
        return f"most targets are reached if they are in {unit}; check the units in the header"
    if args.frame != BASE or not io.existing_sidecar(args.calibrated):
        return ""
    return "are the targets in the measuring frame of the calibration? then add --frame measuring"


def _fitting_unit(nominal: robot.Chain, calibrated: robot.Chain, targets: io.TargetPoses) -> str:
    """Return the other unit of millimetres and metres if most targets are reached with it."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...compensation import compensate
    from ...units import LENGTHS

    stated = {targets.units[name] for name in ("x", "y", "z")}
    rows = np.unique(np.linspace(0, len(targets.values) - 1, _N_TRIED).astype(int))
    for unit, other in (("m", "mm"), ("mm", "m")):
        if stated == {unit}:
            values = targets.values[rows]
            positions = values if values.ndim == 2 else values[:, :3, 3]
            positions *= LENGTHS[unit] / LENGTHS[other]
            near = None if targets.near is None else targets.near[rows]
            if compensate(nominal, calibrated, values, near).reached.mean() >= _MIN_REACHED:
                return other
    return ""


def robots_warning(
    nominal_path: str, calibrated_path: str, nominal: robot.Chain, calibrated: robot.Chain
) -> str:
    """Return a warning if the nominal and the calibrated robot are the same, or look exchanged."""
    import numpy as np  # lazy import: it is slow to load

    is_known = nominal.origins.shape == calibrated.origins.shape and calibrated.transmission is None
    if is_known and np.array_equal(nominal.origins, calibrated.origins):
        return "both robots have the same joint origins, so that no error of the arm is corrected"
    has_sidecar = [io.existing_sidecar(path) is not None for path in (nominal_path, calibrated_path)]
    if has_sidecar == [True, False]:
        reason = f"it has a sidecar, and {calibrated_path} has none"
    elif has_sidecar == [False, True] or not _looks_computed(nominal, calibrated):
        return ""
    else:
        reason = f"its joint origins have all digits of a calibration, and those of {calibrated_path} do not"
    return f"nominal and calibrated robot look exchanged: {reason}; the nominal robot comes first"


def _looks_computed(first: robot.Chain, second: robot.Chain) -> bool:
    """Return whether the numbers that differ are mostly computed in the first URDF only."""
    import numpy as np  # lazy import: it is slow to load

    shares = []
    for one, other in ((first, second), (second, first)):
        numbers = {joint.name: (*joint.origin[:3, 3], *joint.rpy) for joint in other.urdf.joints}
        pairs = [
            pair
            for joint in one.urdf.joints
            for pair in zip((*joint.origin[:3, 3], *joint.rpy), numbers.get(joint.name, ()), strict=False)
        ]
        shares.append(np.mean([_is_computed(float(a)) for a, b in pairs if a != b] or [False]))
    return shares[0] > 0.5 > shares[1]


def _is_computed(number: float) -> bool:
    """Return whether a number has more digits than people write and is not a design angle."""
    digits = repr(number).split("e")[0].lstrip("-0.").replace(".", "")
    distance = abs(number - _DESIGN_ANGLE * round(number / _DESIGN_ANGLE))
    return len(digits) >= _COMPUTED_DIGITS and distance > _DESIGN_TOL


def _program(result: Compensation, nominal: robot.Chain) -> Program:
    """Create the program that visits all targets that are reached."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ...programs import Program, Stop

    stops = [Stop(f"target {i + 1}", result.q[i], result.poses[i]) for i in np.flatnonzero(result.reached)]
    if not stops:
        raise InvalidArgumentError("--export: no target is reached; correct the targets or choose --frame")
    return Program(
        nominal, "targets corrected by dhcal compensate", "The moves are not checked for collisions.", stops
    )


def corrected_text(
    result: Compensation, chain: robot.Chain, targets: io.TargetPoses, joint_units: str
) -> str:
    """Format corrected targets."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ... import se3
    from ...io.measurement_files.columns import QUATERNION, ROTVEC
    from ...io.measurement_files.writing import joint_columns
    from ...units import ANGLES, LENGTHS

    columns: dict[str, Sequence[str]] = {
        name: _cells(np.array(values))
        for name, values in joint_columns(result.q, chain, angle_unit=joint_units).items()
    }
    for i, name in enumerate(("x", "y", "z")):
        unit = targets.units[name]
        columns[f"{name}[{unit}]"] = _cells(result.poses[:, i, 3] * LENGTHS[unit])
    rotvec = np.full((len(result.q), 3), np.nan)
    rotvec[result.reached] = se3.log3(result.poses[result.reached, :3, :3])
    if ROTVEC[0] in targets.units:
        for name, values in zip(ROTVEC, rotvec.T, strict=True):
            unit = targets.units[name]
            columns[f"{name}[{unit}]"] = _cells(values * ANGLES[unit])
    else:
        columns |= dict(zip(QUATERNION, map(_cells, se3.rotvec_to_quaternion(rotvec).T), strict=True))
    unit = targets.units["x"]
    columns[f"miss_position[{unit}]"] = _cells(result.residual_error[:, 0] * LENGTHS[unit])
    if targets.values.ndim == 3:
        columns["miss_rotation[deg]"] = _cells(result.residual_error[:, 1] * ANGLES["deg"])
    return io.csv_text(columns | {"status": result.status})


def _cells(values: Array) -> list[str]:
    """Format numbers exactly; NaN as an empty cell."""
    return ["" if math.isnan(value) else repr(value) for value in values.tolist()]
