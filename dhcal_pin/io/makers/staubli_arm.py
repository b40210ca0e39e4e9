"""Calibration of Stäubli arms: offsets of the joint zeros in the file `arm.cfx` of a controller CS8 or CS9.

The file is XML. It holds one row of offsets per joint, in degrees and millimetres
(https://github.com/ros-industrial/staubli_experimental/issues/35):

    <arm>
      <DhArray name="dhOffset">
        <DH index="0" theta="0.012" d="0" a="0" b="0" alpha="0" beta="0"/>
        ...
      </DhArray>
      <Float name="flangeLengthOffset" value="0"/>
    </arm>

theta is an angle about the axis of the joint, in every order of the six. How Stäubli combines the other five
is not published. A file in which one of them, or the length of the flange, is not zero is therefore refused.
"""

from __future__ import annotations

import math

import numpy as np

from ... import se3
from ..._typing import PathLike
from ...exceptions import InvalidArgumentError
from ...robot.chain import Chain
from ...robot.formats.xml_tags import XmlTag, parse_numbers, read_xml, scan

# Attributes of a row that must be zero.
_UNKNOWN_ORDER = ("d", "a", "b", "alpha", "beta")
# Largest offset of a joint [°]; larger ones are not of a calibration.
_MAX_OFFSET = 10.0


def read_joint_offsets(path: PathLike) -> list[float]:
    """Read the offsets of the joint angles of an arm [rad]."""
    offsets: list[float] = []
    roots: list[XmlTag] = []
    array = ""

    def on_start(depth: int, element: str, tag: XmlTag) -> None:
        nonlocal array
        if depth == 1:
            roots.append(tag)
            if element != "arm":
                raise tag.error("this is no arm.cfx; expected <arm> as the outermost element")
        elif depth == 2:
            array = tag.attributes.get("name", "") if element == "DhArray" else ""
            if tag.attributes.get("name") == "flangeLengthOffset":
                _require_zero(tag, "value")
        elif depth == 3 and array == "dhOffset":
            if parse_numbers(tag, "index", 1)[0] != len(offsets):
                raise tag.error(f"index is {tag.attributes['index']}; expected {len(offsets)}")
            for key in _UNKNOWN_ORDER:
                _require_zero(tag, key)
            theta = parse_numbers(tag, "theta", 1)[0]
            if abs(theta) > _MAX_OFFSET:
                raise tag.error(f"theta is {theta:g}; expected degrees up to ±{_MAX_OFFSET:g}")
            offsets.append(math.radians(theta))

    data, source = read_xml(path, "an arm.cfx")
    scan(data, source, "arm.cfx", "arm", on_start)
    if not offsets:
        raise roots[0].error(
            'no rows in <DhArray name="dhOffset">, so the file has no calibration of the arm'
        )
    return offsets


def correct_staubli_arm(path: PathLike, nominal: Chain) -> tuple[Chain, list[str]]:
    """Apply the offsets of an arm to its nominal robot, whose joints are in the order of the file."""
    offsets = read_joint_offsets(path)
    if len(offsets) != len(nominal.moving_joints) or nominal.prismatic[np.array(offsets) != 0].any():
        raise InvalidArgumentError(
            f"{path}: has offsets of {len(offsets)} turning joints; expected a robot with these joints, and "
            f"{nominal.urdf.source} has {', '.join(nominal.moving_joints)}"
        )
    turns = se3.exp3(np.array(offsets)[:, None] * nominal.axes)
    motions = {nominal.origin_frame(j): se3.transform(turn, np.zeros(3)) for j, turn in enumerate(turns, 1)}
    note = "theta of dhOffset is added to each joint angle; compare one pose with that of the controller"
    if not any(offsets):
        note = "all offsets are zero: the controller uses the nominal geometry"
    return nominal.perturbed_at(motions), [note]


def _require_zero(tag: XmlTag, key: str) -> None:
    """Require that an offset is zero whose meaning is not known."""
    if parse_numbers(tag, key, 1)[0] != 0:
        raise tag.error(
            f"{key} is {tag.attributes[key]}; expected 0: only theta is read, because it is not published "
            "how Stäubli combines the others; calibrate the arm itself"
        )
