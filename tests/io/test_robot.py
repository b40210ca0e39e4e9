"""Robot files: formats by ending, reading and converting."""

from dataclasses import replace

import numpy as np
import pytest
from robots import URDF, write

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import FORMATS, convert_robot, read_robot, robot, robot_name, urdf_files, write_urdf
from dhcal_pin.io.robot import find_format, has_dh_table

TABLE, ROBOT = URDF / "ur10.dh.toml", URDF / "sim_6dof.urdf"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("arm.urdf", "URDF"),
        ("ARM.URDF", "URDF"),
        ("arm.toml", "DH table"),
        ("arm.dh.csv", "DH table"),
        ("arm.origins.csv", "table of joint origins"),
        ("arm.yml", "kinematics of Universal Robots"),
    ],
)
def test_the_longest_ending_selects_the_format(name, expected):
    robot_format = find_format(name)
    assert robot_format is not None
    assert robot_format.name == expected


@pytest.mark.parametrize("move", [1e-11, 1e-9, 1e-6])
def test_a_urdf_that_is_not_the_calibrated_robot_is_not_written(monkeypatch, tmp_path, move):
    """Ten picometres are more than the rounding of decimal numbers."""
    chain = read_robot(ROBOT)
    edit = robot.with_origins

    def wrong(urdf, origins):
        joint = urdf.joint("joint_2")
        return edit(urdf, origins | {joint.name: joint.origin @ se3.translation([move, 0, 0])})

    assert urdf_files(chain, tmp_path / "a.urdf")
    monkeypatch.setattr(robot, "with_origins", wrong)
    with pytest.raises(
        DhcalError, match=r"a\.urdf: not written: the tool of the URDF as read back differs by"
    ):
        urdf_files(chain, tmp_path / "a.urdf")


def test_endings_are_unique():
    endings = [e for robot_format in FORMATS for e in (*robot_format.endings, *robot_format.other_endings)]
    assert len(set(endings)) == len(endings)
    assert find_format("arm.png") is None


def test_only_files_with_a_dh_table_have_a_fixed_tip():
    assert has_dh_table("arm.dh.toml")
    assert has_dh_table("arm.yaml")
    assert not has_dh_table("arm.urdf")
    assert not has_dh_table("arm.xml")
    with pytest.raises(DhcalError, match="a DH table has one tip; leave out --tip"):
        read_robot(TABLE, "tool0")


@pytest.mark.parametrize(
    "robot_format", [f for f in FORMATS if f.is_readable and f.name != "MJCF"], ids=lambda f: f.name
)
def test_a_converted_robot_has_the_same_poses(tmp_path, robot_format):
    for ending in robot_format.endings:
        path = write(tmp_path, f"arm{ending}", convert_robot(TABLE, f"arm{ending}").text)
        arm, again = read_robot(TABLE), read_robot(path)
        q = np.random.default_rng(0).uniform(-3, 3, (20, arm.n_joints))
        np.testing.assert_allclose(again.poses(q), arm.poses(q), atol=1e-12)


def test_a_converted_robot_begins_at_the_root_that_is_named(tmp_path):
    """Joints before it are those of the template."""
    arm = read_robot(ROBOT, root="link_2")
    assert arm.n_joints < read_robot(ROBOT).n_joints
    q = np.random.default_rng(0).uniform(-3, 3, (20, arm.n_joints))
    path = write(tmp_path, "arm.dh.toml", convert_robot(ROBOT, "arm.dh.toml", root="link_2").text)
    np.testing.assert_allclose(read_robot(path).poses(q), arm.poses(q), atol=1e-12)

    origins = se3.exp6(1e-3 * np.random.default_rng(1).normal(size=(len(arm.origins), 6)))
    write_urdf(replace(arm, origins=arm.origins @ origins), tmp_path / "moved.urdf")
    text = convert_robot(tmp_path / "moved.urdf", "out.urdf", template=ROBOT, root="link_2").text
    filled = write(tmp_path, "out.urdf", text)
    moved = read_robot(tmp_path / "moved.urdf", root="link_2")
    np.testing.assert_allclose(read_robot(filled, root="link_2").poses(q), moved.poses(q), atol=1e-12)
    assert np.array_equal(read_robot(filled).origins[0], read_robot(ROBOT).origins[0])


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        (TABLE, "arm.xml", r"arm\.xml: an MJCF holds more than kinematics; .* with --template"),
        (ROBOT, "arm.xml", r"arm\.xml: an MJCF holds more than kinematics; .* with --template"),
        (TABLE, "arm.png", r"arm\.png: unknown ending; choose from \.urdf, \.dh\.toml, \.dh\.csv, \.yaml"),
        ("arm.origins.csv", "arm.urdf", "a table of joint origins cannot be read as a robot; choose from"),
    ],
)
def test_what_cannot_be_converted_is_an_error(source, target, words):
    with pytest.raises(DhcalError, match=words):
        convert_robot(source, target)


def test_a_robot_has_the_name_of_its_file():
    assert robot_name("dir/arm.dh.toml") == "arm"
    assert robot_name(".urdf") == "arm"


@pytest.mark.parametrize("is_deeper", [False, True])
def test_the_tip_of_the_sidecar_is_the_default(tmp_path, is_deeper):
    """Without it, the last joints of the gripper are the deepest ones, or a nail of a finger."""
    joints = [
        ("revolute", "base", "hand"),
        ("fixed", "hand", "ball"),
        ("prismatic", "hand", "left"),
        ("prismatic", "hand", "right"),
    ]
    joints += [("revolute", "left", "nail")] * is_deeper
    links = ["base", *(child for _, _, child in joints)]
    lines = [f'<link name="{name}"/>' for name in links]
    lines += [
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for kind, parent, child in joints
    ]
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(lines)}</robot>')
    if is_deeper:
        assert read_robot(path).tip == "nail"
    else:
        with pytest.raises(DhcalError, match="several tips are equally deep"):
            read_robot(path)
    (tmp_path / "arm.calibration.toml").write_text('tip = "ball"\n')
    assert read_robot(path).tip == "ball"
    assert read_robot(path, "left").tip == "left"
