"""`dhcal compensate`: compute joint values and targets that correct the errors of a calibrated robot."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..exceptions import InvalidArgumentError
from .options import TIP

if TYPE_CHECKING:
    from .._typing import Array
    from ..compensation import Compensation
    from ..io import TargetPoses
    from ..robot import Chain

EXAMPLE = "dhcal compensate ur10.urdf ur10_calibrated.urdf targets.csv --tip tool0 -o corrected.csv"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal compensate`.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument("nominal", metavar="NOMINAL.urdf", help="robot model of the controller")
    parser.add_argument("calibrated", metavar="CALIBRATED.urdf", help="the same robot, calibrated")
    parser.add_argument("targets", metavar="targets.csv", help="positions or poses of the tool")
    parser.add_argument(
        "-o",
        "--output",
        metavar="corrected.csv",
        required=True,
        help="joint values and corrected targets to write, one row per target",
    )
    parser.add_argument("--tip", **TIP)


def run(args: Namespace) -> int:
    """Correct targets, write them, and show which could not be reached.

    Args:
        args: Parsed arguments.

    Returns:
        Exit status 0.

    Raises:
        InvalidArgumentError: The two robots have different tips.
    """
    from ..compensation import compensate  # lazy import, as the following: they load Pinocchio
    from ..io import read_robot, read_targets
    from ..io.robot import has_dh_table
    from . import console
    from .outputs import existing_sidecars, require_writable_outputs, write_outputs

    robots = [args.nominal, args.calibrated]
    require_writable_outputs([args.output], [*robots, *existing_sidecars(robots), args.targets])
    nominal, calibrated = (read_robot(path, None if has_dh_table(path) else args.tip) for path in robots)
    if nominal.tip != calibrated.tip and args.tip is None:
        raise InvalidArgumentError(
            f"{args.calibrated}: its tip is {calibrated.tip!r}, but the tip of {args.nominal} is "
            f"{nominal.tip!r}; choose one with --tip"
        )
    targets = read_targets(args.targets, calibrated)
    with console.progress_bar("compensating", len(targets.values)) as progress:
        result = compensate(nominal, calibrated, targets.values, targets.near, progress)
    write_outputs({args.output: corrected_text(result, calibrated, targets)})
    console.print_compensation(result, calibrated, targets)
    console.print_lines(f"wrote {args.output}")
    return 0


def corrected_text(result: Compensation, chain: Chain, targets: TargetPoses) -> str:
    """Format corrected targets.

    Args:
        result: Corrected targets.
        chain: Calibrated robot.
        targets: Targets as read, with their units.

    Returns:
        CSV text with one row per target: joint values, corrected target in the units of the input, remaining
        error of the calibrated tool, and status. Cells of targets that are not reached are empty.
    """
    import numpy as np  # lazy import, as the following: they are slow to load

    from .. import se3
    from ..io.measurement_columns import QUATERNION, ROTVEC, joint_units
    from ..io.tabular import csv_text
    from ..units import ANGLES, LENGTHS

    columns: dict[str, Sequence[str]] = {}
    for name, values in zip(chain.joint_names, result.q.T, strict=True):
        columns[f"{name}[{'m' if joint_units(chain, name) is LENGTHS else 'rad'}]"] = _cells(values)
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
        half_angle = np.linalg.norm(rotvec, axis=1) / 2
        vector = rotvec * np.sinc(half_angle / np.pi)[:, None] / 2
        columns |= dict(zip(QUATERNION, map(_cells, [np.cos(half_angle), *vector.T]), strict=True))
    unit = targets.units["x"]
    columns[f"miss_position[{unit}]"] = _cells(result.residual_error[:, 0] * LENGTHS[unit])
    if targets.values.ndim == 3:
        columns["miss_rotation[deg]"] = _cells(result.residual_error[:, 1] * ANGLES["deg"])
    return csv_text(columns | {"status": result.status})


def _cells(values: Array) -> list[str]:
    """Format numbers exactly; NaN as an empty cell."""
    return ["" if math.isnan(value) else repr(value) for value in values.tolist()]
