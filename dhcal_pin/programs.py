"""Programs for robot controllers: joint positions as URScript, joint trajectory or RoboDK table.

The ending of a file name selects the format:

- `.script`: URScript, a `movej` to each stop and a rest. For arms with six revolute joints.
- `.trajectory.csv`: `time` [s] and one column per joint under its URDF name [rad or m]. A row on arrival at
  each stop and a row on departure; the arm stands at the first stop at time 0.
- `.robodk.csv`: `J1` … `Jn` [deg or mm], and the pose of the tool as `X,Y,Z` [mm] and `R,P,W` [deg] with
  T = Trans(X, Y, Z)·Rz(W)·Ry(P)·Rx(R), as RoboDK's `xyzrpw_2_pose` reads it.

The arm moves slowly, on a straight line in joint space, and rests at every stop. Way points are passed
without a rest.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence

import numpy as np

from . import se3
from ._frozen import frozen
from ._typing import Array, PathLike
from .exceptions import InvalidArgumentError
from .robot.chain import Chain

# Largest joint speeds [rad/s] and [m/s], and acceleration [rad/s²] of a move.
MAX_JOINT_SPEED, MAX_SLIDE_SPEED, JOINT_ACCELERATION = 0.5, 0.1, 0.5
# Fraction of the velocity limit of the URDF that a move may use.
SPEED_FRACTION = 0.5
# Rest at every stop [s], during which the tool is measured.
REST_TIME = 3.0
# Decimals of the numbers: nanometres and nanoradians, far below the resolution of any controller.
DECIMALS = 9
# Number of joints of the robots that execute URScript.
_N_UR_JOINTS = 6


@frozen(eq=False)
class Stop:
    """Configuration at which the arm rests, and the way to it."""

    name: str  # Name in comments, such as "pose 3"
    q: Array  # Joint positions, shape (n,) [rad or m]
    pose: Array  # Pose of the tool that the controller shows there, shape (4, 4) [m]
    # Joint positions to pass on the way from the stop before, shape (w, n) [rad or m].
    way: Sequence[Array] = ()
    is_way_free: bool = True  # Whether the way has no collision as far as that was checked


@frozen(eq=False)
class Program:
    """Sequence of stops."""

    chain: Chain
    title: str  # One line for a comment
    warning: str  # What the operator must know before the arm moves
    stops: Sequence[Stop]  # Stops in their order


def program_text(program: Program, path: PathLike) -> str:
    """Write a program in the format that the ending of a file name selects."""
    for ending, write in FORMATS.items():
        if os.fspath(path).lower().endswith(ending):
            return write(program)
    raise InvalidArgumentError(f"{os.fspath(path)}: unknown ending; choose from {', '.join(FORMATS)}")


def urscript(program: Program) -> str:
    """Write a program in URScript, which waits for the operator before the first and each unchecked move."""
    chain = program.chain
    if chain.n_joints != _N_UR_JOINTS or chain.is_prismatic.any():
        raise InvalidArgumentError(
            f"URScript moves arms with {_N_UR_JOINTS} revolute joints; this one has the joints "
            f"{', '.join(chain.joint_names)}: export a .trajectory.csv or .robodk.csv"
        )
    lines = [
        f"# {program.title}",
        "def dhcal_program():",
        f"  speed = {MAX_JOINT_SPEED}         # rad/s",
        f"  acceleration = {JOINT_ACCELERATION}  # rad/s^2",
        f"  rest = {REST_TIME}          # s, for the measurement",
        _popup(program.warning),
    ]
    for stop in program.stops:
        if not stop.is_way_free:
            lines.append(_popup(f"The next move, to {stop.name}, may collide. Continue if the way is free."))
        lines.append(f"  # {stop.name}")
        for q in (*stop.way, stop.q):
            lines.append(f"  movej([{_row(q.tolist(), ', ')}], a=acceleration, v=speed)")
        lines.append("  sleep(rest)")
    return "\n".join([*lines, "end", "dhcal_program()", ""])


def trajectory_csv(program: Program) -> str:
    """Write a program as a joint trajectory that starts at rest in the first stop."""
    if blocked := [stop.name for stop in program.stops if not stop.is_way_free]:
        raise InvalidArgumentError(
            f"the way to {', '.join(blocked)} may collide, and a trajectory does not wait; export a .script "
            "or a .robodk.csv"
        )
    speed = _joint_speeds(program.chain)
    lines, time, last = [",".join(["time", *program.chain.joint_names])], 0.0, None
    for stop in program.stops:
        for q in (*stop.way, stop.q):
            if last is not None:
                time += float(np.max(np.abs(q - last) / speed))
            last = q
            lines.append(_row([time, *q.tolist()]))
        time += REST_TIME
        lines.append(_row([time, *stop.q.tolist()]))
    return "\n".join([*lines, ""])


def robodk_csv(program: Program) -> str:
    """Write the stops of a program as a table for RoboDK, without the ways between them."""
    chain = program.chain
    factors = np.where(chain.is_prismatic, 1e3, np.rad2deg(1.0))
    lines = [",".join([*(f"J{i}" for i in range(1, chain.n_joints + 1)), *"XYZRPW"])]
    for stop in program.stops:
        x, y, z, *rpy = se3.to_xyz_rpy(stop.pose)
        lines.append(_row([*(stop.q * factors).tolist(), 1e3 * x, 1e3 * y, 1e3 * z, *map(math.degrees, rpy)]))
    return "\n".join([*lines, ""])


# Functions that write a program, by the ending of the file name.
FORMATS: dict[str, Callable[[Program], str]] = {
    ".script": urscript,
    ".trajectory.csv": trajectory_csv,
    ".robodk.csv": robodk_csv,
}


def _joint_speeds(chain: Chain) -> Array:
    """Return the speed of each independent joint in a move, shape (n,) [rad/s or m/s]."""
    speeds = np.where(chain.is_prismatic, MAX_SLIDE_SPEED, MAX_JOINT_SPEED)
    for i, name in enumerate(chain.joint_names):
        limit = float(chain.model.velocityLimit[chain.model.joints[chain.model.getJointId(name)].idx_v])
        if 0 < limit < math.inf:
            speeds[i] = min(speeds[i], SPEED_FRACTION * limit)
    return speeds


def _popup(text: str) -> str:
    """Return the line of a script that shows a text and waits for the operator."""
    return f'  popup("{text}", title="dhcal", warning=True, blocking=True)'


def _row(values: Sequence[float], separator: str = ",") -> str:
    """Join numbers, rounded to `DECIMALS`."""
    return separator.join(repr(round(float(value), DECIMALS) + 0.0) for value in values)
