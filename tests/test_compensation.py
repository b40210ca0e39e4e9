"""Compensation: the true robot, driven with what is returned, lands where it was asked to."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from command_line import error_of, stderr_of
from robots import URDF, nominal_arm, paper
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.cli import main
from dhcal_pin.compensation import compensate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_targets, write_urdf
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain, DHTable
from dhcal_pin.robot.conditions import Conditions
from dhcal_pin.robot.urdf_edit import with_world

pytestmark = pytest.mark.usefixtures("unsuspected")

ERROR = np.array([5e-3] * 3 + [np.deg2rad(1.0)] * 3)


def cartesian() -> Chain:
    """Three slides and a wrist."""
    zero, turn = np.zeros(6), np.pi / 2
    return Chain.from_dh(
        DHTable(
            "standard",
            tuple(f"j{i + 1}" for i in range(6)),
            np.array([True, True, True, False, False, False]),
            np.array([0, -turn, 0, 0, 0, 0]),
            zero,
            zero,
            np.array([-turn, -turn, 0, turn, -turn, 0]),
            zero,
            np.array([-0.4, -0.4, -0.4, -3.0, -2.0, -3.0]),
            np.array([0.4, 0.4, 0.4, 3.0, 2.0, 3.0]),
        )
    )


ROBOTS = {
    "ur5": lambda: nominal_arm("ur5"),
    "ur10": lambda: nominal_arm("ur10", "ee_link"),
    "panda": lambda: nominal_arm("panda", "panda_hand"),
    "sim_6dof": lambda: Chain.from_dh(paper("sim_6dof")),
    "z1": lambda: nominal_arm("z1", "link06"),
    "cartesian": cartesian,
}


def wrong(chain: Chain, rng: np.random.Generator) -> Chain:
    """The chain with every joint and the tip misplaced by up to 1° and 5 mm an axis."""
    stations = range(2, 2 * len(chain.moving_joints) + 3, 2)
    return chain.perturbed_at({station: se3.exp6(ERROR * rng.uniform(-1, 1, 6)) for station in stations})


def draw(chain: Chain, m: int, rng: np.random.Generator):
    return rng.uniform(np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi), (m, chain.n_joints))


def pinocchio_pose(chain: Chain, q) -> pin.SE3:
    data = chain.model.createData()
    pin.framesForwardKinematics(chain.model, data, chain.configurations(q[None])[0])
    return pin.SE3(chain.base) * data.oMf[chain.frame_id] * pin.SE3(chain.tool)


def controller(chain: Chain, pose, start):
    """Newton's method by Pinocchio's Jacobian: joint values (n,) of a nominal controller; tool at the tip."""
    model, data = chain.model, chain.model.createData()
    moving = [model.joints[model.getJointId(name)].idx_v for name in chain.joint_names]
    goal, q = pin.SE3(pose), np.array(start)
    for _ in range(50):
        full = chain.configurations(q[None])[0]
        pin.framesForwardKinematics(model, data, full)
        jacobian = pin.computeFrameJacobian(model, data, full, chain.frame_id, pin.LOCAL)[:, moving]
        gap = pin.log6((pin.SE3(chain.base) * data.oMf[chain.frame_id]).actInv(goal)).vector
        if np.abs(gap).max() < 1e-13:
            break
        q = q + np.linalg.lstsq(jacobian, gap, rcond=None)[0]
    return q


def landing(name: str, m: int, seed: int):
    """A true robot, targets of which every tenth is beyond its reach, and their compensation."""
    rng = np.random.default_rng(seed)
    nominal = ROBOTS[name]()
    true = wrong(nominal, rng)
    targets = true.poses(draw(nominal, m, rng))
    beyond = np.zeros(m, bool)
    beyond[::10] = True
    targets[beyond, :3, 3] *= 20 / np.linalg.norm(targets[beyond, :3, 3], axis=1)[:, None]
    return rng, nominal, true, targets, beyond


def check_landing(name: str, m: int, seed: int):
    rng, nominal, true, targets, beyond = landing(name, m, seed)
    found = compensate(nominal, true, targets)
    assert [status == "out of reach" for status in found.status] == beyond.tolist()
    assert found.reached.tolist() == (~beyond).tolist()
    assert np.isnan(found.q[beyond]).all()
    assert np.isnan(found.poses[beyond]).all()
    for i in np.flatnonzero(~beyond):
        q, goal = found.q[i], pin.SE3(targets[i])
        assert np.all((q >= nominal.lower) & (q <= nominal.upper))
        there = pinocchio_pose(true, q)
        assert np.linalg.norm(there.translation - goal.translation) <= 1e-9
        assert np.linalg.norm(pin.log3(there.rotation.T @ goal.rotation)) <= 1e-9
        assert np.abs(pinocchio_pose(nominal, q).homogeneous - found.poses[i]).max() <= 1e-12
        # A redundant arm's controller comes from where it is sent; others from somewhere near.
        near = q if nominal.n_joints > 6 else q + rng.uniform(-5e-3, 5e-3, nominal.n_joints)
        if found.status[i] == "ok":
            driven = pinocchio_pose(true, controller(nominal, found.poses[i], near))
            assert np.linalg.norm(driven.translation - goal.translation) <= 1e-9


@pytest.mark.parametrize("name", ROBOTS)
def test_true_robot_reaches_the_targets(name):
    check_landing(name, 60, 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 5))
@pytest.mark.parametrize("name", ROBOTS)
def test_true_robot_reaches_a_thousand_targets(name, seed):
    check_landing(name, 1100, seed)


@pytest.mark.parametrize("name", ["ur5", "panda", "sim_6dof"])
def test_true_robot_reaches_positions(name):
    _, nominal, true, targets, beyond = landing(name, 100, 7)
    found = compensate(nominal, true, targets[:, :3, 3])
    assert found.reached.tolist() == (~beyond).tolist()
    for i in np.flatnonzero(~beyond):
        there = pinocchio_pose(true, found.q[i]).translation
        assert np.linalg.norm(there - targets[i, :3, 3]) <= 1e-9


def short_arm(name: str) -> Chain:
    """A SCARA of four joints, or an arm of five joints."""
    turn = np.pi / 2
    scara = ([0.4, 0, 0, -0.05], [0.325, 0.275, 0, 0], [0, np.pi, 0, 0], [2.2, 2.5, 0.2, 6.2])
    five = ([0.1, 0, 0, 0, 0.1], [0, 0.12, 0.13, 0, 0], [turn, 0, 0, turn, 0], [2.8] * 5)
    d, a, alpha, upper = map(np.array, scara if name == "scara" else five)
    is_prismatic = np.arange(len(d)) == (2 if name == "scara" else len(d))
    names, zero = tuple(f"j{i + 1}" for i in range(len(d))), np.zeros(len(d))
    lower = np.where(is_prismatic, 0.0, -upper)
    return Chain.from_dh(DHTable("standard", names, is_prismatic, zero, d, a, alpha, zero, lower, upper))


@pytest.mark.parametrize("name", ["scara", "five"])
def test_arms_with_fewer_than_six_joints_reach_positions_and_the_nearest_orientations(name):
    """The nearest orientation is that of a constrained minimization by scipy."""
    rng, nominal = np.random.default_rng(3), short_arm(name)
    true = wrong(nominal, rng)
    # Inside the limits, so that the true arm reaches the positions.
    q = draw(nominal, 40, rng) * 0.8 + 0.1 * (nominal.lower + nominal.upper)
    targets = nominal.poses(q)
    found = compensate(nominal, true, targets, q)
    assert found.reached.mean() >= 0.85
    for i in np.flatnonzero(found.reached):
        there, goal = pinocchio_pose(true, found.q[i]), pin.SE3(targets[i])
        assert np.linalg.norm(there.translation - goal.translation) <= 1e-9
        angle = np.linalg.norm(pin.log3(there.rotation @ goal.rotation.T))
        assert found.residual_error[i, 1] == pytest.approx(angle, abs=1e-9)
        assert np.abs(pinocchio_pose(nominal, found.q[i]).homogeneous - found.poses[i]).max() <= 1e-12
    for i in np.flatnonzero(np.array(found.status) == "ok")[:6]:

        def turn(x, goal=targets[i]):
            return np.sum(pin.log3(pinocchio_pose(true, x).rotation @ goal[:3, :3].T) ** 2)

        def miss(x, goal=targets[i]):
            return 1e3 * (pinocchio_pose(true, x).translation - goal[:3, 3])

        best = minimize(turn, found.q[i], constraints=[{"type": "eq", "fun": miss}], options={"ftol": 1e-16})
        assert found.residual_error[i, 1] <= np.sqrt(best.fun) + 1e-5


def test_position_of_an_arm_with_few_joints_is_exact_at_another_temperature():
    nominal = short_arm("scara")
    errors = select_parameters(nominal, "thermal")
    true = wrong(errors.at(np.full(len(errors.parameters), 2e-5)), np.random.default_rng(4))
    q = np.array([[0.3, 0.9, 0.1, 0.4], [-0.5, 1.2, 0.05, -1.0]])
    warm = Conditions(q, temperature=np.full(2, 45.0))
    targets = nominal.poses(q)
    found = compensate(nominal, true, targets, q, conditions=warm)
    assert found.status == ("ok", "ok")
    there = true.poses(replace(warm, q=found.q))[:, :3, 3]
    np.testing.assert_allclose(there, targets[:, :3, 3], rtol=0, atol=1e-9)
    assert np.abs(true.poses(found.q)[:, :3, 3] - there).max() > 1e-5


def test_robot_with_correction_curves_reaches_its_targets():
    """The joint errors are added by plain arithmetic, and an ideal arm moves to the sums."""
    rng = np.random.default_rng(5)
    nominal = ROBOTS["ur10"]()
    ideal = wrong(nominal, rng)
    errors = select_parameters(ideal, "gain,harmonics,curves,coupling")
    x = rng.normal(size=len(errors.parameters)) * errors.priors
    value = dict(zip([p.name for p in errors.parameters], x, strict=True))
    true = errors.at(x)
    targets = true.poses(draw(nominal, 40, rng))
    found = compensate(nominal, true, targets)
    assert found.reached.all()
    moved = found.q.copy()
    for i, joint in enumerate(nominal.joint_names):
        q = found.q[:, i]
        moved[:, i] += value[f"{joint}.gain"] * q
        for k in range(1, 33):
            moved[:, i] += value[f"{joint}.sin{k}"] * np.sin(k * q) + value[f"{joint}.cos{k}"] * np.cos(k * q)
        for j, other in enumerate(nominal.joint_names):
            moved[:, i] += value.get(f"{joint}.{other}", 0.0) * found.q[:, j]
    assert np.abs(moved - found.q).max() > 1e-3
    for q, target in zip(moved, targets, strict=True):
        there, goal = pinocchio_pose(ideal, q), pin.SE3(target)
        assert np.linalg.norm(there.translation - goal.translation) <= 1e-9
        assert np.linalg.norm(pin.log3(there.rotation.T @ goal.rotation)) <= 1e-9


def noisy(m: int, seeds: range) -> tuple[list[float], list[float]]:
    """Squared misses of the true robot and squared predicted standard deviations, both in m²."""
    nominal = Chain.from_dh(paper("sim_6dof"))
    misses, expected = [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        true = Chain.from_dh(paper("sim_6dof_actual"))
        data = Pose.simulate(true, draw(nominal, 40, rng), Noise(1e-4, 1e-4), rng)
        fit = calibrate(nominal, data, "dh", extend="none")
        targets = true.poses(draw(nominal, m, rng))
        found = compensate(nominal, fit.chain, targets)
        there = true.poses(found.q[found.reached])[:, :3, 3]
        misses += np.sum((there - targets[found.reached, :3, 3]) ** 2, 1).tolist()
        expected += (fit.predict(found.q[found.reached]).position_std ** 2).tolist()
    return misses, expected


def test_calibrated_model_reaches_targets_within_the_predicted_uncertainty():
    misses, expected = noisy(20, range(8))
    assert 0.6 <= np.sqrt(np.mean(misses) / np.mean(expected)) <= 1.5
    assert np.mean(np.array(misses) <= 9 * np.array(expected)) >= 0.97


@pytest.mark.slow
def test_predicted_uncertainty_over_many_seeds():
    misses, expected = noisy(20, range(60))
    assert 0.9 <= np.sqrt(np.mean(misses) / np.mean(expected)) <= 1.1


def test_eight_objects_of_the_paper():
    """Rows 1-6 of Table 5 give the joint values that the paper sent; row 8 is beyond the arm."""
    nominal = Chain.from_dh(paper("experiment"))
    wanted = read_targets(URDF / "experiment_targets.csv", nominal)
    printed = np.loadtxt(URDF / "experiment_table5.csv", delimiter=",", skiprows=4)[:, :3]
    for calibrated in (nominal, Chain.from_dh(paper("experiment_published"))):
        found = compensate(nominal, calibrated, wanted.values, np.deg2rad([15, 15, -60]))
        assert found.status == (*["ok"] * 7, "out of reach")
        assert np.abs(calibrated.poses(found.q[:7])[:, :3, 3] - wanted.values[:7]).max() <= 1e-9
    ideal = compensate(nominal, nominal, wanted.values, np.deg2rad([15, 15, -60]))
    assert np.abs(np.rad2deg(ideal.q[:5]) - printed[:5]).max() <= 0.03
    assert np.abs(np.rad2deg(ideal.q[6]) - (29.95, 29.70, -29.39)).max() <= 0.01
    # 1305.8 mm from the shoulder of an arm of 745 mm.
    assert ideal.residual_error[7, 0] == pytest.approx(1.3058 - 0.745, abs=1e-4)


def test_singular_targets_are_marked():
    """UR5's wrist with axes 4 and 6 parallel."""
    arm = ROBOTS["ur5"]()
    q = draw(arm, 20, np.random.default_rng(0))
    q[:10, 4] = 0.0
    q[10:, 4] = 1.0
    q[10:, 2] = 1.0
    found = compensate(arm, arm, arm.poses(q), q)
    assert found.reached.all()
    assert set(found.status[:10]) == {"near singular"}
    assert found.status[10:].count("ok") >= 9


