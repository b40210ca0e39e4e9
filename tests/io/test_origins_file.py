"""Table of joint origins."""

from __future__ import annotations

import csv

import numpy as np
import pinocchio as pin
from robots import robot_file

from dhcal_pin.cli.main import main
from dhcal_pin.io import origins_text


def test_origins_are_those_that_pinocchio_reads(sim_6dof_actual):
    rows = list(csv.DictReader(origins_text(sim_6dof_actual).splitlines()))
    assert [row["joint"] for row in rows] == [*sim_6dof_actual.moving_joints, "tool"]
    for row, origin in zip(rows, sim_6dof_actual.origins, strict=True):
        rotation = pin.rpy.rpyToMatrix(*(float(row[f"{k}[rad]"]) for k in ("roll", "pitch", "yaw")))
        np.testing.assert_allclose(rotation, origin[:3, :3], atol=1e-14)
        np.testing.assert_allclose([float(row[f"{k}[m]"]) for k in "xyz"], origin[:3, 3], atol=0)


def test_convert_writes_a_table_of_origins(tmp_path):
    out = tmp_path / "ur10.origins.csv"
    source = robot_file("ur_description/urdf/ur10_robot.urdf")
    assert main(["convert", str(source), str(out), "--tip", "tool0"]) == 0
    rows = {row["joint"]: row for row in csv.DictReader(out.read_text().splitlines())}
    assert float(rows["shoulder_pan_joint"]["z[m]"]) == 0.1273
