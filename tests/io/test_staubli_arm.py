"""Joint offsets of Stäubli arms, applied to a nominal robot."""

import numpy as np
import pytest
from robots import UR10, write

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import convert_robot, read_robot
from dhcal_pin.io.makers.staubli_arm import read_joint_offsets

OFFSETS = (0.012, -0.034, 0.2, 0.0, -0.05, 1e-3)


def arm(offsets=OFFSETS, **others) -> str:
    """A file as controllers write it, with settings that do not concern the geometry."""
    values = {"d": "0", "a": "0", "b": "0", "alpha": "0", "beta": "0"} | others
    keys = " ".join(f'{key}="{value}"' for key, value in values.items() if value is not None)
    rows = "".join(f'    <DH index="{i}" theta="{x!r}" {keys} />\n' for i, x in enumerate(offsets))
    return f"""<?xml version="1.0" encoding="utf-8" ?>
<arm>
  <String name="arm" value="tx60-S1" />
  <FloatArray name="zeroOffset" >
    <Float index="0" value="305993.331299" />
  </FloatArray>
  <DhArray name="dhOffset" >
{rows}  </DhArray>
  <Float name="flangeLengthOffset" value="0" />
</arm>
"""


def test_offsets_are_added_to_the_joint_angles(tmp_path):
    """Against the nominal robot at other joint angles."""
    path = write(tmp_path, "arm.cfx", arm())
    text, notes = convert_robot(path, "out.urdf", "tool0", template=UR10)
    nominal, corrected = read_robot(UR10, "tool0"), read_robot(write(tmp_path, "out.urdf", text), "tool0")
    q = np.random.default_rng(0).uniform(-3, 3, (20, 6))
    np.testing.assert_allclose(corrected.poses(q), nominal.poses(q + np.radians(OFFSETS)), atol=1e-12)
    assert "theta of dhOffset is added to each joint angle" in notes[0]


def test_an_arm_without_a_calibration_stays_as_it_is(tmp_path):
    path = write(tmp_path, "arm.cfx", arm([0.0] * 6))
    text, notes = convert_robot(path, "out.urdf", "tool0", template=UR10)
    assert text == UR10.read_text()
    assert notes[0] == "all offsets are zero: the controller uses the nominal geometry"


WRONG = [
    (arm(d="0.3"), "8: <DH>: d is 0.3; expected 0: only theta is read"),
    (arm(beta="-1e-3"), "8: <DH>: beta is -1e-3; expected 0"),
    (arm(b=None), "8: <DH>: b is missing; expected a number"),
    (arm().replace('Offset" value="0"', 'Offset"'), "15: <Float>: value is missing; expected a number"),
    (arm(alpha="x"), "8: <DH>: alpha has 'x'; expected a finite number"),
    (arm([0.0, 20.0]), "9: <DH>: theta is 20; expected degrees up to ±10"),
    (arm().replace('index="1"', 'index="3"'), "9: <DH>: index is 3; expected 1"),
    (arm().replace('Offset" value="0"', 'Offset" value="2"'), "15: <Float>: value is 2; expected 0"),
    (arm([]), "2: <arm>: no rows in <DhArray"),
    ("<robot/>", "1: <robot>: this is no arm.cfx; expected <arm>"),
    ("<arm", "1: broken XML"),
    ("", "1: the file is empty; expected a <arm>"),
]


@pytest.mark.parametrize(("text", "words"), WRONG)
def test_what_is_not_understood_is_refused_with_its_line(tmp_path, text, words):
    path = write(tmp_path, "arm.cfx", text)
    with pytest.raises(DhcalError) as caught:
        read_joint_offsets(path)
    assert str(caught.value).startswith(f"{path}:{words}")


def test_another_robot_is_refused(tmp_path):
    path = write(tmp_path, "arm.cfx", arm(OFFSETS[:4]))
    with pytest.raises(DhcalError, match=r"has offsets of 4 turning joints; expected a robot with these"):
        convert_robot(path, "out.urdf", "tool0", template=UR10)
    with pytest.raises(DhcalError, match=r"arm\.cfx: holds corrections of a robot; apply them"):
        read_robot(path)
    with pytest.raises(DhcalError, match=r"arm\.cfx: holds corrections of a robot; apply them"):
        convert_robot(path, "out.urdf")
    with pytest.raises(DhcalError, match=r"out\.cfx: unknown ending; choose from \.urdf, \.dh\.toml"):
        convert_robot(UR10, "out.cfx")
