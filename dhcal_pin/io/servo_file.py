"""Servo files: how the counts of servos become the values of joints.

The joint value q of a count c is

    q = sign·(c - zero)·2π/counts_per_turn

A servo file is the calibration that LeRobot keeps of an arm (.json), or a TOML file with one table
`[motor.NAME]` per servo, see docs/reference/robot_files.md. With `lerobot`, motors have the keys `joint` and
`resolution` only, and those that are not named have the names of their joints.

In degrees, LeRobot reports (c - m)·360/(resolution - 1) of the count c with the middle m of `range_min` and
`range_max`; `drive_mode` has no effect in this unit. The count contains the homing offset h already: it is
actual - h for motors of Feetech, and actual + h for those of Dynamixel. A zero is therefore corrected by h,
and a wrong sign by the axis in the URDF.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import tomli_w

from .._frozen import frozen
from .._typing import Array, PathLike
from ..exceptions import FileFormatError, UnknownNameError
from ..messages import quote
from . import toml_table as toml
from .tabular import MAX_TOML_BYTES, read_text
from .toml_table import Key, TomlTable

# Counts of a servo with 12 bits.
RESOLUTION = 4096
# Largest resolution: 24 bits. LeRobot's integers are registers of at most 32 bits.
_MAX_RESOLUTION, _MAX_INTEGER = 1 << 24, 1 << 31
# Sign of the homing offset in the position that a motor reports.
MAKES: Mapping[str, int] = {"feetech": -1, "dynamixel": 1}
# Largest homing offset of a Feetech motor, which stores the sign in bit 11.
_MAX_FEETECH_OFFSET = 2047
# Integers of each motor in LeRobot's file.
_LEROBOT_KEYS = ("id", "drive_mode", "homing_offset", "range_min", "range_max")

_RESOLUTION_KEY = toml.whole(2, _MAX_RESOLUTION, is_optional=True)
HEAD_KEYS: Mapping[str, Key] = {
    "resolution": _RESOLUTION_KEY,
    "lerobot": toml.text(
        "the path of LeRobot's calibration, relative to this file", "(?s:.+)", is_optional=True
    ),
    "make": toml.choice(MAKES, default="feetech"),
}
_NAME_KEYS: Mapping[str, Key] = {
    "joint": toml.text("the name of a joint of the URDF", "(?s:.+)", is_optional=True),
    "resolution": _RESOLUTION_KEY,
}
MOTOR_KEYS: Mapping[str, Key] = {
    **_NAME_KEYS,
    "id": toml.whole(0, 255, is_optional=True),
    "sign": Key(
        "1 or -1",
        {"enum": [1, -1]},
        lambda value: value in (1, -1) and not isinstance(value, bool),
        default=1,
    ),
    "zero": toml.number(-_MAX_INTEGER, _MAX_INTEGER, is_optional=True),
    "counts_per_turn": toml.number(1, _MAX_RESOLUTION, is_optional=True),
}


@frozen
class Servo:
    """Motor of a joint."""

    name: str  #: Name of the motor.
    joint: str  #: Name of its joint in the URDF.
    zero: float  #: Count at the zero of the joint.
    counts_per_turn: float  #: Counts of a full turn of the joint.
    resolution: int  #: Number of counts that the motor can report, from 0 on.
    sign: int  #: 1, or -1 if counts rise while the joint value falls.
    id: int | None  #: Number on the bus.
    homing_offset: int = 0  #: Offset in LeRobot's file [counts].

    @property
    def step(self) -> float:
        """Change of the joint value per count [rad], negative with a negative sign."""
        return self.sign * 2 * np.pi / self.counts_per_turn

    def angles(self, counts: Array) -> Array:
        """Convert counts to joint values [rad]."""
        return (counts - self.zero) * self.step


@frozen
class ServoFile:
    """Servos of an arm."""

    path: str  #: Path of the file.
    servos: tuple[Servo, ...]
    lerobot: str = ""  #: Path of LeRobot's calibration; empty if the servos are not from one.
    lerobot_text: str = ""  #: Text of LeRobot's calibration.
    make: str = "feetech"  #: Maker of the motors, one of `MAKES`.

    def of_column(self, name: str) -> Servo | None:
        """Find the servo of a column, which has the name of the joint or of the motor."""
        by_joint = [servo for servo in self.servos if servo.joint == name]
        return next(iter([*by_joint, *(servo for servo in self.servos if servo.name == name)]), None)

    def require_joint(self, servo: Servo, joints: list[str], robot: str) -> None:
        """Require that a robot has the joint of a servo."""
        if servo.joint not in joints:
            raise UnknownNameError(
                f"{self.path}: motor {quote(servo.name)} moves joint {quote(servo.joint)}, which {robot} "
                f"does not have; write joint = NAME in [motor.{servo.name}] of a TOML servo file; the joints "
                f"are {', '.join(joints)}"
            )

    def with_zeros_moved(self, angles: Mapping[str, float]) -> tuple[ServoFile, dict[str, float]]:
        """Add angles [rad] to the values of joints, in whole counts; return the angles added."""
        servos, moved = [], {}
        for servo in self.servos:
            counts = round(angles.get(servo.joint, 0.0) / servo.step)
            offset = self._homing_offset(servo, counts)
            if self.make == "feetech" and counts and offset == -_MAX_FEETECH_OFFSET - 1:
                counts -= 1
                offset += 1
            servos.append(replace(servo, zero=servo.zero - counts, homing_offset=offset))
            moved[servo.joint] = counts * servo.step
        return replace(self, servos=tuple(servos)), moved

    def _homing_offset(self, servo: Servo, counts: int) -> int:
        """Return the homing offset with which a servo reports more counts, within one turn for Feetech."""
        offset = servo.homing_offset + MAKES[self.make] * counts
        if self.make != "feetech" or abs(offset) <= _MAX_FEETECH_OFFSET or not counts:
            return offset
        half = servo.resolution // 2
        return (offset + half) % servo.resolution - half

    def lerobot_content(self) -> str:
        """Return LeRobot's calibration with the present homing offsets; every other character stays."""
        text = self.lerobot_text
        for servo in self.servos:
            name = "|".join(
                {re.escape(json.dumps(servo.name, ensure_ascii=ascii)) for ascii in (True, False)}
            )
            pattern = rf'((?:{name})\s*:\s*{{[^{{}}]*?"homing_offset"\s*:\s*)-?\d+'
            text = re.sub(
                pattern, lambda match, offset=servo.homing_offset: f"{match[1]}{offset}", text, count=1
            )
        written = {name: motor["homing_offset"] for name, motor in json.loads(text).items()}
        if written != {servo.name: servo.homing_offset for servo in self.servos}:
            raise FileFormatError(f"{self.lerobot}: homing offsets were not found; write it as LeRobot does")
        return text

    def toml_content(self) -> str:
        """Return a TOML servo file for counts with the homing offsets of the measurement."""
        motors = {
            servo.name: {
                "joint": servo.joint,
                **({} if servo.id is None else {"id": servo.id}),
                "sign": servo.sign,
                "zero": servo.zero,
                "resolution": servo.resolution,
                "counts_per_turn": servo.counts_per_turn,
            }
            for servo in self.servos
        }
        return tomli_w.dumps({"motor": motors})

    def ros2_control_content(self) -> str:
        """Return parameters of the joints for drivers of `ros2_control`, as YAML."""
        lines = [
            "# Parameters of joints for ros2_control drivers of servos. Counts as in the measurement: the "
            "homing",
            "# offsets that the servos store stay as they were.",
            "#   joint [rad] = (position - offset) / gear_ratio",
            "#   position [rad] = (count - resolution/2) * 2*pi/resolution",
            "# offset_counts is the count at the zero of the joint, rounded, for drivers that take counts.",
        ]
        for servo in self.servos:
            offset = (servo.zero - servo.resolution / 2) * 2 * np.pi / servo.resolution
            lines += [
                f"{json.dumps(servo.joint)}:",
                *([] if servo.id is None else [f"  id: {servo.id}"]),
                f"  offset: {float(offset)!r}",
                f"  gear_ratio: {float(servo.sign * servo.counts_per_turn / servo.resolution)!r}",
                f"  offset_counts: {round(servo.zero)}",
                f"  resolution: {servo.resolution}",
            ]
        return "\n".join([*lines, ""])


