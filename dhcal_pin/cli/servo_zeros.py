"""Zeros of servos after a calibration: moved from the robot into the servo file, and read back with it.

The estimated zeros of the joints, rounded to whole counts, are added to the joint values that the servos
report. The robot is the same for these values, with the rest of the zeros in its joint origins.
"""

from __future__ import annotations

import copy
import os
from typing import TYPE_CHECKING

import numpy as np

from ..calibration.result import Result
from ..io.servo_file import read_servos
from .job_outputs import SERVO_ENDING

if TYPE_CHECKING:
    from ..io.servo_file import ServoFile

# Ending of the names of estimated zeros.
_ZERO = ".offset"
# Case in which another servo file is right.
NEW_OFFSETS = ", unless the offsets in the servos have changed"


def move_zeros(fit: Result, servos: ServoFile) -> tuple[Result, ServoFile]:
    """Return the result for the joint values of corrected servos, and these servos."""
    values = zip(fit.errors.parameters, fit.x, strict=False)
    zeros = {p.name.removesuffix(_ZERO): float(x) for p, x in values if p.name.endswith(_ZERO)}
    corrected, moved = servos.with_zeros_moved(zeros)
    summands = np.array([moved.get(name, 0.0) for name in fit.chain.joint_names])
    # What was computed from the measurements stays; only the joint values change.
    region, _ = fit.measured_region, fit.uncertainty
    written, bare = copy.copy(fit), copy.copy(fit.bare)
    if bare:
        vars(bare)["chain"] = bare.chain.with_zeros_moved(summands)
    vars(written).update(
        chain=fit.chain.with_zeros_moved(summands),
        bare=bare,
        measured_region=region and region.moved(summands),
    )
    return written, corrected


def describe_moves(before: ServoFile, after: ServoFile) -> list[str]:
    """Say by how many counts the zeros move; empty if none does."""
    moves = {a.name: round(a.zero - b.zero) for a, b in zip(after.servos, before.servos, strict=True)}
    moves = {name: count for name, count in moves.items() if count}
    if not moves:
        return []
    counts = ", ".join(f"{name} {count:+d}" for name, count in moves.items())
    limits = (
        "; the position limits of LeRobot move, too: approach the ends slowly, do not record the ranges again"
    )
    return [f"zeros of the servos move by counts: {counts}{limits if after.lerobot else ''}"]


def other_zeros_warning(robot: str, servos: ServoFile | None, are_fitted: bool) -> list[str]:
    """Return a warning if a calibrated robot has a servo file with other zeros than those that are stated."""
    # The zeros of LeRobot depend on the homing offsets in the servos; those of measurements that the
    # calibration fitted are known.
    if servos is None or (servos.lerobot and not are_fitted):
        return []
    return other_zeros(robot, servos, "" if are_fitted else NEW_OFFSETS)


def other_zeros(robot: str, servos: ServoFile, condition: str) -> list[str]:
    """Say that a calibrated robot has a servo file with other zeros, and in which case that is right."""
    path = os.path.splitext(robot)[0] + SERVO_ENDING
    if not os.path.exists(path):
        return []
    own = {servo.joint: servo for servo in read_servos(path).servos}
    others = [
        f"{servo.name} {own[servo.joint].zero - servo.zero:+.0f}"
        for servo in servos.servos
        if servo.joint in own and (servo.zero, servo.step) != (own[servo.joint].zero, own[servo.joint].step)
    ]
    if not others:
        return []
    return [
        f"the zeros are not those of this calibration, which are in {path} (counts: {', '.join(others)}); "
        f"state --servos {path}{condition}"
    ]