@pytest.mark.parametrize(("miss", "is_reached"), [(1e-8, True), (1e-6, True), (1e-5, False), (1e-4, False)])
def test_targets_on_the_edge_of_the_workspace_are_reached_up_to_some_micrometres(miss, is_reached):
    """The stretched arm points at the targets, which are beyond its tool by the miss."""
    arm = Chain.from_dh(paper("experiment"))
    q = np.deg2rad([[-60, -20, 0], [10, 40, 0], [60, 60, 0]])
    poses = arm.poses(q)
    found = compensate(arm, arm, poses[:, :3, 3] + miss * poses[:, :3, 0], q)
    assert found.reached.tolist() == [is_reached] * 3
    assert found.residual_error[:, 0] == pytest.approx(miss, rel=1e-3)
    if is_reached:
        assert found.status == ("near singular",) * 3


def test_targets_beyond_a_joint_limit_are_reached_up_to_some_micrometres():
    table = paper("experiment")
    upper = np.deg2rad([20.0, 30.0, -40.0])
    arm = Chain.from_dh(replace(table, lower=-upper - np.pi / 2, upper=upper))
    beyond = Chain.from_dh(table).poses((upper + np.array([2e-6, 0, 0]))[None])[:, :3, 3]
    found = compensate(arm, arm, beyond, upper)
    assert found.status == ("ok",)
    assert np.all(found.q <= arm.upper)
    assert 1e-9 < found.residual_error[0, 0] < 2e-6


