"""`dhcal plan --iso9283` and `dhcal validate --iso9283`."""

import csv
import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from command_line import error_of, json_of, stderr_of, unfolded
from robots import UR10, URDF

ARM = (UR10, "--tip", "tool0")

# Distance of P2 and P4: 80 % of the diagonal of the cube.
DIAGONAL = 0.8 * np.sqrt(3)


def tool_poses(q):
    """Compute tool poses of the robot with Pinocchio."""
    model = pin.buildModelFromUrdf(str(UR10))
    data, frame = model.createData(), model.getFrameId("tool0")
    poses = []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        poses.append(data.oMf[frame].homogeneous)
    return np.array(poses)


def rows_of(path):
    """Return the labels and the joint positions [rad] of a plan."""
    lines = [line for line in Path(path).read_text().splitlines() if not line.startswith("#")]
    header, *rows = csv.reader(lines)
    assert header[0] == "iso_point"
    assert all(name.endswith("[deg]") for name in header[1:])
    return [row[0] for row in rows], np.deg2rad(np.array([row[1:] for row in rows], float)), header


def test_plan_and_validation(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ("plan", *ARM, "--iso9283", "--cube", "400mm", "--cycles", 4, "-o", "iso.csv", "--json", "-")
    document = json_of(run(*command))
    labels, q, header = rows_of("iso.csv")
    assert labels == [f"P{point}:{cycle}" for cycle in (1, 2, 3, 4) for point in (1, 2, 3, 4, 5)]
    assert document["side_m"] == pytest.approx(0.4)
    poses = tool_poses(q)
    points, side = poses[:5, :3, 3], document["side_m"]
    assert np.allclose(q, np.tile(q[:5], (4, 1)), atol=0)
    centre = np.array(document["centre_m"])
    expected = centre + 0.4 * side * np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]])
    assert points == pytest.approx(expected, abs=2e-5)
    assert poses[:5, :3, :3] == pytest.approx(np.tile(poses[:1, :3, :3], (5, 1, 1)), abs=2e-5)
    # Measured positions that are 1 mm off along x in each cycle but scatter by ±0.1 mm along y.
    measured = 1e3 * poses[:, :3, 3] + [1.0, 0.0, 0.0]
    measured[:, 1] += np.where(np.arange(20) // 5 % 2, 0.1, -0.1)
    with open("measured.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*header, "x[mm]", "y[mm]", "z[mm]"])
        writer.writerows([a, *np.rad2deg(b), *c] for a, b, c in zip(labels, q, measured, strict=True))
    options = ("--iso9283", "--report", "r.html", "--json", "iso.json")
    err = stderr_of(run("validate", *ARM, "measured.csv", *options))
    assert "ISO 9283:1998" in unfolded(err)
    assert "7.2.2" in Path("r.html").read_text()
    found = json.loads(Path("iso.json").read_text())["iso9283"]
    assert found["clauses"]["pose repeatability"] == "7.2.2"
    for point in found["points"]:
        assert point["AP_p_m"] == pytest.approx(1e-3, abs=1e-8)
        assert point["RP_l_m"] == pytest.approx(1e-4, abs=1e-8)
    longest = [each["commanded_m"] for each in found["distances"] if each["points"] == ["P2", "P4"]]
    assert longest == pytest.approx([DIAGONAL * side], abs=2e-5)
    assert found["overall"]["AD_m"] == pytest.approx(0, abs=1e-8)


def test_an_arm_that_cannot_keep_the_orientation_turns_the_tool(run, tmp_path):
    poses = tmp_path / "iso.csv"
    options = ("--iso9283", "--cube", "60mm", "-o", poses, "--json", "-")
    document = json_of(run("plan", URDF / "sim_6dof.urdf", *options))
    assert document["poses"] == 150
    assert any("orientation of the tool differs" in note for note in document["notes"])
    points = np.array([point["position_m"] for point in document["points"]])
    assert np.linalg.norm(points[3] - points[1]) == pytest.approx(DIAGONAL * 0.06, abs=1e-8)


def test_program_goes_to_p5_first(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ("--cube", "250mm", "--cycles", 1, "--export", "iso.script", "-o", "iso.csv", "--quiet")
    assert run("plan", *ARM, "--iso9283", *options)[0] == 0
    moves = [line for line in Path("iso.script").read_text().splitlines() if "movej" in line]
    values = [line.partition("[")[2].partition("]")[0] for line in moves]
    assert len(values) == 6
    assert values[0] == values[-1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--iso9283", "-n", "5"), "-n: not allowed with --iso9283"),
        (("--iso9283", "--cube", "9m"), "no cube with a side of 9000 mm fits"),
        (("--iso9283", "--cube", "0mm"), "expected a side above zero"),
        (("--iso9283", "--cube", "big"), "--cube big: expected a side with a unit"),
        (("--cycles", "5", "-n", "5"), "--cycles: needs --iso9283"),
        ((), "number of poses is missing"),
    ],
)
def test_wrong_options_of_plans(run, tmp_path, options, message):
    path = tmp_path / "iso.csv"
    err = error_of(run("plan", *ARM, *options, "-o", path))
    assert message in unfolded(err)
    assert not path.exists()


def test_wrong_points_of_a_validation(run, robot_folder):
    lines = Path("data.csv").read_text().splitlines()
    marked = [f"iso_point,{lines[0]}", *(f"P1:x,{line}" for line in lines[1:])]
    Path("marked.csv").write_text("\n".join(marked) + "\n")
    err = error_of(run("validate", "arm.urdf", "marked.csv", "--iso9283", "--json", "v.json"))
    assert "marked.csv:2" in unfolded(err)
    assert "such as P1:12" in unfolded(err)
    assert not Path("v.json").exists()
    err = error_of(run("validate", "arm.urdf", "data.csv", "--iso9283"))
    assert "point P1 has one cycle" in unfolded(err)


def test_no_fit_of_frames_is_advised(run, tmp_path, monkeypatch):
    """With fitted frames, AP is not that of the standard; RP is the same."""
    monkeypatch.chdir(tmp_path)
    labels = [f"P{point}:{cycle}" for cycle in (1, 2, 3, 4) for point in (1, 2, 3, 4, 5)]
    rng = np.random.default_rng(0)
    q = np.tile(rng.uniform(-1.5, 1.5, (5, 6)), (4, 1))
    measured = 1e3 * tool_poses(q)[:, :3, 3] + [500.0, 0.0, 0.0] + rng.normal(0, 0.02, (20, 3))
    names = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    header = ["iso_point", *(f"{name}_joint[rad]" for name in names), "x[mm]", "y[mm]", "z[mm]"]
    with open("measured.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([a, *b, *c] for a, b, c in zip(labels, q, measured, strict=True))
    found = [
        json_of(run("validate", *ARM, "measured.csv", "--iso9283", "--json", "-", *options))
        for options in ((), ("--fit-frames",))
    ]
    given, fitted = (" ".join(each["warnings"]) for each in found)
    assert "--fit-frames" not in given
    assert "the frames (base, tool) differ, and the accuracy AP contains it" in given
    assert "AP is less than that of ISO 9283" in fitted
    accuracy = [[point["AP_p_m"] for point in each["iso9283"]["points"]] for each in found]
    assert min(accuracy[0]) > 0.49
    assert max(accuracy[1]) < 1e-3