def read_servos(path: PathLike) -> ServoFile:
    """Read a servo file.

    Args:
        path: LeRobot's calibration of an arm (.json), or a TOML file.

    Returns:
        Servos, for the argument `servos` of `read_measurements`.

    Raises:
        FileFormatError: The file cannot be read, or its content is invalid.
        UnknownNameError: A TOML file names a motor that LeRobot's calibration does not have.
    """
    path = os.fspath(path)
    if path.lower().endswith(".json"):
        return _from_lerobot(path, path, {}, None, "feetech")
    table = TomlTable.read(path)
    head = table.some_values(HEAD_KEYS)
    keys = _NAME_KEYS if head["lerobot"] else MOTOR_KEYS
    motors = table.table("motor", required=not head["lerobot"]).values_by_name(toml.table_of(keys))
    table.finish()
    if head["lerobot"]:
        lerobot = os.path.join(os.path.dirname(path), head["lerobot"])
        servos = _from_lerobot(path, lerobot, motors, head["resolution"], head["make"])
    else:
        servos = ServoFile(path, tuple(_servo(name, keys, head) for name, keys in motors.items()))
    joints = [servo.joint for servo in servos.servos]
    if double := [servo.name for servo in servos.servos if joints.count(servo.joint) > 1]:
        raise FileFormatError(
            f"{path}: motors {' and '.join(double)} move the same joint; expected one motor each"
        )
    return servos