def test_status_distinguishes_limits_from_reach():
    table = replace(paper("experiment"), lower=np.deg2rad([-90, -90, -150]), upper=np.deg2rad([90, 90, -5]))
    arm = Chain.from_dh(table)
    behind = replace(arm, lower=arm.lower - 10, upper=arm.upper + 10).poses(np.array([[np.pi, 0.3, -1.0]]))
    found = compensate(arm, arm, np.concatenate([behind[:, :3, 3], 3 * behind[:, :3, 3]]))
    assert found.status == ("joint limits", "out of reach")
    assert np.isnan(found.q).all()


def test_another_configuration_than_the_given_one_is_named():
    """The given configuration has its elbow on the other side, where the limits do not let it be."""
    table = replace(paper("experiment"), lower=np.deg2rad([-90, -90, -150]), upper=np.deg2rad([90, 90, -5]))
    arm = Chain.from_dh(table)
    q = np.deg2rad([20, 30, -70])
    given = np.array([q, q + np.deg2rad([0, -70, 140])])
    targets = np.repeat(arm.poses(q[None])[:, :3, 3], 2, 0)
    found = compensate(arm, arm, targets, given)
    assert found.status == ("ok", "other configuration")
    assert found.reached.all()
    np.testing.assert_allclose(found.q, [q, q], atol=1e-6)
    # One start for all targets only selects solutions.
    assert compensate(arm, arm, targets, given[1]).status == ("ok", "ok")


