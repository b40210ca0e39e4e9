"""Kinematics in another file of the same robot, between URDF and MJCF, against MuJoCo and Pinocchio."""

import os
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mjcf_robots import SCARA, UR5E, XARM, mujoco_poses
from robots import UR10, write

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import convert_robot, read_robot, urdf_files
from dhcal_pin.io.read_back import _pinocchio_poses
from dhcal_pin.robot import Chain
from dhcal_pin.robot.formats.mjcf import parse_mjcf
from dhcal_pin.robot.urdf_edit import with_world

POSES = re.compile(r' (pos|quat|xyz|rpy)="[^"]*"')


def numbers(values) -> str:
    return " ".join(map(repr, np.asarray(values, float).tolist()))


def other_frames(chain: Chain, turn: float, shift: float) -> list[np.ndarray]:
    """Motions of the joint frames of a chain: turned at random, and shifted along the axes."""
    rng = np.random.default_rng(3)
    return [
        se3.translation(shift * rng.normal() * axis)
        @ se3.transform(se3.exp3(turn * rng.normal(size=3)), np.zeros(3))
        for axis in chain.axes
    ]


def mjcf_of(chain: Chain, after: list[np.ndarray]) -> str:
    """MJCF of a serial chain with moved joint frames."""
    before = [np.eye(4), *after]
    lines, end = [], []
    for j, name in enumerate(chain.moving_joints):
        pose = se3.inverse(before[j]) @ chain.origins[j] @ after[j]
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel())  # pyright: ignore[reportAttributeAccessIssue]
        kind = "slide" if chain.prismatic[j] else "hinge"
        axis = after[j][:3, :3].T @ chain.axes[j]
        lines.append(
            f'<body name="link_{j}" pos="{numbers(pose[:3, 3])}" quat="{numbers(quat)}">'
            f'<joint name="{name}" type="{kind}" axis="{numbers(axis)}"/><geom size="0.01"/>'
        )
        end.append("</body>")
    tip = se3.inverse(after[-1]) @ chain.origins[-1]
    axes = numbers([*tip[:3, 0], *tip[:3, 1]])
    lines.append(f'<site name="{chain.tip}" pos="{numbers(tip[:3, 3])}" xyaxes="{axes}"/>')
    return "\n".join(["<mujoco><worldbody>", *lines, *end, "</worldbody></mujoco>"])


def calibrated(chain: Chain, folder, name: str) -> Chain:
    """Chain read from a file with errors of 2 mm and 2 mrad."""
    rng = np.random.default_rng(5)
    errors = se3.exp6(2e-3 * rng.normal(size=(len(chain.origins), 6)))
    moved = replace(chain, origins=chain.origins @ errors)
    for path, content in urdf_files(moved, folder / name).items():
        write(folder, os.path.basename(path), content)
    return read_robot(folder / name, chain.tip)


def draw(chain: Chain):
    return np.random.default_rng(0).uniform(-2, 2, (20, chain.n_joints))


@pytest.mark.parametrize(("turn", "shift"), [(0.0, 0.0), (1.0, 0.2)], ids=["same frames", "other frames"])
def test_a_urdf_goes_into_an_mjcf_and_back(tmp_path, turn, shift):
    nominal = read_robot(UR10, "tool0")
    template = write(tmp_path, "template.xml", mjcf_of(nominal, other_frames(nominal, turn, shift)))
    robot = calibrated(nominal, tmp_path, "calibrated.urdf")
    assert np.abs(robot.poses(draw(robot)) - nominal.poses(draw(robot))).max() > 1e-3

    text = convert_robot(tmp_path / "calibrated.urdf", "out.xml", "tool0", template=template).text
    by_mujoco = mujoco_poses(text.encode(), "tool0", robot.joint_names, draw(robot))
    np.testing.assert_allclose(by_mujoco, _pinocchio_poses(robot, draw(robot)), atol=1e-9)
    assert POSES.sub("", text).replace(" xyaxes", "") == re.sub(
        r' xyaxes="[^"]*"', "", POSES.sub("", template.read_text())
    )

    out = write(tmp_path, "out.xml", text)
    back = convert_robot(out, "back.urdf", "tool0", template=UR10).text
    assert POSES.sub("", back) == POSES.sub("", UR10.read_text())
    again = read_robot(write(tmp_path, "back.urdf", back), "tool0")
    np.testing.assert_allclose(_pinocchio_poses(again, draw(robot)), by_mujoco, atol=1e-9)


