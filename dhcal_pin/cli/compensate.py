"""`dhcal compensate`: targets in, joint values and corrected targets out."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence

import numpy as np

from .. import se3
from .._typing import Array
from ..compensation import SINGULAR, Compensation, compensate
from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.measurement_columns import QUATERNION, ROTVEC, joint_units
from ..io.measurement_csv import TargetPoses, read_targets
from ..io.robot import has_dh_table, read_robot
from ..io.tabular import csv_text
from ..robot.chain import Chain
from ..units import ANGLES, LENGTHS
from . import console
from .options import require_writable_outputs, sidecars

# Rows named on stderr; all of them are in the file.
_SHOWN = 12


def run(args: Namespace) -> int:
    """Reads both robots with their sidecars and the targets, writes the corrected ones, names the others."""
    given = [args.nominal, args.calibrated]
    require_writable_outputs([args.output], [*given, *sidecars(given), args.targets])
    nominal, calibrated = (read_robot(path, None if has_dh_table(path) else args.tip) for path in given)
    if nominal.tip != calibrated.tip and args.tip is None:
        raise DhcalError(
            f"{args.calibrated}: its tip is {calibrated.tip!r}, that of {args.nominal} is {nominal.tip!r}; "
            "name one with --tip"
        )
    wanted = read_targets(args.targets, calibrated)
    with console.progress_bar("compensating", len(wanted.values)) as progress:
        found = compensate(nominal, calibrated, wanted.values, wanted.near, progress)
    write_files({args.output: corrected_text(found, calibrated, wanted)})
    _show(found, calibrated, wanted)
    console.print_lines(f"wrote {args.output}")
    return 0


def corrected_text(found: Compensation, chain: Chain, wanted: TargetPoses) -> str:
    """The CSV of a compensation, a row a target, in the units of the targets; empty where not reached.

    Columns: the joints' values, the corrected target, how far the calibrated tool stays from what was
    asked for, and the status.
    """
    columns: dict[str, Sequence[str]] = {}
    for name, values in zip(chain.joint_names, found.q.T, strict=True):
        columns[f"{name}[{'m' if joint_units(chain, name) is LENGTHS else 'rad'}]"] = _numbers(values)
    for i, name in enumerate(("x", "y", "z")):
        unit = wanted.units[name]
        columns[f"{name}[{unit}]"] = _numbers(found.poses[:, i, 3] * LENGTHS[unit])
    turn = np.full((len(found.q), 3), np.nan)
    turn[found.reached] = se3.log3(found.poses[found.reached, :3, :3])
    if ROTVEC[0] in wanted.units:
        for name, values in zip(ROTVEC, turn.T, strict=True):
            unit = wanted.units[name]
            columns[f"{name}[{unit}]"] = _numbers(values * ANGLES[unit])
    else:
        half = np.linalg.norm(turn, axis=1) / 2
        vector = turn * np.sinc(half / np.pi)[:, None] / 2
        columns |= dict(zip(QUATERNION, map(_numbers, [np.cos(half), *vector.T]), strict=True))
    unit = wanted.units["x"]
    columns[f"miss_position[{unit}]"] = _numbers(found.residual_error[:, 0] * LENGTHS[unit])
    if wanted.values.ndim == 3:
        columns["miss_rotation[deg]"] = _numbers(found.residual_error[:, 1] * ANGLES["deg"])
    return csv_text(columns | {"status": found.status})


def _numbers(values: Array) -> list[str]:
    return ["" if np.isnan(value) else repr(value) for value in values.tolist()]


def _show(found: Compensation, chain: Chain, wanted: TargetPoses) -> None:
    """How many targets came out how, and which are not reached or delicate."""
    for status in dict.fromkeys(found.status):
        rows = [row for row, other in enumerate(found.status, 1) if other == status]
        text = f"{wanted.source}: {len(rows)} of {len(found.status)} {status}"
        if status != "ok":
            named = [
                f"row {row}"
                if status == SINGULAR
                else f"row {row} ({_size(found.residual_error[row - 1])} away)"
                for row in rows[:_SHOWN]
            ]
            text += f": {', '.join(named)}" + (
                f" and {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
            )
        console.print_lines(text, style="" if status == "ok" else "yellow")
    if chain.n_joints > 6:
        console.print_lines(
            f"note: with {chain.n_joints} joints a controller may reach a corrected target in other ways, which "
            "are not corrected; send the joint values"
        )
    elif chain.n_joints < 6 and wanted.values.ndim == 3 and not found.reached.all():
        console.print_lines(
            f"note: {chain.n_joints} joints cannot turn the tool as one likes; leave the rotation out of targets"
        )


def _size(miss: Array) -> str:
    turn = np.rad2deg(miss[1])
    return f"{1e3 * miss[0]:.3g} mm" + (f", {turn:.3g}°" if turn > 0 else "")