def test_nearest_of_several_solutions_is_chosen():
    rng = np.random.default_rng(3)
    arm = ROBOTS["ur10"]()
    true = wrong(arm, rng)
    q = draw(arm, 50, rng)
    round_ = q - 2 * np.pi * np.sign(q)
    q[25:] = np.where((round_ > arm.lower) & (round_ < arm.upper), round_, q)[25:]
    assert np.abs(q[25:]).max() > 4.0
    found = compensate(arm, true, true.poses(q), q + rng.uniform(-0.01, 0.01, q.shape))
    clear = np.array(found.status) == "ok"
    assert clear.sum() >= 40
    assert np.abs(found.q - q)[clear].max() <= 1e-6


def test_targets_are_in_the_measuring_frame():
    rng = np.random.default_rng(5)
    nominal = ROBOTS["z1"]()
    base, tool = se3.exp6(rng.normal(size=(2, 6)) * 0.3)
    true = replace(wrong(nominal, rng), base=base, tool=tool)
    targets = true.poses(draw(nominal, 30, rng))
    found = compensate(nominal, true, targets)
    assert found.reached.all()
    assert np.abs(true.poses(found.q) - targets).max() <= 1e-9
    assert np.abs(nominal.poses(found.q) - found.poses).max() <= 1e-12


@pytest.mark.parametrize(
    "targets", [np.zeros((3, 2)), np.full((1, 3), np.nan), np.zeros((0, 3)), 2 * np.eye(4)[None]]
)
def test_invalid_targets_are_refused(targets):
    arm = Chain.from_dh(paper("experiment"))
    with pytest.raises(DhcalError, match="targets"):
        compensate(arm, arm, targets)


# --- the command -----------------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A nominal UR5 and a true one with a base and a tool in its sidecar."""
    monkeypatch.chdir(tmp_path)
    nominal = ROBOTS["ur5"]()
    rng = np.random.default_rng(0)
    base, tool = se3.exp6(rng.normal(size=(2, 6)) * 0.2)
    Path("ur5.urdf").write_bytes(nominal.urdf.data)
    write_urdf(replace(wrong(nominal, rng), base=base, tool=tool), "true.urdf")
    return Chain.from_urdf("ur5.urdf", "tool0"), replace(
        Chain.from_urdf("true.urdf", "tool0"), base=base, tool=tool
    )


BASE = ("compensate", "ur5.urdf", "true.urdf", "targets.csv", "--tip", "tool0", "-o", "out.csv")
COMMAND = (*BASE, "--frame", "measuring")


