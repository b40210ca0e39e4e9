"""MJCF against MuJoCo: poses of the files as they are, and after their origins were written."""

import re
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from mjcf_robots import BENCH, ROBOTS, SCARA, UR5E, XARM, mujoco_poses
from robots import pinocchio_poses, write

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import joint_origins, read_robot, urdf_files
from dhcal_pin.robot import Chain, Transmission
from dhcal_pin.robot.formats.mjcf import Mjcf, parse_mjcf
from dhcal_pin.robot.formats.mjcf_edit import with_origins

ARMS = pytest.mark.parametrize("arm", ROBOTS)
POSE = re.compile(rb"""[ ]+(pos|quat|euler|axisangle|xyaxes|zaxis)\s*=\s*("[^"]*"|'[^']*')""")


def parsed(text: str) -> Mjcf:
    mjcf = parse_mjcf(text.encode(), "arm.xml")
    assert isinstance(mjcf, Mjcf)
    return mjcf


def chain_of(arm: str) -> Chain:
    text, tip = ROBOTS[arm]
    return Chain.from_urdf(parsed(text), tip)


def without_poses(data: bytes, chain: Chain, joints) -> bytes:
    """A file without the poses of the bodies that hold the origins of some joints."""
    assert isinstance(chain.urdf, Mjcf)
    starts = {chain.urdf.places[name].tag.start for name in joints}
    for start in sorted(starts, reverse=True):
        end = data.index(b">", start)
        data = data[:start] + POSE.sub(b"", data[start:end]) + data[end:]
    return data


def draw(chain: Chain, m: int = 20):
    return np.random.default_rng(0).uniform(-2, 2, (m, chain.n_joints))


@ARMS
def test_poses_are_those_of_mujoco(arm):
    chain = chain_of(arm)
    q = draw(chain)
    expected = mujoco_poses(ROBOTS[arm][0].encode(), chain.tip, chain.joint_names, q)
    np.testing.assert_allclose(chain.poses(q), expected, atol=1e-12)
    np.testing.assert_allclose(pinocchio_poses(chain, q), expected, atol=1e-12)


def test_every_body_has_the_pose_that_mujoco_gives_it():
    q = draw(chain_of("bench"))
    for tip, n in zip("abcde", range(1, 6), strict=True):
        chain = Chain.from_urdf(parsed(BENCH), tip)
        expected = mujoco_poses(BENCH.encode(), tip, chain.joint_names, q[:, :n])
        np.testing.assert_allclose(chain.poses(q[:, :n]), expected, atol=1e-12)


@ARMS
def test_calibrated_files_agree_with_mujoco_and_keep_all_other_bytes(arm, tmp_path):
    """Errors of 10 mm and 0.01 rad at each joint and at the tip."""
    chain = chain_of(arm)
    rng = np.random.default_rng(1)
    errors = se3.exp6(0.01 * rng.normal(size=(len(chain.origins), 6)))
    calibrated = replace(chain, origins=chain.origins @ errors)
    files = urdf_files(calibrated, tmp_path / "out.xml")
    data = files[tmp_path / "out.xml"]
    assert isinstance(data, bytes)
    origins, tool = joint_origins(calibrated)

    q = draw(chain)
    by_mujoco = mujoco_poses(data, chain.tip, chain.joint_names, q)
    np.testing.assert_allclose(by_mujoco @ tool, calibrated.poses(q), atol=1e-9)
    write(tmp_path, "out.xml", data)
    written = read_robot(tmp_path / "out.xml", chain.tip)
    np.testing.assert_allclose(pinocchio_poses(written, q), by_mujoco, atol=1e-9)

    assert without_poses(data, written, origins) == without_poses(ROBOTS[arm][0].encode(), chain, origins)