@pytest.mark.parametrize(("text", "tip"), [(SCARA, "tool0"), (XARM, "link6"), (UR5E, "attachment_site")])
def test_a_calibrated_mjcf_fills_in_its_own_urdf(tmp_path, text, tip):
    """Frames are the same, so every joint origin is that of the MJCF."""
    path = write(tmp_path, "arm.xml", text)
    template = write(tmp_path, "arm.urdf", convert_robot(path, "arm.urdf").text)
    robot = calibrated(read_robot(path, tip), tmp_path, "calibrated.xml")
    back = convert_robot(tmp_path / "calibrated.xml", "back.urdf", tip, template=template).text
    again = read_robot(write(tmp_path, "back.urdf", back), tip)
    np.testing.assert_allclose(again.origins, robot.origins, atol=1e-12)


def test_copies_keep_every_byte(tmp_path):
    path = write(tmp_path, "arm.xml", SCARA)
    assert convert_robot(path, "copy.xml").text == SCARA
    assert parse_mjcf(SCARA.encode(), "").data.decode() == convert_robot(path, "copy.urdf").text


WRONG = {
    "other joints": (
        lambda text: text.replace("elbow_joint", "knee_joint"),
        "the joints up to 'tool0' are .*knee",
    ),
    "other size": (
        lambda text: text.replace('pos="', 'pos="1', 3),
        "the axis of joint '.*' is 1.* mm and .* from",
    ),
    "other direction": (
        lambda text: text.replace('axis="0.0 0.0 1.0"', 'axis="0.0 0.0 -1.0"', 1),
        "the axis of joint '.*' is 0 mm and 180° from",
    ),
    "no tip": (
        lambda text: text.replace('site name="tool0"', 'site name="tcp"'),
        "no link 'tool0' as in .*--template-tip",
    ),
    "other tip": (
        lambda text: re.sub('(tool0" pos=)"[^"]*"', r'\1"0 0 1"', text),
        "'tool0' is .* from 'tool0' of",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_another_robot_is_refused(tmp_path, case):
    nominal = read_robot(UR10, "tool0")
    change, words = WRONG[case]
    template = write(tmp_path, "template.xml", change(mjcf_of(nominal, other_frames(nominal, 0, 0))))
    with pytest.raises(DhcalError, match=rf"template\.xml: {words}"):
        convert_robot(UR10, "out.xml", "tool0", template=template)


@pytest.mark.parametrize("has_world", [True, False], ids=["world in the robot", "world added"])
def test_a_base_pose_in_the_urdf_is_named_as_the_reason(tmp_path, has_world):
    """The robot is written as by `calibrate --world-joint`; without that pose, the file is converted."""
    text = UR10.read_text()
    source = write(tmp_path, "nominal.urdf", text if has_world else without_world(text))
    nominal = read_robot(source, "tool0")
    template = write(tmp_path, "template.xml", mjcf_of(nominal, other_frames(nominal, 0.3, 0.1)))
    robot = calibrated(nominal, tmp_path, "calibrated.urdf")
    base = se3.transform(se3.exp3([0.05, -0.1, 2.0]), np.array([2.5, 1.2, -0.4]))
    moved = with_world((tmp_path / "calibrated.urdf").read_bytes(), base)
    write(tmp_path, "world.urdf", moved.decode())
    words = r"template\.xml: the whole robot of .*world\.urdf is moved by .* in world, as by .*--world-joint"
    with pytest.raises(DhcalError, match=words):
        convert_robot(tmp_path / "world.urdf", "out.xml", "tool0", template=template)
    out = convert_robot(tmp_path / "calibrated.urdf", "out.xml", "tool0", template=template).text
    by_mujoco = mujoco_poses(out.encode(), "tool0", robot.joint_names, draw(robot))
    np.testing.assert_allclose(by_mujoco, _pinocchio_poses(robot, draw(robot)), atol=1e-9)


def without_world(text: str) -> str:
    """Return the URDF of a UR10 that begins with its base link."""
    text = re.sub(r'(?s)<joint name="[^"]*" type="fixed">\s*<parent link="world"\s*/>.*?</joint>', "", text)
    return re.sub(r'<link name="world"\s*/>', "", text)


@pytest.mark.parametrize(("degrees", "is_same"), [(8, True), (15, False)])
def test_axes_turn_as_far_as_in_a_low_cost_arm(tmp_path, degrees, is_same):
    """The last axis is turned. MuJoCo gives the poses of the result."""
    nominal = read_robot(UR10, "tool0")
    template = write(tmp_path, "template.xml", mjcf_of(nominal, other_frames(nominal, 0, 0)))
    origins = nominal.origins.copy()
    axis = np.cross(nominal.axes[5], [1, 2, 3])
    turn = se3.exp3(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    origins[5] = origins[5] @ se3.transform(turn, np.zeros(3))
    for path, content in urdf_files(replace(nominal, origins=origins), tmp_path / "robot.urdf").items():
        write(tmp_path, os.path.basename(path), content)
    if not is_same:
        with pytest.raises(DhcalError, match=r"the axis of joint 'wrist_3_joint' is .* mm and 15° from"):
            convert_robot(tmp_path / "robot.urdf", "out.xml", "tool0", template=template)
        return
    robot = read_robot(tmp_path / "robot.urdf", "tool0")
    text = convert_robot(tmp_path / "robot.urdf", "out.xml", "tool0", template=template).text
    by_mujoco = mujoco_poses(text.encode(), "tool0", robot.joint_names, draw(robot))
    np.testing.assert_allclose(by_mujoco, _pinocchio_poses(robot, draw(robot)), atol=1e-9)


def test_a_template_of_another_format_is_refused(tmp_path):
    template = write(tmp_path, "template.xml", SCARA)
    with pytest.raises(DhcalError, match=r"out\.urdf: .*template\.xml has another format"):
        convert_robot(UR10, "out.urdf", "tool0", template=template)
    with pytest.raises(DhcalError, match=r"only a URDF or an MJCF has a template"):
        convert_robot(UR10, "out.dh.toml", "tool0", template=template)


def test_the_last_body_can_be_the_tip_if_its_joint_turns_about_the_axis_of_the_robot(tmp_path):
    """A frame of the last link moves with its joint; a tilt of the tip against the axis has no place."""
    nominal = read_robot(UR10, "tool0")
    robot = calibrated(nominal, tmp_path, "calibrated.urdf")
    after = [*other_frames(nominal, 0, 0)[:-1], nominal.origins[-1]]
    template = write(tmp_path, "template.xml", mjcf_of(nominal, after))
    with pytest.raises(DhcalError, match=r"template\.xml: cannot hold the tip of .*, which would be 0\.00"):
        convert_robot(robot.urdf.source, "out.xml", "tool0", template=template, template_tip="link_5")
    fixed_tip = replace(robot, origins=np.concatenate([robot.origins[:-1], nominal.origins[-1:]]))
    for path, content in urdf_files(fixed_tip, tmp_path / "fixed.urdf").items():
        write(tmp_path, os.path.basename(path), content)
    text = convert_robot(
        tmp_path / "fixed.urdf", "out.xml", "tool0", template=template, template_tip="link_5"
    ).text
    by_mujoco = mujoco_poses(text.encode(), "link_5", robot.joint_names, draw(robot))
    np.testing.assert_allclose(by_mujoco, fixed_tip.poses(draw(robot)), atol=1e-9)