def rows():
    with open("out.csv", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("rotation", ["", "qw,qx,qy,qz", "rx[deg],ry[deg],rz[deg]"])
def test_command_writes_joint_positions_and_corrected_targets(place, run, rotation):
    nominal, true = place
    joints = draw(nominal, 20, np.random.default_rng(1))
    poses = true.poses(joints)
    poses[3, 0, 3] += 9.0
    turns = Rotation.from_matrix(poses[:, :3, :3])
    extra = {"": np.empty((20, 0)), "q": turns.as_quat()[:, [3, 0, 1, 2]], "r": np.rad2deg(turns.as_rotvec())}
    table = np.hstack([1e3 * poses[:, :3, 3], extra[rotation[:1]]]).tolist()
    header = "x[mm],y[mm],z[mm]" + ("," + rotation if rotation else "")
    Path("targets.csv").write_text("\n".join([header, *(",".join(map(repr, row)) for row in table)]))
    said = stderr_of(run(*COMMAND))
    assert "1 of 20 out of reach" in said
    assert "  line 5 (" in said
    found = rows()
    assert len(found) == 20
    assert found[3]["status"] == "out of reach"
    assert not any(found[3][f"{name}[rad]"] for name in nominal.joint_names)
    good = [i for i, row in enumerate(found) if row["status"] in ("ok", "near singular")]
    assert len(good) == 19
    q = np.array([[float(found[i][f"{name}[rad]"]) for name in nominal.joint_names] for i in good])
    assert np.abs(true.poses(q)[:, :3, 3] - poses[good, :3, 3]).max() <= 1e-9
    if rotation:
        assert np.abs(true.poses(q) - poses[good]).max() <= 1e-9
    place_ = np.array([[float(found[i][f"{axis}[mm]"]) for axis in "xyz"] for i in good]) / 1e3
    names = rotation.split(",") if rotation else ["qw", "qx", "qy", "qz"]
    turned = np.array([[float(found[i][name]) for name in names] for i in good])
    matrix = (
        Rotation.from_rotvec(np.deg2rad(turned))
        if rotation[:1] == "r"
        else Rotation.from_quat(turned[:, [1, 2, 3, 0]])
    ).as_matrix()
    assert np.abs(nominal.poses(q)[:, :3, 3] - place_).max() <= 1e-12
    assert np.abs(nominal.poses(q)[:, :3, :3] - matrix).max() <= 1e-12


def test_joint_columns_choose_the_solution(place):
    nominal, true = place
    q = draw(nominal, 30, np.random.default_rng(2))
    poses = true.poses(q)
    header = (
        ",".join(f"{name}[deg]" for name in nominal.joint_names) + ",x[m],y[m],z[m],rx[rad],ry[rad],rz[rad]"
    )
    table = np.hstack([np.rad2deg(q), poses[:, :3, 3], se3.log3(poses[:, :3, :3])]).tolist()
    Path("targets.csv").write_text("\n".join([header, *(",".join(map(repr, row)) for row in table)]))
    assert main.main(COMMAND) == 0
    found = rows()
    assert {"x[m]", "rz[rad]", "miss_position[m]", "miss_rotation[deg]"} <= set(found[0])
    got = np.array([[float(row[f"{name}[rad]"]) for name in nominal.joint_names] for row in found])
    clear = [row["status"] == "ok" for row in found]
    assert sum(clear) >= 24
    assert np.abs(got - q)[clear].max() <= 1e-6


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["targets.csv", "empty"]),
        ("x[mm],y[mm],z[mm]\n", ["targets.csv", "no rows"]),
        ("x,y[mm],z[mm]\n1,2,3\n", ["targets.csv:1", "'x'", "no unit"]),
        ("x[mm],y[mm]\n1,2\n", ["targets.csv:1", "axes", "x[mm],y[mm],z[mm]"]),
        ("x[mm],y[mm],z[mm]\n1,2,oops\n", ["targets.csv:2", "'z'", "oops"]),
        ("x[mm],y[mm],z[mm],qw,qx,qy,qz\n1,2,3,1,1,0,0\n", ["targets.csv:2", "quaternion"]),
        ("x[mm],y[mm],z[mm],qw\n1,2,3,1\n", ["targets.csv:1", "qw"]),
        ("x[mm],y[mm],z[mm],elbow[deg]\n1,2,3,1\n", ["targets.csv:1", "elbow"]),
        ("x[mm],y[mm],z[mm],elbow_joint[deg]\n1,2,3,1\n", ["targets.csv:1", "shoulder_pan_joint"]),
        ("x[mm],y[mm],z[mm],target\n1,2,3,a\n", ["targets.csv:1", "targets"]),
    ],
)
def test_invalid_target_files_are_refused(place, run, text, words):
    Path("targets.csv").write_text(text)
    said = error_of(run(*COMMAND))
    for word in words:
        assert word in said
    assert said.count("targets.csv") == 1
    assert not Path("out.csv").exists()


def test_chains_with_different_joints_are_refused(place, run):
    Path("targets.csv").write_text("x[mm],y[mm],z[mm]\n1,2,3\n")
    Path("other.urdf").write_bytes((URDF / "experiment.urdf").read_bytes())
    for second, tips, words in (
        ("other.urdf", [], ["other.urdf", "joint_1"]),
        ("true.urdf", ["--tip", "nowhere"], ["nowhere"]),
    ):
        said = error_of(run("compensate", "ur5.urdf", second, "targets.csv", "-o", "out.csv", *tips))
        for word in words:
            assert word in said
    # A frame behind the tip makes another default tip, unless the sidecar states the tip.
    text = Path("true.urdf").read_text()
    more = (
        '<link name="probe"/><joint name="p" type="fixed"><parent link="tool0"/><child link="probe"/></joint>'
    )
    Path("true.urdf").write_text(text.replace("</robot>", f"{more}</robot>"))
    without_tip = "compensate", "ur5.urdf", "true.urdf", "targets.csv", "-o", "out.csv"
    assert "tool0" in stderr_of(run(*without_tip))
    Path("true.calibration.toml").unlink()
    said = error_of(run(*without_tip))
    assert "ur5.urdf" in said
    assert "probe" in said
    assert "is an input" in error_of(run(*BASE[:-1], "targets.csv"))


