"""Table of joint origins."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from robots import UR10

from dhcal_pin import se3
from dhcal_pin.cli.main import main
from dhcal_pin.io import origin_table, origins_text, urdf_files
from dhcal_pin.io.origins_file import MIN_MOVE
from dhcal_pin.robot import Chain, joint_frame


def test_origins_are_those_that_pinocchio_reads(sim_6dof_actual):
    rows = list(csv.DictReader(origins_text(sim_6dof_actual).splitlines()))
    assert [row["joint"] for row in rows] == [*sim_6dof_actual.moving_joints, "tool"]
    for row, origin in zip(rows, sim_6dof_actual.origins, strict=True):
        rotation = pin.rpy.rpyToMatrix(*(float(row[f"{k}[rad]"]) for k in ("roll", "pitch", "yaw")))
        np.testing.assert_allclose(rotation, origin[:3, :3], atol=1e-14)
        np.testing.assert_allclose([float(row[f"{k}[m]"]) for k in "xyz"], origin[:3, 3], atol=0)


def test_convert_writes_a_table_of_origins(tmp_path):
    out = tmp_path / "ur10.origins.csv"
    source = UR10
    assert main(["convert", str(source), str(out), "--tip", "tool0"]) == 0
    rows = {row["joint"]: row for row in csv.DictReader(out.read_text().splitlines())}
    assert float(rows["shoulder_pan_joint"]["z[m]"]) == 0.1273


def file_origins(path):
    """Text of xyz and rpy of each joint of a URDF."""
    out = {}
    for block in Path(path).read_text().split("<joint ")[1:]:
        name = re.search(r'name="(\w+)"', block)
        origin = re.search(r'<origin[^>]*rpy="([^"]*)"[^>]*xyz="([^"]*)"', block.split("</joint>")[0])
        if name and origin:
            out[name[1]] = origin[2], origin[1]
    return out


def test_calibrated_urdf_keeps_unmoved_joints_and_near_angles(tmp_path, monkeypatch):
    """The first joint is redundant with the base; the pitch of two others is a quarter turn."""
    monkeypatch.chdir(tmp_path)
    assert main(["convert", "example:ur10", "ur10.urdf"]) == 0
    options = ["--tip", "tool0", "--errors", "1mm,0.3deg", "--noise", "0.1mm,0.01deg"]
    assert main(["simulate", "ur10.urdf", "-m", "60", *options, "-o", "data.csv"]) == 0
    files = ["-o", "out.urdf", "--report", "report.md", "--json", "r.json"]
    assert main(["calibrate", "ur10.urdf", "data.csv", "--tip", "tool0", *files]) == 0
    before, after = file_origins("ur10.urdf"), file_origins("out.urdf")
    moved = [name for name in before if before[name] != after[name]]
    assert moved == [
        *(f"{name}_joint" for name in ("shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
    ]
    report = Path("report.md").read_text()
    for name in moved:
        old, new = (np.array(origins[name][1].split(), float) for origins in (before, after))
        rotation = pin.rpy.rpyToMatrix(*new)
        for equivalent in (new + np.array([np.pi, np.pi - 2 * new[1], np.pi]), pin.rpy.matrixToRpy(rotation)):
            turns = 2 * np.pi * np.round((old - equivalent) / (2 * np.pi))
            np.testing.assert_allclose(pin.rpy.rpyToMatrix(*equivalent), rotation, atol=1e-9)
            assert np.linalg.norm(new - old) <= np.linalg.norm(equivalent + turns - old) + 1e-9
        # The report shows the numbers of both files, to a micrometre and a microradian.
        ((xyz, rpy),) = re.findall(
            rf"\| {name} \| xyz \| .* \| (.*) \| .* \|\n\| {name} \| rpy \| .* \| (.*) \| .*°", report
        )
        np.testing.assert_allclose(
            np.array(xyz.split(), float), np.array(after[name][0].split(), float), atol=6e-7
        )
        np.testing.assert_allclose(np.array(rpy.split(), float), new, atol=6e-7)
    assert "shoulder_pan_joint | xyz" not in report


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_origins_that_move_less_than_the_threshold_keep_their_bytes(share):
    chain = Chain.from_urdf("example:ur10", "tool0")
    turn = replace(chain).perturbed_at({joint_frame(4): se3.exp6([0, 0, 0, share * MIN_MOVE, 0, 0])})
    slide = replace(chain).perturbed_at({joint_frame(2): se3.exp6([0, share * MIN_MOVE, 0, 0, 0, 0])})
    for moved, joint in ((turn, "wrist_1_joint"), (slide, "shoulder_lift_joint")):
        data = urdf_files(moved, "out.urdf")["out.urdf"]
        assert (data == chain.urdf.data) == (share < 1)
        assert [row[0] for row in origin_table(moved).rows] == ([] if share < 1 else [joint, joint])


def test_rotation_alone_keeps_the_text_of_the_translation():
    """Turned fixed joints lie before the gripper of this arm; their product must not change the digits."""
    chain = Chain.from_urdf("example:talos_left_arm", "gripper_left_motor_double_link")
    for j in range(1, chain.n_joints + 1):
        turned = chain.perturbed_at({joint_frame(j): se3.exp6([0, 0, 0, 1e-3, 2e-3, 0])})
        old = chain.urdf.joint(chain.moving_joints[j - 1])
        table = origin_table(turned)
        assert [row[0] for row in table.rows] == [old.name, old.name]
        assert table.rows[0][2] == table.rows[0][3]
        assert table.rows[0][4] == "0.000 mm"
        assert table.rows[1][4] == f"{np.degrees(np.hypot(1e-3, 2e-3)):.4f}°"