def _servo(name: str, keys: Mapping[str, Any], head: Mapping[str, Any]) -> Servo:
    """Return the servo of a table [motor.NAME]."""
    resolution = keys["resolution"] or head["resolution"] or RESOLUTION
    zero = resolution / 2 if keys["zero"] is None else keys["zero"]
    per_turn = keys["counts_per_turn"] or float(resolution)
    return Servo(name, keys["joint"] or name, zero, per_turn, resolution, keys["sign"], keys["id"])


def _from_lerobot(
    path: str, lerobot: str, motors: Mapping[str, Mapping[str, Any]], resolution: int | None, make: str
) -> ServoFile:
    """Read LeRobot's calibration, with joints and resolutions by motor."""
    text = read_text(lerobot, max_bytes=MAX_TOML_BYTES)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{lerobot}: not JSON: {error}; expected LeRobot's calibration") from None
    expected = f"expected, for each motor, the integers {', '.join(_LEROBOT_KEYS)}"
    if not isinstance(content, dict) or not content:
        raise FileFormatError(f"{lerobot}: not a calibration of LeRobot; {expected}")
    if "motor_names" in content:
        raise FileFormatError(
            f"{lerobot}: written by an old version of LeRobot; calibrate again with the present one; "
            f"{expected}"
        )
    for name in motors:
        if name not in content:
            raise UnknownNameError(
                f"{path}: [motor.{name}]: unknown motor; the motors of {lerobot} are {', '.join(content)}"
            )
    servos = []
    for name, motor in content.items():
        values = [motor.get(key) if isinstance(motor, dict) else None for key in _LEROBOT_KEYS]
        wrong = [
            key
            for key, value in zip(_LEROBOT_KEYS, values, strict=True)
            if type(value) is not int or abs(value) >= _MAX_INTEGER
        ]
        if wrong:
            raise FileFormatError(f"{lerobot}: motor {quote(name)}: {wrong[0]} is not an integer; {expected}")
        number, _, offset, low, high = (int(value) for value in values if value is not None)
        if low >= high:
            raise FileFormatError(
                f"{lerobot}: motor {quote(name)}: range_min {low} is not below range_max {high}; record the "
                "range again"
            )
        keys = motors.get(name, {})
        own = keys.get("resolution") or resolution or RESOLUTION
        joint = keys.get("joint") or name
        servos.append(Servo(name, joint, (low + high) / 2, own - 1.0, own, 1, number, offset))
    return ServoFile(path, tuple(servos), lerobot, text, make)