def write_targets(poses):
    header = "x[mm],y[mm],z[mm],qw,qx,qy,qz"
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    table = np.hstack([1e3 * poses[:, :3, 3], turns]).tolist()
    Path("targets.csv").write_text("\n".join([header, *(",".join(map(repr, row)) for row in table), ""]))


def joint_values(chain, unit="rad"):
    return np.array(
        [[float(row[f"{name}[{unit}]"] or "nan") for name in chain.joint_names] for row in rows()]
    )


def test_targets_are_poses_of_the_tip_in_the_base_frame(place, run):
    """The base and the tool in the sidecar belong to the set-up of the measurement."""
    nominal, true = place
    arm = replace(true, base=np.eye(4), tool=np.eye(4))
    targets = arm.poses(draw(nominal, 12, np.random.default_rng(3)))
    write_targets(targets)
    said = stderr_of(run(*BASE))
    assert "targets: the tip tool0 in the root link world" in said
    assert "12 of 12 ok" in said
    assert "add --frame" not in said
    q = joint_values(nominal)
    np.testing.assert_allclose(arm.poses(q), targets, atol=1e-9)
    sent = np.array([[float(row[f"{axis}[mm]"]) for axis in "xyz"] for row in rows()]) / 1e3
    np.testing.assert_allclose(sent, nominal.poses(q)[:, :3, 3], atol=1e-12)
    # The corrections are those of errors of a few millimetres and degrees.
    assert 1e-3 < np.linalg.norm(sent - targets[:, :3, 3], axis=1).min()
    assert np.linalg.norm(sent - targets[:, :3, 3], axis=1).max() < 0.1


@pytest.mark.parametrize("estimated", ["base and the tool", "base", "tool", ""])
def test_errors_that_unknown_frames_leave_are_stated(estimated, tmp_path, monkeypatch, run):
    """Targets in the root link are missed where base or tool were estimated, others are not."""
    monkeypatch.chdir(tmp_path)
    rng, nominal = np.random.default_rng(7), ROBOTS["ur5"]()
    Path("ur5.urdf").write_bytes(nominal.urdf.data)
    names = [name for name in ("base", "tool") if name in estimated]
    base, tool = (
        se3.exp6(0.2 * rng.normal(size=6)) if name in names else np.eye(4) for name in ("base", "tool")
    )
    errors = select_parameters(nominal, "placement")
    size = np.array([1e-3 if p.unit == "m" else 3e-3 for p in errors.parameters])
    true = errors.at(size * rng.normal(size=len(size))).with_base_and_tool(base, tool)
    data = Pose.simulate(true, draw(nominal, 100, rng), Noise(2e-5, 2e-5), rng)
    write_urdf(calibrate(nominal, data, ["placement", *names], extend="none").chain, "true.urdf")
    missed = {}
    for frame, arm in (("base", true.with_base_and_tool(np.eye(4), np.eye(4))), ("measuring", true)):
        targets = arm.poses(0.8 * draw(nominal, 20, rng))
        write_targets(targets)
        said = " ".join(stderr_of(run(*BASE, "--frame", frame, "--verbose")).split())
        assert ("larger than it states" in said) == bool(names and frame == "base")
        assert (f"estimated the {estimated}, and does not show" in said) == bool(names and frame == "base")
        is_reached = [row["status"] != "out of reach" for row in rows()]
        assert sum(is_reached) >= 18
        q = joint_values(nominal)[is_reached]
        distances = np.linalg.norm(arm.poses(q)[:, :3, 3] - targets[is_reached, :3, 3], axis=1)
        missed[frame] = np.sqrt(np.mean(distances**2))
    assert missed["measuring"] < 5e-5
    assert (missed["base"] > 20 * missed["measuring"]) == bool(names)


@pytest.mark.parametrize(("name", "root"), [("ur5", "world"), ("sim_6dof", "base_link")])
def test_a_world_joint_changes_no_result(name, root, tmp_path, monkeypatch, run):
    """The root of the UR5 is `world` already, whose joint takes up the base; the other arm has a new one."""
    monkeypatch.chdir(tmp_path)
    nominal, rng = ROBOTS[name](), np.random.default_rng(4)
    Path("arm.urdf").write_bytes(nominal.urdf.data)
    true, base = wrong(nominal, rng), se3.exp6([2.1, -1.4, 0.35, 0.1, -0.2, 1.1])
    write_urdf(true, "true.urdf")
    Path("true.urdf").write_bytes(with_world(Path("true.urdf").read_bytes(), base))
    placed = Chain.from_urdf("true.urdf", nominal.tip)
    assert (nominal.urdf.root, placed.urdf.root) == (root, "world")
    q = draw(nominal, 12, rng)
    targets = true.poses(q)
    expected = compensate(nominal, true, targets, q)
    assert "ok" in expected.status
    assert compensate(nominal, placed, base @ targets, q).status == expected.status
    arguments = ("compensate", "arm.urdf", "true.urdf", "targets.csv", "--tip", nominal.tip, "-o", "out.csv")
    for frame, poses in (("base", targets), ("measuring", base @ targets)):
        write_targets(poses)
        said = stderr_of(run(*arguments, "--frame", frame))
        assert f"the root link {root}" in said or frame == "measuring"
        np.testing.assert_allclose(placed.poses(joint_values(nominal)), base @ targets, atol=1e-9)