@ARMS
def test_file_alone_and_sidecar_hold_two_models(arm, tmp_path):
    """MuJoCo has the origins that are best without joint errors; with the sidecar the model is complete."""
    chain, rng = chain_of(arm), np.random.default_rng(2)
    alone, complete = (
        chain.origins @ se3.exp6(1e-3 * rng.normal(size=(len(chain.origins), 6))) for _ in "ab"
    )
    transmission = Transmission.zero(chain.loads)
    transmission.linear[np.diag_indices(chain.n_joints)] = 1e-3
    fit = replace(chain, origins=complete, urdf_origins=alone).with_transmission(transmission)
    for path, content in urdf_files(fit, tmp_path / "out.xml").items():
        write(tmp_path, str(path), content)
    q = draw(chain)
    written = read_robot(tmp_path / "out.xml", chain.tip)
    by_mujoco = mujoco_poses((tmp_path / "out.xml").read_bytes(), chain.tip, chain.joint_names, q)
    np.testing.assert_allclose(written.urdf_alone.poses(q), by_mujoco @ written.tool, atol=1e-9)
    np.testing.assert_allclose(written.poses(q), fit.poses(q), atol=1e-12)


def test_a_file_without_changes_is_the_same(tmp_path):
    for arm, (text, _) in ROBOTS.items():
        assert urdf_files(chain_of(arm), tmp_path / "o.xml")[tmp_path / "o.xml"] == text.encode()


def test_only_what_changed_is_written():
    mjcf = parsed(SCARA)
    chain = Chain.from_urdf(mjcf, "tool0")
    moved = chain.perturbed_at({4: se3.translation([0, 0, 0.25])})
    assert with_origins(mjcf, joint_origins(moved)[0]).decode() == SCARA.replace(
        "pos='.45 0 0'", "pos='0.45 0.0 0.25'"
    )
    turned = chain.perturbed_at({6: se3.exp6([0, 0, 0, 0, 0, np.pi / 2])})
    data = with_origins(mjcf, joint_origins(turned)[0]).decode()
    pose = re.search(r"pos='([^']*)' quat='([^']*)'", data)
    assert pose
    # The position is that of the body, the origin lies 20 mm (`ref`) before it along the axis.
    np.testing.assert_allclose(np.array(pose[1].split(), float), [0.4, 0, 0.05], atol=1e-15)
    # Half a turn about x, then a quarter about the new z.
    np.testing.assert_allclose(np.array(pose[2].split(), float), [0, 1, -1, 0] / np.sqrt(2), atol=1e-15)
    assert data.replace(pose[0], "pos='.4 0 .05' euler='180 0 0'") == SCARA


def test_a_tip_that_the_file_cannot_hold_goes_to_the_tool():
    chain = Chain.from_urdf(parsed(BENCH), "a")
    moved = chain.perturbed_at({chain.tip_frame: se3.translation([0, 0, 1e-3])})
    origins, tool = joint_origins(moved)
    assert not origins
    np.testing.assert_allclose(tool[:3, 3], [0, 0, 1e-3], atol=1e-15)


def test_stated_masses_are_read_and_others_are_not():
    """Gravity torques of the UR5e as MuJoCo computes them; a shape with a mass makes all of them unknown."""
    engine: Any = mujoco
    chain = chain_of("ur5e")
    model = engine.MjModel.from_xml_string(UR5E)
    data = engine.MjData(model)
    for row in draw(chain, 3):
        data.qpos[:] = row
        engine.mj_forward(model, data)
        torques = pin.computeGeneralizedGravity(chain.model, chain.model.createData(), row)
        np.testing.assert_allclose(torques, data.qfrc_bias, atol=2e-12 * np.abs(torques).max())
    masses = [each.mass for each in chain_of("xarm6").model.inertias]
    assert masses[1:] == [2.1, 1.9, 1.7, 1.3, 1.0, 0.1]
    shape = '<joint name="joint6"/><body><geom size="1"/></body>'
    heavy = Chain.from_urdf(parsed(XARM.replace('<joint name="joint6"/>', shape)), "link6")
    for robot in (chain_of("panda"), heavy):
        assert not any(each.mass for each in robot.model.inertias)


