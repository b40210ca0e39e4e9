"""Command plan, and the map of the command calibrate."""

from __future__ import annotations

import json

import numpy as np
import pytest
from robots import URDF, robot_file

from dhcal_pin.cli import main
from dhcal_pin.io import read_robot
from dhcal_pin.io.measurement_csv import read_configurations

ROBOT = str(URDF / "sim_6dof.dh.toml")
TRUTH = str(URDF / "sim_6dof_actual.dh.toml")


def run(capsys, *args) -> tuple[int, str, str]:
    status = main.main([*map(str, args)])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_plan_and_its_json(tmp_path, capsys):
    poses, planned = tmp_path / "poses.csv", tmp_path / "plan.json"
    options = ("-n", 12, "--candidates", 400, "--sigma", "0.2mm,0.02deg", "--json", planned)
    status, _, err = run(capsys, "plan", ROBOT, "-o", poses, *options)
    assert status == 0
    assert "lower predicted error than 12 random poses" in err
    chain = read_robot(ROBOT)
    q = read_configurations(poses, chain)
    assert q.shape == (12, 6)
    document = json.loads(planned.read_text())
    assert document["sigma_position_m"] == pytest.approx(2e-4)
    assert document["sigma_orientation_rad"] == pytest.approx(np.deg2rad(0.02))
    curve = {row["poses"]: row["predicted_position_rms_m"] for row in document["curve"]}
    assert curve[12] == pytest.approx(document["predicted_position_rms_m"], rel=1e-9)
    assert curve[24] < curve[12] < curve[min(curve)]
    assert document["relative_error"] < 1
    assert document["rows"] is None


def test_seed_determines_the_plan(tmp_path, capsys):
    for name in ("a.csv", "b.csv"):
        run(capsys, "plan", ROBOT, "-n", 6, "--candidates", 200, "-o", tmp_path / name)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_plan_from_measured_poses(tmp_path, capsys):
    data, chosen = tmp_path / "data.csv", tmp_path / "chosen.csv"
    run(capsys, "simulate", ROBOT, "--truth", TRUTH, "-m", 60, "--noise", "0.1mm,0.01deg", "-o", data)
    assert run(capsys, "plan", ROBOT, "-n", 10, "--from", data, "-o", chosen, "--json", "-")[0] == 0
    status, out, _ = run(capsys, "plan", ROBOT, "-n", 10, "--from", data, "-o", chosen, "--json", "-")
    assert status == 0
    rows = np.array(json.loads(out)["rows"]) - 1
    chain = read_robot(ROBOT)
    assert np.array_equal(read_configurations(chosen, chain), read_configurations(data, chain)[rows])
    more = tmp_path / "more.csv"
    options = ("-n", 5, "--data", data, "--candidates", 300, "-o", more, "--json", "-")
    found = json.loads(run(capsys, "plan", ROBOT, *options)[1])
    # The standard deviation is that of the data.
    assert found["sigma_position_m"] == pytest.approx(1e-4)
    assert found["predicted_position_rms_m"] < 1e-4


def test_plan_for_a_calibrated_robot(tmp_path, capsys):
    """The uncertainty in the sidecar is the prior unless data or priors are given."""
    data, robot, out = tmp_path / "data.csv", tmp_path / "arm.urdf", tmp_path / "more.csv"
    run(capsys, "simulate", ROBOT, "--truth", TRUTH, "-m", 40, "--noise", "0.1mm,0.01deg", "-o", data)
    run(capsys, "calibrate", ROBOT, data, "-o", robot, "--parameters", "minimal,base,tool")
    options = ("-n", 10, "--candidates", 300, "--parameters", "minimal,base,tool", "-o", out, "--json", "-")
    known, beside, fresh = (
        json.loads(run(capsys, "plan", *more, *options)[1])
        for more in ((robot,), (ROBOT, "--data", data), (robot, "--priors", "default"))
    )
    assert [found["criterion"] for found in (known, beside, fresh)] == ["D"] * 3
    key = "predicted_position_rms_m"
    assert known[key] == pytest.approx(beside[key], rel=0.1)
    assert known[key] < 0.7 * fresh[key]
    robust = ("-n", 10, "--from", data, "--criterion", "robust", "-o", out, "--json", "-")
    chosen = json.loads(run(capsys, "plan", ROBOT, *robust)[1])
    assert chosen["criterion"] == "robust"
    # An arcminute of joint scatter is added to the noise.
    assert chosen["sigma_orientation_rad"] > 2e-4