def test_targets_in_the_wrong_frame_are_hinted_at(place, run):
    nominal, true = place
    Path("true.calibration.toml").write_text("[base]\nxyz_m = [5.0, 0.0, 0.0]\n")
    far = replace(true, base=se3.transform(np.eye(3), [5.0, 0, 0]), tool=np.eye(4))
    write_targets(far.poses(draw(nominal, 5, np.random.default_rng(3))))
    assert "hint: are the targets in the measuring frame" in stderr_of(run(*BASE))
    said = stderr_of(run(*BASE, "--frame", "measuring"))
    assert "targets: the measured point in the measuring frame" in said
    assert "5 of 5 ok" in said


@pytest.mark.parametrize(("stated", "unit"), [("m", "mm"), ("mm", "m")])
def test_another_unit_is_suggested_if_the_targets_are_then_reached(place, run, stated, unit):
    nominal, true = place
    poses = replace(true, base=np.eye(4), tool=np.eye(4)).poses(draw(nominal, 8, np.random.default_rng(3)))
    hint = f"hint: most targets are reached if they are in {unit}; check the units in the header"
    for offset, is_hinted in ((0.0, True), (50.0, False)):
        moved = poses + se3.translation([offset, 0, 0]) - np.eye(4)
        moved[:, :3, 3] *= 1.0 if unit == "mm" else 1e-3
        write_targets(moved)
        text = Path("targets.csv").read_text()
        Path("targets.csv").write_text(text.replace("[mm]", f"[{stated}]"))
        assert (hint in stderr_of(run(*BASE))) == is_hinted


def link_in_tip(chain, name):
    """Pose of a link in the tip, by Pinocchio."""
    data = chain.model.createData()
    pin.framesForwardKinematics(chain.model, data, pin.neutral(chain.model))
    link, tip = (data.oMf[chain.model.getFrameId(n, pin.FrameType.BODY)] for n in (name, chain.tip))
    return (tip.inverse() * link).homogeneous


@pytest.mark.parametrize("tcp", ["ee_link", "tcp.toml", "tool.calibration.toml"])
def test_tcp_is_a_link_or_a_file(place, tcp):
    """A link of the URDF, a file with the pose, and the tool of a sidecar."""
    nominal, true = place
    pose, nominal_pose = (link_in_tip(chain, "ee_link") for chain in (true, nominal))
    if tcp != "ee_link":
        pose = nominal_pose = se3.exp6([0.1, -0.02, 0.15, 0.3, 0.1, -0.2])
        content = f"xyz_m = {pose[:3, 3].tolist()}\nrotvec_rad = {se3.log3(pose[:3, :3]).tolist()}\n"
        Path(tcp).write_text(content if tcp == "tcp.toml" else f"[tool]\n{content}")
    arm = replace(true, base=np.eye(4), tool=pose)
    targets = arm.poses(draw(nominal, 6, np.random.default_rng(4)))
    write_targets(targets)
    assert main.main([*BASE, "--tcp", tcp]) == 0
    np.testing.assert_allclose(arm.poses(joint_values(nominal)), targets, atol=1e-9)
    sent = np.array([[float(row[f"{axis}[mm]"]) for axis in "xyz"] for row in rows()]) / 1e3
    np.testing.assert_allclose(
        sent, replace(nominal, tool=nominal_pose).poses(joint_values(nominal))[:, :3, 3], atol=1e-12
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--tcp", "nothing"], ["--tcp nothing", "link", "TOML"]),
        (["--tcp", "forearm_link"], ["'forearm_link'", "fixed to the tip"]),
        (["--tcp", "empty.toml"], ["empty.toml", "xyz_m"]),
        (["--frame", "tracker"], ["--frame", "base", "measuring"]),
        (["--export", "moves.txt"], ["moves.txt", ".script", ".trajectory.csv", ".robodk.csv"]),
        (["--export", "targets.csv.script/x.script"], ["no folder"]),
        (["--joint-units", "turns"], ["--joint-units", "deg"]),
    ],
)
def test_invalid_options_are_refused(place, capsys, options, words):
    nominal, _ = place
    write_targets(nominal.poses(np.zeros((1, 6))))
    Path("empty.toml").write_text("a = 1\n")
    try:
        status = main.main([*BASE, *options])
    except SystemExit as stop:
        status = stop.code
    said = capsys.readouterr().err
    assert (status, said.count("\n")) == (2, 1)
    for word in words:
        assert word in said
    assert not Path("out.csv").exists()