# Content of the root, and of the world body; what is said of line 2.
WRONG = [
    ('<include file="arm.xml"/>', "", "<include>: cannot be written back; give the file that holds"),
    ('<default><joint pos="1 0 0"/></default>', "", "<joint>: a default class with pos cannot be written"),
    ('<default><site quat="1 0 0 0"/></default>', "", "<site>: a default class with quat cannot"),
    ("<default><default/></default>", "", "<default>: no class; expected class"),
    ('<compiler coordinate="global"/>', "", "<compiler>: coordinate is 'global'; expected local"),
    ('<compiler angle="turns"/>', "", "<compiler>: angle is 'turns'; expected degree or radian"),
    ('<compiler eulerseq="xyw"/>', "", "<compiler>: eulerseq is 'xyw'; expected three axes"),
    ("", '<replicate count="2"/>', "<replicate>: cannot be written back"),
    ("", '<attach model="m"/>', "<attach>: cannot be written back"),
    ("", '<body><joint class="k"/></body>', "<joint>: unknown default class 'k'; the file has none"),
    ("", '<body><joint type="helix"/></body>', "<joint>: unknown type 'helix'"),
    ("", '<body><joint axis="0 0 0"/></body>', "<joint>: axis has length 0"),
    ("", '<body><joint axis="1.7e308 1.7e308 0"/></body>', "<joint>: axis has length inf"),
    ("", '<body><joint range="2 1"/></body>', "<joint>: range: lower 2 is above"),
    ("", '<body name="b" pos="1 x 0"/>', "body 'b': pos has 'x'; expected a finite"),
    ("", '<body quat="1 0 0"/>', "<body>: quat has 3 numbers; expected 4"),
    ("", '<body quat="1 0 0 0" euler="0 0 0"/>', "<body>: quat and euler state"),
    ("", '<body pos="1e9 0 0"/>', "<body>: a pose is beyond"),
    ("", '<body><inertial pos="0 0 0"/></body>', "<inertial>: no mass"),
    ("", '<body><inertial pos="0 0 0" mass="-1"/></body>', "<inertial>: mass is outside of 0 to 1e+06"),
    ("", '<body name="b"/><body name="b"/>', "body 'b': the name is already used on line 2"),
    ("", '<body><joint name="j"/><body><joint name="j"/></body></body>', "joint 'j': the name is already"),
]


@pytest.mark.parametrize(("content", "bodies", "words"), WRONG)
def test_what_cannot_be_read_or_written_is_one_line_with_its_place(content, bodies, words):
    text = f"<mujoco>\n{content}<worldbody>{bodies}</worldbody>\n</mujoco>"
    with pytest.raises(DhcalError) as caught:
        parse_mjcf(text.encode(), "arm.xml")
    assert str(caught.value).startswith(f"arm.xml:2: {words}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [("<sdf/>", "1: <sdf>: neither MJCF nor URDF"), ("<mujoco/>", "1: <mujoco>: no <worldbody>")],
)
def test_other_files_are_refused(text, words):
    with pytest.raises(DhcalError, match=f"^arm.xml:{words}"):
        parse_mjcf(text.encode(), "arm.xml")


def test_the_second_joint_of_a_body_cannot_be_written():
    text = SCARA.replace("<joint name='elbow'", "<joint name='second' axis='0 1 0'/><joint name='elbow'")
    chain = Chain.from_urdf(parsed(text), "tool0")
    q = draw(chain)
    expected = mujoco_poses(text.encode(), "tool0", chain.joint_names, q)
    np.testing.assert_allclose(chain.poses(q), expected, atol=1e-12)
    moved = chain.perturbed_at({6: se3.translation([1e-3, 0, 0])})
    with pytest.raises(DhcalError, match=r"^arm\.xml:9: joint 'elbow': not the first joint of its body"):
        urdf_files(moved, "out.xml")


def test_a_urdf_with_the_ending_of_an_mjcf_is_read(tmp_path):
    path = write(tmp_path, "arm.xml", parsed(SCARA).data)
    chain = read_robot(path, "tool0")
    q = draw(chain)
    np.testing.assert_allclose(chain.poses(q), chain_of("scara").poses(q), atol=1e-15)
    with pytest.raises(DhcalError, match=r"arm\.xml is no MJCF; write a \.urdf"):
        urdf_files(chain, tmp_path / "out.xml")
