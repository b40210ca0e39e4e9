"""Command plan, and the map of the command calibrate."""

import json

import numpy as np
import pytest
from command_line import error_of, json_of, stderr_of, stdout_of
from robots import URDF

from dhcal_pin.io import read_configurations, read_robot
from dhcal_pin.robot import joint_coverage

ROBOT = str(URDF / "sim_6dof.dh.toml")
TRUTH = str(URDF / "sim_6dof_actual.dh.toml")


def test_plan_and_its_json(tmp_path, run):
    poses, planned = tmp_path / "poses.csv", tmp_path / "plan.json"
    options = ("-n", 12, "--candidates", 400, "--sigma", "0.2mm,0.02deg", "--json", planned)
    err = stderr_of(run("plan", ROBOT, "-o", poses, *options))
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


def test_seed_determines_the_plan(tmp_path, run):
    for name in ("a.csv", "b.csv"):
        run("plan", ROBOT, "-n", 6, "--candidates", 200, "-o", tmp_path / name)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_plan_from_measured_poses(tmp_path, run):
    data, chosen = tmp_path / "data.csv", tmp_path / "chosen.csv"
    run("simulate", ROBOT, "--truth", TRUTH, "-m", 60, "--noise", "0.1mm,0.01deg", "-o", data)
    assert run("plan", ROBOT, "-n", 10, "--from", data, "-o", chosen, "--json", "-")[0] == 0
    exact = tmp_path / "exact.csv"
    options = ("--joint-units", "rad", "--json", "-")
    out = stdout_of(run("plan", ROBOT, "-n", 10, "--from", data, "-o", exact, *options))
    rows = np.array(json.loads(out)["rows"]) - 1
    chain = read_robot(ROBOT)
    assert np.array_equal(read_configurations(exact, chain), read_configurations(data, chain)[rows])
    # Degrees, by default, have four decimals.
    assert "joint_1[deg]" in chosen.read_text()
    found = np.degrees(read_configurations(chosen, chain) - read_configurations(exact, chain))
    assert 0 < np.abs(found).max() <= 0.5001e-4
    more = tmp_path / "more.csv"
    options = ("-n", 5, "--data", data, "--candidates", 300, "-o", more, "--json", "-")
    found = json.loads(run("plan", ROBOT, *options)[1])
    # The standard deviation is that of the data.
    assert found["sigma_position_m"] == pytest.approx(1e-4)
    assert found["predicted_position_rms_m"] < 1e-4


def test_plan_for_a_calibrated_robot(tmp_path, run, unsuspected_once):
    """The uncertainty in the sidecar is the prior unless data or priors are given."""
    data, robot, out = tmp_path / "data.csv", tmp_path / "arm.urdf", tmp_path / "more.csv"
    run("simulate", ROBOT, "--truth", TRUTH, "-m", 40, "--noise", "0.1mm,0.01deg", "-o", data)
    run("calibrate", ROBOT, data, "-o", robot, "--parameters", "minimal,base,tool")
    options = ("-n", 10, "--candidates", 300, "--parameters", "minimal,base,tool", "-o", out, "--json", "-")
    known, beside, fresh = (
        json.loads(run("plan", *more, *options)[1])
        for more in ((robot,), (ROBOT, "--data", data), (robot, "--priors", "default"))
    )
    assert [found["criterion"] for found in (known, beside, fresh)] == ["D"] * 3
    key = "predicted_position_rms_m"
    assert known[key] == pytest.approx(beside[key], rel=0.1)
    assert known[key] < 0.7 * fresh[key]
    robust = ("-n", 10, "--from", data, "--criterion", "robust", "-o", out, "--json", "-")
    chosen = json.loads(run("plan", ROBOT, *robust)[1])
    assert chosen["criterion"] == "robust"
    # An arcminute of joint scatter is added to the noise.
    assert chosen["sigma_orientation_rad"] > 2e-4


