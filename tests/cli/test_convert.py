"""Command convert."""

import itertools
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from command_line import assert_same_poses, stdout_of
from robots import URDF

from dhcal_pin.io import read_dh


@pytest.mark.parametrize("name", ["sim_6dof_actual", "experiment_published"])
def test_dh_table_survives_all_formats(run, robot_folder, name):
    start = URDF / f"{name}.dh.toml"
    paths = [start, "a.dh.csv", "b.dh.toml", "c.urdf", "d.dh.csv", "e.urdf", "f.dh.toml"]
    for source, target in itertools.pairwise(paths):
        stdout_of(run("convert", source, target))
        assert_same_poses(start, target)
    table = read_dh(start)
    for target in paths[1:3]:
        converted = read_dh(target)
        for key in ("theta", "d", "a", "alpha"):
            assert getattr(converted, key).tolist() == getattr(table, key).tolist()
    for target in ("d.dh.csv", "f.dh.toml"):
        converted = read_dh(target)
        for key in ("theta", "d", "a", "alpha"):
            np.testing.assert_allclose(getattr(converted, key), getattr(table, key), atol=1e-12)


def test_base_and_tool_survive_all_formats(run, robot_folder):
    with_frames = Path("arm.dh.toml").read_text().replace(
        "[units]",
        "base = {xyz_m = [0.1, 0.2, 0.3], rotvec_rad = [0.4, -0.5, 0.6]}\n"
        "tool = {xyz_m = [0.01, -0.02, 0.03], rotvec_rad = [0.0, 2.0, 1.0]}\n[units]",
    )  # fmt: skip
    Path("turned.dh.toml").write_text(with_frames)
    paths = ["turned.dh.toml", "t.urdf", "u.dh.csv", "v.dh.toml", "w.urdf", "x.dh.toml", "y.dh.csv"]
    for source, target in itertools.pairwise(paths):
        stdout_of(run("convert", source, target))
        assert_same_poses("turned.dh.toml", target)
    np.testing.assert_allclose(
        read_dh("u.dh.csv").poses(np.zeros((1, 3))), read_dh("y.dh.csv").poses(np.zeros((1, 3)))
    )


@pytest.mark.parametrize("target", ["m.dh.toml", "m.dh.csv"])
@pytest.mark.parametrize("source", ["arm.dh.toml", "arm.urdf"])
def test_conversion_between_conventions(run, robot_folder, source, target):
    stdout_of(run("convert", source, target, "--convention", "modified"))
    assert read_dh(target).convention == "modified"
    assert_same_poses("arm.urdf", target)
    stdout_of(run("convert", target, "s.dh.toml", "--convention", "standard"))
    assert read_dh("s.dh.toml").convention == "standard"
    assert_same_poses("arm.urdf", "s.dh.toml")


def test_conversion_to_the_same_convention_is_exact(run, robot_folder):
    table = read_dh("arm.dh.toml")
    stdout_of(run("convert", "arm.dh.toml", "s.dh.csv", "--convention", "standard"))
    assert read_dh("s.dh.csv").alpha.tolist() == table.alpha.tolist()


@pytest.mark.parametrize("table", ["c.dh.toml", "c.dh.csv"])
@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_joint_types_survive_a_dh_file(run, robot_folder, table, convention):
    text = Path("arm.urdf").read_text()
    Path("c.urdf").write_text(
        re.sub("<limit.*?/>", "", text.replace('"revolute"', '"continuous"', 1), count=1)
    )
    stdout_of(run("convert", "c.urdf", table, "--convention", convention))
    stdout_of(run("convert", table, "d.urdf"))
    model = pin.buildModelFromUrdf("d.urdf")
    assert [joint.shortname() for joint in model.joints][1:] == [
        "JointModelRUBZ", "JointModelRZ", "JointModelRZ"
    ]  # fmt: skip
    assert_same_poses("c.urdf", "d.urdf")


def test_sidecar_is_noted(run, robot_folder):
    Path("new.calibration.toml").write_text("[base]\nxyz_m = [1.0, 0.0, 0.0]\n")
    assert "note: new.calibration.toml" in run("convert", "arm.dh.toml", "new.urdf")[2]
    assert re.search(r"note: .*new\.calibration\.toml", run("convert", "new.urdf", "new.dh.csv")[2])