def test_exchanged_robots_are_noticed(place, capsys):
    nominal, _ = place
    write_targets(nominal.poses(draw(nominal, 2, np.random.default_rng(5))))
    exchanged = ["compensate", "true.urdf", "ur5.urdf", *BASE[3:]]

    def warning(command):
        assert main.main([*command, "--verbose"]) == 0
        return [line for line in capsys.readouterr().err.splitlines() if "look exchanged" in line]

    assert warning([*BASE]) == []
    (line,) = warning(exchanged)
    assert "true.urdf: warning:" in line
    assert "it has a sidecar, and ur5.urdf has none" in line
    # Copies without their sidecars: the digits of the joint origins decide.
    Path("true.calibration.toml").unlink()
    assert warning([*BASE]) == []
    (line,) = warning(exchanged)
    assert "all digits of a calibration" in line
    # Somebody has rounded the calibrated file; the nominal one has a quarter turn with all digits.
    text = Path("true.urdf").read_text()
    Path("true.urdf").write_text(re.sub(r"-?\d+\.\d{7,}", lambda number: f"{float(number[0]):.6f}", text))
    assert warning([*BASE]) == []


def test_the_same_robot_twice_is_noticed(place, run):
    nominal, _ = place
    write_targets(nominal.poses(draw(nominal, 2, np.random.default_rng(5))))
    said = stderr_of(run("compensate", "ur5.urdf", "ur5.urdf", *BASE[3:]))
    assert "both robots have the same joint origins" in said
    assert "same joint origins" not in stderr_of(run(*BASE))


def test_joint_positions_in_degrees(place):
    nominal, _ = place
    write_targets(nominal.poses(draw(nominal, 3, np.random.default_rng(6))))
    assert main.main(BASE) == 0
    radians = joint_values(nominal)
    assert main.main([*BASE, "--joint-units", "deg"]) == 0
    np.testing.assert_allclose(np.radians(joint_values(nominal, "deg")), radians, rtol=1e-14)


def test_exports_move_the_arm_to_the_targets_that_it_reaches(place, run):
    nominal, true = place
    poses = replace(true, base=np.eye(4), tool=np.eye(4)).poses(draw(nominal, 5, np.random.default_rng(7)))
    poses[2, 0, 3] += 9.0
    write_targets(poses)
    files = ["moves.script", "moves.trajectory.csv", "moves.robodk.csv"]
    said = stderr_of(run(*BASE, *(word for file in files for word in ("--export", file))))
    assert all(f"wrote {file}" in said for file in files)
    q = np.array(
        [
            [float(row[f"{name}[rad]"]) for name in nominal.joint_names]
            for row in rows()
            if row["status"] == "ok"
        ]
    )
    assert len(q) == 4
    script = Path("moves.script").read_text()
    moves = [line for line in script.splitlines() if "movej" in line]
    found = np.array([re.findall(r"-?\d+\.\d+(?:e-\d+)?", line) for line in moves], float)
    np.testing.assert_allclose(found, q, atol=1e-9)
    assert re.findall("# target (\\d)", script) == ["1", "2", "4", "5"]
    with open("moves.robodk.csv", newline="") as file:
        table = list(csv.DictReader(file))
    degrees = np.array([[float(row[f"J{i}"]) for i in range(1, 7)] for row in table])
    np.testing.assert_allclose(np.radians(degrees), q, atol=1e-9)
    xyz = np.array([[float(row[key]) for key in "XYZ"] for row in table])
    np.testing.assert_allclose(xyz / 1e3, nominal.poses(q)[:, :3, 3], atol=1e-9)


def test_exports_without_a_target_are_refused(place, run):
    nominal, _ = place
    poses = nominal.poses(np.zeros((1, 6)))
    poses[0, 0, 3] = 9.0
    write_targets(poses)
    assert "no target is reached" in error_of(run(*BASE, "--export", "moves.script"))
    assert not Path("out.csv").exists()


def test_missing_conditions_are_named(place, capsys):
    """A joint with a backlash of 10 mrad lags by 5 mrad, if the targets state its direction."""
    _, true = place
    sidecar = Path("true.calibration.toml")
    sidecar.write_text(f"{sidecar.read_text()}\n[joint.elbow_joint]\nbacklash_rad = 0.01\n")
    target = true.poses(np.array([[0.3, -1.2, 1.4, -0.6, 0.8, 0.2]]))[0, :3, 3]
    values = ",".join(f"{1e3 * value:.6f}" for value in target)
    for column, value, lag in (("", "", 0.0), (",approach_elbow_joint", ",1", 0.005)):
        Path("targets.csv").write_text(f"x[mm],y[mm],z[mm]{column}\n{values}{value}\n")
        assert main.main((*COMMAND, "--json", "-")) == 0
        said = capsys.readouterr()
        is_missing = any("add the column approach_JOINT" in text for text in json.loads(said.out)["warnings"])
        assert is_missing == (not column)
        assert ("approach_JOINT" in said.err) == (not column)
        q = np.array([[float(rows()[0][f"{name}[rad]"]) for name in true.joint_names]])
        reached = true.poses(q - lag * np.eye(6)[2])[0, :3, 3]
        np.testing.assert_allclose(reached, target, atol=1e-7)
