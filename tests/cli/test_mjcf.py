"""Calibration and conversion of MJCF files by commands."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import folder_contents, stdout_of
from mjcf_robots import SCARA, UR5E, mujoco_poses
from robots import write

from dhcal_pin import se3
from dhcal_pin.io import read_robot

TIP = ("--tip", "attachment_site")


@pytest.fixture
def mjcf_folder(robot_folder, run):
    """Working folder with the MJCF of a UR5e and 40 poses of one with errors of 1 mm and 0.1°."""
    write(robot_folder, "ur5e.xml", UR5E)
    errors = ("--errors", "1mm,0.1deg", "--noise", "0.01mm,0.001deg")
    stdout_of(run("simulate", "ur5e.xml", "-m", 40, *errors, *TIP, "-o", "ur5e.csv"))
    return robot_folder


def test_a_calibrated_mjcf_predicts_the_measurements_in_mujoco(run, mjcf_folder):
    out = json.loads(
        stdout_of(run("calibrate", "ur5e.xml", "ur5e.csv", "-o", "out.xml", *TIP, "--json", "-"))
    )
    assert out["files"]["xml"] == "out.xml"
    rows = np.array([line.split(",") for line in Path("ur5e.csv").read_text().splitlines()[2:]], float)
    measured = se3.transform(se3.exp3(rows[:, 9:12]), rows[:, 6:9])
    chain = read_robot("out.xml", "attachment_site")
    tips = mujoco_poses(Path("out.xml").read_bytes(), chain.tip, chain.joint_names, rows[:, :6])
    error = np.linalg.norm((chain.base @ tips @ chain.tool)[:, :3, 3] - measured[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(error**2)) < 5e-5
    assert [line for line in Path("out.xml").read_text().splitlines() if "<body" not in line] == [
        line for line in UR5E.splitlines() if "<body" not in line
    ]


@pytest.mark.parametrize(
    ("change", "words", "options"),
    [
        (("<compiler ", '<include file="a.xml"/><compiler '), ["ur5e.xml:2: <include>: cannot be"], []),
        (("<joint axis", '<joint pos="0 0 1" axis'), ["ur5e.xml:5: <joint>: a default class with pos"], []),
        (('<joint name="elbow', '<joint name="e2"/><joint name="elbow'), ["ur5e.xml:23: joint"], []),
        (("", ""), ["--world-joint: not available for out.xml"], ["--world-joint"]),
        (("", ""), ["--tool-frame: not available for out.xml"], ["--tool-frame", "t"]),
    ],
)  # fmt: skip
def test_what_an_mjcf_cannot_hold_is_refused_before_the_calibration(
    run, assert_refused, mjcf_folder, change, words, options
):
    write(mjcf_folder, "ur5e.xml", UR5E.replace(change[0], change[1], 1))
    assert_refused(words, "calibrate", "ur5e.xml", "ur5e.csv", "-o", "out.xml", *TIP, *options)


def test_other_formats_of_a_robot_name_the_way(run, assert_refused, robot_folder):
    way = "write cal.urdf, then `dhcal convert cal.urdf out.dh.csv`"
    assert_refused([way], "calibrate", "arm.dh.toml", "data.csv", "-o", "out.dh.csv")
    stdout_of(run("convert", "arm.urdf", "out.dh.csv"))
    Path("arm.dh.xlsx").write_bytes(b"PK\x03\x04\xff")
    for command in (("inspect", "--robot", "arm.dh.xlsx"), ("convert", "arm.dh.xlsx", "other.urdf")):
        assert_refused(["arm.dh.xlsx: a workbook holds no robot; save a DH table as .dh.csv"], *command)


def test_a_urdf_is_not_written_as_an_mjcf(assert_refused, robot_folder):
    words = ["out.xml: ", " is no MJCF; write a .urdf, and convert it with --template"]
    assert_refused(words, "calibrate", "arm.urdf", "data.csv", "-o", "out.xml")


def test_a_calibrated_urdf_goes_into_the_mjcf(run, assert_refused, mjcf_folder):
    """The calibration of the URDF and that of the MJCF are the same."""
    stdout_of(run("convert", "ur5e.xml", "ur5e.urdf"))
    stdout_of(run("calibrate", "ur5e.xml", "ur5e.csv", "-o", "mjcf.xml", *TIP))
    stdout_of(run("calibrate", "ur5e.urdf", "ur5e.csv", "-o", "urdf.urdf", *TIP))
    _, _, err = run("convert", "urdf.urdf", "out.xml", "--template", "ur5e.xml", *TIP)
    assert "note: urdf.calibration.toml is not copied" in err
    # The MJCF has the joints of the URDF: it can be read with its sidecar. The nominal robot has others.
    to_template = ("convert", "urdf.urdf", "urdf.xml", "--template", "ur5e.xml", *TIP)
    assert "note: urdf.calibration.toml lies beside it and is read with it" in run(*to_template)[2]
    assert np.array_equal(read_robot("urdf.xml").base, read_robot("urdf.urdf").base)
    words = ["mjcf.urdf: mjcf.calibration.toml lies beside it, belongs to another robot file"]
    assert_refused(words, "convert", "ur5e.xml", "mjcf.urdf")
    q = np.random.default_rng(0).uniform(-3, 3, (20, 6))
    chain = read_robot("urdf.urdf", "attachment_site")
    poses = [
        mujoco_poses(Path(name).read_bytes(), chain.tip, chain.joint_names, q)
        for name in ("out.xml", "mjcf.xml")
    ]
    assert np.abs(poses[0] - se3.inverse(chain.base) @ chain.poses(q) @ se3.inverse(chain.tool)).max() < 1e-9
    assert np.abs(poses[0] - poses[1]).max() < 1e-9
    assert_refused(
        ["--template-tip: needs --template"], "convert", "ur5e.xml", "a.xml", "--template-tip", "x"
    )
    assert_refused(
        ["ur5e.xml: is an input file"], "convert", "urdf.urdf", "ur5e.xml", "--template", "ur5e.xml"
    )
    write(mjcf_folder, "scara.xml", SCARA)
    words = ["scara.xml: no link 'attachment_site' as in urdf.urdf"]
    assert_refused(words, "convert", "urdf.urdf", "a.xml", "--template", "scara.xml", *TIP)
    assert "a.xml" not in folder_contents(mjcf_folder)