def test_task_by_positions_and_by_joint_values(tmp_path, capsys):
    targets = tmp_path / "targets.csv"
    chain = read_robot(ROBOT)
    points = 1e3 * chain.poses(np.random.default_rng(0).uniform(-1, 1, (5, 6)))[:, :3, 3]
    rows = [",".join(f"{value:.3f}" for value in point) for point in points]
    targets.write_text("\n".join(["x[mm],y[mm],z[mm]", *rows]) + "\n")
    poses = tmp_path / "poses.csv"
    base = ("plan", ROBOT, "-n", 10, "--candidates", 300, "--criterion", "task", "--task")
    assert run(capsys, *base, targets, "-o", poses)[0] == 0
    assert run(capsys, *base, poses, "-o", tmp_path / "again.csv")[0] == 0
    targets.write_text("x[mm],y[mm],z[mm]\n9000,0,0\n")
    status, _, err = run(capsys, *base, targets, "-o", tmp_path / "none.csv")
    assert status == 2
    assert "targets.csv: target 1 is out of reach" in err
    assert not (tmp_path / "none.csv").exists()


def test_box_and_visibility(tmp_path, capsys):
    robot = robot_file("ur_description/urdf/ur10_robot.urdf")
    poses = tmp_path / "poses.csv"
    space = ("--box", "0,-800,100:1200,800,1000mm", "--visible-from", "2.5,0,1m", "--cone", "40deg")
    options = ("-n", 8, "--tip", "tool0", "--kind", "position", "--candidates", 400)
    assert run(capsys, "plan", robot, *options, *space, "-o", poses)[0] == 0
    chain = read_robot(robot, "tool0")
    found = chain.poses(read_configurations(poses, chain))
    place = found[:, :3, 3]
    assert ((place >= [0, -0.8, 0.1]) & (place <= [1.2, 0.8, 1.0])).all()
    away = np.array([2.5, 0, 1]) - place
    assert (np.sum(found[:, :3, 2] * away, 1) >= np.cos(np.deg2rad(40)) * np.linalg.norm(away, axis=1)).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--criterion", "G"), "choose from D, A, E, task"),
        (("--kind", "distance"), "choose from pose"),
        (("--sigma", "0.1"), "--sigma"),
        (("--sigma", "0.1mm"), "0.1mm,0.01deg"),
        (("--box", "0,0,0:1,1,1"), "unit at the end"),
        (("--box", "1,0,0:0,1,1m"), "below the second"),
        (("--box", "9,9,9:10,10,10m"), "widen the box"),
        (("--visible-from", "1,2mm"), "unit at the end"),
        (("--cone", "30deg"), "needs --visible-from"),
        (("--visible-from", "3,0,1m", "--cone", "400deg"), "half angle"),
        (("--candidates", "4"), "4 candidates for 5 poses: expected from 5 to 1000000"),
        (("--candidates", "50000000"), "expected from 5 to 1000000"),
        (("--margin", "2"), "--margin"),
        (("--priors", "none"), "needs priors"),
        (("--from", "nowhere.csv"), "nowhere.csv"),
        (("--parameters", "dhh"), "dhh"),
    ],
)
def test_invalid_arguments_are_one_line_and_write_nothing(tmp_path, capsys, options, words):
    out = tmp_path / "poses.csv"
    status, _, err = run(capsys, "plan", ROBOT, "-n", 5, "--candidates", 50, "-o", out, *options)
    assert status == 2
    assert words in err
    assert len(err.strip().splitlines()) == 1
    assert not out.exists()


def test_map_of_a_calibration(tmp_path, capsys):
    data, robot, cells = tmp_path / "data.csv", tmp_path / "arm.urdf", tmp_path / "map.csv"
    run(capsys, "simulate", ROBOT, "--truth", TRUTH, "-m", 30, "--noise", "0.1mm,0.01deg", "-o", data)
    assert run(capsys, "calibrate", ROBOT, data, "-o", robot, "--map", cells)[0] == 0
    table = np.loadtxt(cells, delimiter=",", comments="#", skiprows=2)
    assert table.shape[1] == 6
    assert (table[:, 4] >= table[:, 3]).all()
    assert table[:, 5].sum() == 20_000
    # Thirty poses with 0.1 mm noise determine the position to a few hundredths of a millimetre.
    assert 0.01 < np.sqrt(np.average(table[:, 3] ** 2, weights=table[:, 5])) < 0.5