def test_plan_for_curves_from_measured_poses(tmp_path, run):
    data, chosen, planned = tmp_path / "data.csv", tmp_path / "chosen.csv", tmp_path / "plan.json"
    run("simulate", ROBOT, "--truth", TRUTH, "-m", 80, "--noise", "0.1mm,0.01deg", "-o", data)
    options = ("-n", 20, "--from", data, "--criterion", "curves", "-o", chosen, "--json", planned)
    err = stderr_of(run("plan", ROBOT, *options))
    document = json.loads(planned.read_text())
    assert document["criterion"] == "curves"
    assert len(set(document["rows"])) == 20
    # There are 80 poses to choose from.
    assert [row["poses"] for row in document["joint_curves"]] == [0, 20, 50]
    shares = [row["filled_share"] for row in document["joint_curves"]]
    std = [row["curve_std_rad"] for row in document["joint_curves"]]
    assert 0 == shares[0] < shares[1] < shares[2] <= 1
    assert std[0] > std[1] > std[2] > 0
    table = err[err.index("joint correction curves") :].splitlines()
    assert table[1].split() == ["poses", "bins", "filled", "curve", "std,", "µrad"]
    assert table[4].split() == ["50", f"{100 * shares[2]:.0f}", "%", f"{1e6 * std[2]:.0f}"]
    chain = read_robot(ROBOT)
    visited = [one.n_visited for one in joint_coverage(chain, read_configurations(chosen, chain))]
    assert min(visited) >= 18


def test_task_by_positions_and_by_joint_values(tmp_path, run):
    targets = tmp_path / "targets.csv"
    chain = read_robot(ROBOT)
    points = 1e3 * chain.poses(np.random.default_rng(0).uniform(-1, 1, (5, 6)))[:, :3, 3]
    rows = [",".join(f"{value:.3f}" for value in point) for point in points]
    targets.write_text("\n".join(["x[mm],y[mm],z[mm]", *rows]) + "\n")
    poses = tmp_path / "poses.csv"
    base = ("plan", ROBOT, "-n", 10, "--candidates", 300, "--criterion", "task", "--task")
    assert run(*base, targets, "-o", poses)[0] == 0
    assert run(*base, poses, "-o", tmp_path / "again.csv")[0] == 0
    targets.write_text("x[mm],y[mm],z[mm]\n9000,0,0\n")
    err = error_of(run(*base, targets, "-o", tmp_path / "none.csv"))
    assert "targets.csv: target 1 is out of reach" in err
    assert not (tmp_path / "none.csv").exists()


def test_box_and_visibility(tmp_path, run):
    robot = "example:ur10"
    poses = tmp_path / "poses.csv"
    space = ("--box", "0,-800,100:1200,800,1000mm", "--visible-from", "2.5,0,1m", "--cone", "40deg")
    options = ("-n", 8, "--tip", "tool0", "--kind", "position", "--candidates", 400)
    assert run("plan", robot, *options, *space, "-o", poses)[0] == 0
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
        (("--candidates", "4"), "4 candidates for 5 poses: expected from 5 to 50000"),
        (("--candidates", "50000000"), "expected from 5 to 50000"),
        (("--margin", "2"), "--margin"),
        (("--priors", "none"), "needs priors"),
        (("--from", "nowhere.csv"), "nowhere.csv"),
        (("--parameters", "dhh"), "dhh"),
        (("--floor", "0"), "--floor 0: expected a height with a unit"),
        (("--floor", "2m"), "lower the floor"),
        (("--obstacle", "1,2,3mm"), "--obstacle 1,2,3mm"),
        (("--obstacle", "1,0,0:0,1,1m"), "below the second"),
        (("--obstacle", "nowhere.urdf"), "nowhere.urdf"),
        (("--obstacle", str(URDF / "sim_6dof.urdf")), "no collision geometry; expected obstacles"),
        (("--export", "moves.gcode"), "unknown ending; write a program as .script or .trajectory.csv"),
    ],
)
def test_invalid_arguments_are_one_line_and_write_nothing(tmp_path, run, options, words):
    out = tmp_path / "poses.csv"
    err = error_of(run("plan", ROBOT, "-n", 5, "--candidates", 50, "-o", out, *options))
    assert words in err
    assert len(err.strip().splitlines()) == 1
    assert not out.exists()


def test_map_of_a_calibration(tmp_path, run, unsuspected_once):
    data, robot, cells = tmp_path / "data.csv", tmp_path / "arm.urdf", tmp_path / "map.csv"
    run("simulate", ROBOT, "--truth", TRUTH, "-m", 30, "--noise", "0.1mm,0.01deg", "-o", data)
    assert run("calibrate", ROBOT, data, "-o", robot, "--map", cells)[0] == 0
    table = np.loadtxt(cells, delimiter=",", comments="#", skiprows=2)
    assert table.shape[1] == 6
    assert (table[:, 4] >= table[:, 3]).all()
    assert table[:, 5].sum() == 20_000
    # Thirty poses with 0.1 mm noise determine the position to a few hundredths of a millimetre.
    assert 0.01 < np.sqrt(np.average(table[:, 3] ** 2, weights=table[:, 5])) < 0.5


UR10 = ("plan", "example:ur10", "--tip", "tool0", "--candidates", 300, "-n", 10)
# A table beside the robot, as a link of a scene on a leg, and as a box.
TABLE = """<robot name="cell"><link name="cell"/><link name="table"><collision><origin xyz="0 0 -0.2"/>
<geometry><box size="0.8 0.7 0.4"/></geometry></collision></link><joint name="leg" type="fixed">
<origin xyz="0.8 -0.65 0.4"/><parent link="cell"/><child link="table"/></joint></robot>"""
TABLE_BOX = "400,-1000,0:1200,-300,400mm"


def lowest_tool(path, tip="tool0"):
    chain = read_robot("example:ur10", tip)
    return chain.poses(read_configurations(path, chain))[:, 2, 3].min()


def test_robot_stays_above_the_floor_by_default(tmp_path, run):
    poses = tmp_path / "poses.csv"
    err = stderr_of(run(*UR10, "-o", poses))
    assert lowest_tool(poses) > 0
    assert "free of collisions" in err
    assert run(*UR10, "-o", poses, "--floor", "-300mm")[0] == 0
    assert -0.3 < lowest_tool(poses) < 0
    assert run(*UR10, "-o", poses, "--floor", "none")[0] == 0
    assert lowest_tool(poses) < -0.3


def test_obstacles_of_a_scene_and_boxes(tmp_path, run):
    """A scene and the equal box give the same plan, whose tools are not in the table."""
    scene, pages = tmp_path / "cell.urdf", {}
    scene.write_text(TABLE)
    for name, obstacle in (("scene", scene), ("box", TABLE_BOX)):
        poses, pages[name] = tmp_path / f"{name}.csv", tmp_path / f"{name}.html"
        document = json_of(
            run(*UR10, "-o", poses, "--obstacle", obstacle, "--html", pages[name], "--json", "-")
        )
        assert document["blocked_moves"] == []
        assert document["files"]["html"] == str(pages[name])
        assert (str(scene) in document["inputs"]) == (name == "scene")
    assert (tmp_path / "scene.csv").read_text() == (tmp_path / "box.csv").read_text()
    chain = read_robot("example:ur10", "tool0")
    q = read_configurations(poses, chain)
    place = chain.poses(q)[:, :3, 3]
    assert not ((place > [0.4, -1.0, 0]) & (place < [1.2, -0.3, 0.4])).all(1).any()
    page = pages["box"].read_text().split('type="application/json">')[1].split("</script>")[0]
    preview = json.loads(page)
    (shape,) = preview["obstacles"]
    np.testing.assert_allclose(shape["box"], [0.8, 0.7, 0.4])
    np.testing.assert_allclose(np.reshape(shape["placement"], (3, 4))[:, 3], [0.8, -0.65, 0.2])
    assert preview["floor"] == 0
    np.testing.assert_allclose(np.array(preview["configurations"])[preview["stops"]], q, atol=1e-6)


def test_exports_visit_the_poses_in_their_order(tmp_path, run):
    poses, names = tmp_path / "poses.csv", ("p.script", "p.trajectory.csv", "p.robodk.csv")
    exports = [word for name in names for word in ("--export", tmp_path / name)]
    assert run(*UR10, "-o", poses, *exports)[0] == 0
    q = read_configurations(poses, read_robot("example:ur10", "tool0"))
    degrees = np.loadtxt(tmp_path / "p.robodk.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(np.radians(degrees[:, :6]), q, atol=1e-6)
    script = (tmp_path / "p.script").read_text()
    assert [f"# pose {i}" in script for i in range(1, 12)] == [True] * 10 + [False]
    assert "pose 1 is not checked" in script
    trajectory = np.loadtxt(tmp_path / "p.trajectory.csv", delimiter=",", skiprows=1)
    for pose in q:
        assert np.abs(trajectory[:, 1:] - pose).max(1).min() < 1e-6


def test_a_robot_without_geometry_is_checked_as_lines(tmp_path, run):
    poses = tmp_path / "poses.csv"
    err = stderr_of(run("plan", ROBOT, "-n", 8, "--candidates", 200, "-o", poses, "--floor", "-500mm"))
    assert "checked against straight lines between the joints" in err
    chain = read_robot(ROBOT)
    frames = chain.forward_kinematics(read_configurations(poses, chain))
    assert frames.columns[2:, 3, 2].min() > -0.5
    assert frames.tool[3, 2].min() > -0.5
