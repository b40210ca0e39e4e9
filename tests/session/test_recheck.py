"""Checks of calibrated arms, simulated with Pinocchio and NumPy only, against the change that was made."""

import json
from collections import Counter
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from command_line import error_of, json_of
from robots import ARMS, nominal_arm, robot_file
from sessions import ANGLE_NOISE, NOISE, Simulation
from slow_cases import some_slow

from dhcal_pin import Result, calibrate, select_parameters
from dhcal_pin.cli.main import main
from dhcal_pin.diagnostics import find_unstated_conditions
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io import measurement_text, read_robot, read_uncertainty, write_urdf
from dhcal_pin.measurements import Inclination, Measurement, Noise, Pose, Position
from dhcal_pin.measurements.base import known_conditions
from dhcal_pin.planning import change_options, plan
from dhcal_pin.robot import Chain
from dhcal_pin.robot.conditions import Conditions
from dhcal_pin.robot.transmission import Payload
from dhcal_pin.session import Recheck, find_excess_error, recheck
from dhcal_pin.session.check import WIDTHS, _CheckModel

STILL = pin.SE3.Identity()
# A SCARA: all axes are parallel, and the third joint is a slide.
JOINTS = (
    ("j1", "revolute", "0 0 0.35", "0 0 1", -2.3, 2.3),
    ("j2", "revolute", "0.325 0 0.05", "0 0 1", -2.5, 2.5),
    ("j3", "prismatic", "0.275 0 0", "0 0 -1", 0.0, 0.2),
    ("j4", "revolute", "0 0 0", "0 0 1", -3.0, 3.0),
)
LINKS = ("base", "l1", "l2", "l3", "tcp")
SCARA = '<robot name="scara">' + "".join(f'<link name="{name}"/>' for name in LINKS)
for (name, what, xyz, axis, lower, upper), parent, child in zip(JOINTS, LINKS[:-1], LINKS[1:], strict=True):
    SCARA += (
        f'<joint name="{name}" type="{what}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/></joint>'
    )
SCARA += "</robot>"
LENGTH, ANGLE = 5e-4, np.deg2rad(0.05)
CHANGES = ("nothing", "joint", "base", "tool")


def measured(
    sim: Simulation,
    q: np.ndarray,
    kind: type[Measurement],
    is_stated: bool,
    *,
    base=STILL,
    tool=STILL,
    zeros: np.ndarray | float = 0.0,
) -> Measurement:
    """Measure an arm after changes of base, tool and joint zeros."""
    poses = [sim.base * base * arm * sim.tool * tool for arm in sim.poses(q + zeros)]
    positions = np.array([pose.translation for pose in poses]) + sim.rng.normal(0, NOISE, (len(q), 3))
    if kind is Position:
        return Position(q, positions, NOISE if is_stated else None)
    turned = [pose.rotation @ pin.exp3(sim.rng.normal(0, ANGLE_NOISE, 3)) for pose in poses]
    matrices = np.array([pin.SE3(r, p).homogeneous for r, p in zip(turned, positions, strict=True)])
    return Pose(q, matrices, *((NOISE, ANGLE_NOISE) if is_stated else (None, None)))


def calibrated(arm: str, seed: int, kind: type[Measurement]) -> tuple[Simulation, Result, np.ndarray]:
    """Return an arm whose noise does not depend on other tests, its calibration, and poses for a check."""
    found = _calibrated(arm, seed, kind)
    found[0].rng = np.random.default_rng((seed, 1))
    return found


@cache
def _calibrated(arm: str, seed: int, kind: type[Measurement]) -> tuple[Simulation, Result, np.ndarray]:
    """Return an arm, its calibration, and ten poses that are chosen for a check."""
    sim = Simulation(arm, 60, seed)
    fit = calibrate(sim.chain, measured(sim, sim.q, kind, True), extend="none", session="off")
    noise = Noise(NOISE, ANGLE_NOISE)
    options = change_options(fit.chain)
    q = plan(fit.chain, 10, kind=kind.kind, noise=noise, candidates=300, **options).q
    return sim, fit, q


def changed(sim: Simulation, what: str) -> tuple[dict, str]:
    """Draw a change; return it and its name."""
    if what in ("base", "tool"):
        return {what: pin.SE3(np.eye(3), LENGTH * sim.direction())}, what
    joint = int(sim.rng.integers(sim.chain.n_joints))
    zeros = np.zeros(sim.chain.n_joints)
    if what == "joint":
        zeros[joint] = ANGLE * sim.rng.choice([-1, 1])
    return {"zeros": zeros}, sim.chain.joint_names[joint] if what == "joint" else ""


def is_right(result: Recheck, name: str) -> bool:
    """Return whether the answer is the change, alone or with another one that has the same effect."""
    if not name:
        return result.verdict == "ok"
    return result.verdict == "changed" and name in [each.of or each.kind for each in result.changes]


def shares(arms, seeds, kind: type[Measurement], is_stated: bool) -> dict[str, float]:
    """Return the share of right answers by what changed."""
    right, count = Counter(), 0
    for arm, seed in product(arms, seeds):
        sim, fit, q = calibrated(arm, seed, kind)
        count += 1
        for what in CHANGES:
            keywords, name = changed(sim, what)
            data = measured(sim, q, kind, is_stated, **keywords)
            right[what] += is_right(recheck(fit.chain, [data], fit.uncertainty), name)
    return {what: right[what] / count for what in CHANGES}


@pytest.mark.parametrize(("kind", "is_stated"), [(Position, True), (Pose, True), (Pose, False)])
def test_changes_are_named(kind, is_stated):
    found = shares(["ur10"], range(2), kind, is_stated)
    assert sum(found.values()) >= 3.5, found


@pytest.mark.slow
@pytest.mark.parametrize("is_stated", [True, False], ids=["stated", "estimated"])
@pytest.mark.parametrize("kind", [Position, Pose])
def test_changes_are_named_in_many_arms(kind, is_stated):
    found = shares(["ur10", "ur5", "panda", "xarm7"], range(50, 57), kind, is_stated)
    # One false alarm among 28 arms may be chance.
    assert found["nothing"] >= 0.96, found
    assert np.mean([found[what] for what in CHANGES[1:]]) >= 0.9, found


def test_large_changes_have_the_right_size():
    sim, fit, q = calibrated("ur10", 7, Position)
    zeros = np.zeros(6)
    zeros[2] = np.deg2rad(3.0)
    result = recheck(fit.chain, [measured(sim, q, Position, True, zeros=zeros)], fit.uncertainty)
    first = result.changes[0]
    assert first.of == sim.chain.joint_names[2]
    assert abs(first.size - zeros[2]) < 4 * first.std + 1e-6
    # Its standard deviation is that of the noise alone, and of the uncertainty of the calibrated arm.
    step = 1e-5 * np.eye(6)[2]
    before, after = (
        np.array([(pose * sim.tool).translation for pose in sim.poses(q + zeros + k * step)]) for k in (-1, 1)
    )
    of_noise = NOISE / np.linalg.norm((after - before) / 2e-5)
    assert of_noise <= first.std < 1.5 * of_noise
    moved = pin.SE3(np.eye(3), np.array([0.03, -0.04, 0.0]))
    result = recheck(fit.chain, [measured(sim, q, Position, True, base=moved)], fit.uncertainty)
    first = result.changes[0]
    assert first.kind == "base"
    assert abs(first.size - 0.05) < 4 * first.std + 1e-5
    assert result.reasons[0].startswith("The base or the instrument moved by ")
    assert result.reasons[0].endswith(", as after a new set-up of the instrument.")


@pytest.mark.parametrize("kind", [Position, Pose])
def test_an_instrument_at_any_place_is_no_changed_robot(kind):
    """Where the instrument stands and how it is turned does not matter, also if the turn is nearly 180°."""
    sim, fit, q = calibrated("ur10", 3, kind)
    rng = np.random.default_rng(1)
    for angle in (60, 120, 150, 165, 172, 176, 178, 179.5):
        axis = rng.standard_normal(3)
        turn = pin.exp3(np.deg2rad(angle) * axis / np.linalg.norm(axis))
        data = measured(sim, q[:8], kind, True, base=pin.SE3(turn, rng.normal(0, 2, 3)))
        result = recheck(fit.accepted.chain, [data], fit.uncertainty)
        assert (result.verdict, result.what) == ("changed", "base"), angle
        assert "The arm itself did not change" in result.reasons[1]


def test_a_turn_about_the_first_axis_names_joint_and_base():
    sim, fit, q = calibrated("ur10", 7, Position)
    zeros = np.zeros(6)
    zeros[0] = ANGLE
    result = recheck(fit.chain, [measured(sim, q, Position, True, zeros=zeros)], fit.uncertainty)
    assert [each.of or each.kind for each in result.changes] == [sim.chain.joint_names[0], "base"]


def test_a_rotation_of_the_tool_that_was_never_measured_is_no_change(tmp_path):
    """The tool moved during the measurement of a point of it: the fit holds its rotation."""
    sim = Simulation("ur10", 60, 3)
    moved = pin.SE3(np.eye(3), np.array([0.002, -0.001, 0.0]))
    q = np.split(sim.q, 2)
    halves = [measured(sim, q[i], Position, True, tool=tool) for i, tool in enumerate((moved, STILL))]
    data = Position(sim.q, np.concatenate([half.positions() for half in halves]), NOISE)
    fit = calibrate(sim.chain, data, extend="none")
    assert fit.session is not None
    assert [cause.block.kind for cause in fit.session.causes] == ["tool"]
    write_urdf(fit, tmp_path / "cal.urdf")
    uncertainty = read_uncertainty(
        tmp_path / "cal.calibration.toml", read_robot(tmp_path / "cal.urdf", "tool0")
    )
    turned = pin.SE3(pin.exp3(np.array([0.02, 0.0, 0.0])), np.zeros(3))
    q = sim.q[::6]
    for each in (fit.uncertainty, uncertainty):
        assert recheck(fit.chain, [measured(sim, q, Pose, True, tool=turned)], each).verdict == "ok"
    changed_joint = measured(sim, q, Pose, True, tool=turned, zeros=2 * ANGLE * np.eye(6)[2])
    assert recheck(fit.chain, [changed_joint], uncertainty).what == f"joint {sim.chain.joint_names[2]}"


def test_it_cannot_say():
    sim, fit, q = calibrated("ur10", 7, Position)
    few = recheck(fit.chain, [measured(sim, q[:3], Position, True)], fit.uncertainty)
    assert (few.verdict, few.changes) == ("cannot say", ())
    data = measured(sim, q, Position, True)
    data.positions()[4] += [0.003, 0.0, 0.0]
    wrong = recheck(fit.chain, [data], fit.uncertainty)
    assert wrong.verdict == "cannot say"
    assert "measure it again" in wrong.reasons[0]
    assert (wrong.hypotheses[0].kind, wrong.hypotheses[0].of) == ("sample", "5")
    good = measured(sim, q, Position, True)
    noisy = recheck(fit.chain, [good], fit.uncertainty, noise=Noise(2e-3))
    assert noisy.verdict == "cannot say"
    assert "would be revealed" in noisy.reasons[0]
    with pytest.raises(InvalidArgumentError, match="expected position or pose"):
        recheck(fit.chain, [Inclination.simulate(fit.chain, q, Noise(0, 1e-4), sim.rng)], fit.uncertainty)


def test_command(tmp_path: Path, run, capsys):
    sim, fit, q = calibrated("ur10", 7, Position)
    robot, history = tmp_path / "cal.urdf", tmp_path / "h.jsonl"
    write_urdf(fit, robot)
    zeros = np.zeros(6)
    for name, status in (("ok", 0), ("changed", 1)):
        data = tmp_path / f"{name}.csv"
        data.write_text(measurement_text(measured(sim, q, Position, True, zeros=zeros), fit.chain, []))
        args = ["recheck", str(robot), str(data), "--tip", "tool0", "--history", str(history)]
        assert main([*args, "--plot", str(tmp_path / "h.html"), "--json", "-"]) == status
        answer = json.loads(capsys.readouterr().out)
        assert answer["verdict"] == name
        zeros[3] = 0.002
    lines = [json.loads(line) for line in history.read_text().splitlines()]
    assert [line["verdict"] for line in lines] == ["ok", "changed"]
    assert lines[1]["what"] == "joint wrist_1_joint"
    assert abs(lines[1]["size"] - 0.002) < 4 * lines[1]["std"]
    assert "joint wrist_1_joint" in (tmp_path / "h.html").read_text()
    history.write_text(history.read_text() + "{}\n")
    before = history.read_text()
    assert f"{history}:3: time is missing" in error_of(run(*args))
    assert history.read_text() == before
    history.write_text("[" * 10**5)
    assert f"{history}:1: not JSON" in error_of(run(*args))
    history.unlink()
    joints = ",".join(f"{name}[rad]" for name in fit.chain.joint_names)
    data.write_text(f"{joints},corner,u[px],v[px]\n0,0,0,0,0,0,1,2,3\n")
    assert f"{data}: recheck does not use images; expected positions or poses" in error_of(run(*args))
    (tmp_path / "cal.calibration.toml").unlink()
    assert "no sidecar" in error_of(run(*args))


@pytest.mark.parametrize("arm", ["ur10", "panda"])
def test_a_new_base_does_not_hide_a_changed_zero(arm):
    """The instrument was set up anew, and the zero of a joint is off by 5 mrad."""
    sim, fit, q = calibrated(arm, 7, Position)
    new = pin.SE3(pin.exp3(np.array([0.4, -0.8, 0.5])), np.array([0.6, -0.7, 0.3]))
    for joint in range(1, 4):
        zeros = 5e-3 * np.eye(sim.chain.n_joints)[joint]
        data = measured(sim, q, Position, True, base=new, zeros=zeros)
        result = recheck(fit.chain, [data], fit.uncertainty)
        assert (result.verdict, result.what) == ("changed", f"base and joint {sim.chain.joint_names[joint]}")
        assert abs(result.changes[1].size - 5e-3) < 4 * result.changes[1].std
        assert abs(result.changes[0].angle - np.linalg.norm([0.4, -0.8, 0.5])) < 1e-3
    result = recheck(fit.chain, [measured(sim, q, Position, True, base=new)], fit.uncertainty)
    assert result.what == "base"
    # The arm itself is said to be unchanged, as its residuals are those of the noise.
    assert abs(result.changes[0].size - np.linalg.norm(new.translation)) < 1e-3
    assert "and turned by 58.7" in result.reasons[0]
    assert result.reasons[1].startswith(
        "The arm itself did not change: with the new base the positions differ"
    )


@pytest.mark.parametrize("n_seeds", some_slow([1, 4], {0}))
@pytest.mark.parametrize("angle", [0.1, 0.3])
def test_a_changed_zero_beside_a_new_base_is_found_without_stated_noise(angle, n_seeds):
    """Eight poses: a fit of the base alone leaves residuals that are larger than those of the calibration."""
    sim, fit, _ = calibrated("ur10", 7, Position)
    new = pin.SE3(pin.exp3(np.array([0.4, -0.8, 0.5])), np.array([0.6, -0.7, 0.3]))
    zeros = np.deg2rad(angle) * np.eye(6)[2]
    for seed in range(n_seeds):
        q = np.random.default_rng(seed).uniform(-2.5, 2.5, (8, 6))
        data = measured(sim, q, Position, False, base=new, zeros=zeros)
        result = recheck(fit.chain, [data], fit.uncertainty)
        assert result.what == "base and joint elbow_joint"
        assert abs(result.changes[1].size - zeros[2]) < 5 * result.changes[1].std
        unchanged = recheck(fit.chain, [measured(sim, q, Position, False, base=new)], fit.uncertainty)
        assert unchanged.what == "base"
        assert unchanged.reasons[1].startswith("The arm itself did not change")


@pytest.mark.parametrize("n_seeds", some_slow([2, 4], {0}))
def test_what_remains_beside_a_named_change_is_no_single_second_change(n_seeds):
    sim, fit, _ = calibrated("ur10", 7, Position)
    new = pin.SE3(pin.exp3(np.array([0.4, -0.8, 0.5])), np.array([0.6, -0.7, 0.3]))
    zeros = np.deg2rad([0.0, 0.15, -0.2, 0.3, 0.2, 0.0])
    for seed in range(n_seeds):
        q = np.random.default_rng(seed).uniform(-2.5, 2.5, (7, 6))
        data = measured(sim, q, Position, False, base=new, zeros=zeros)
        result = recheck(fit.chain, [data], fit.uncertainty)
        assert not any(change.kind == "joint" for change in result.changes)
        assert "did not change" not in " ".join(result.reasons)


def test_residuals_that_noise_does_not_explain_are_not_ok():
    """The origin of the last joint moved by 0.7 mm, and no noise is stated."""
    sim, fit, _ = calibrated("ur10", 7, Position)
    q = sim.test_q[:12]
    bent = sim.model.copy()
    bent.jointPlacements[sim.ids[5]] *= pin.SE3(np.eye(3), np.array([0.0, 0.0, 7e-4]))
    points = np.array([(sim.base * arm * sim.tool).translation for arm in sim.poses(q, bent)])
    data = Position(q, points + sim.rng.normal(0, NOISE, points.shape))
    found = recheck(fit.chain, [data], fit.uncertainty)
    assert (found.verdict, found.changes) == ("cannot say", ())
    assert "state their noise by `--sigma`" in found.reasons[0]
    assert found.residual_rms > 4 * found.expected_rms
    # The remedy decides it, and the answer that is promised is given.
    stated = recheck(fit.chain, [data], fit.uncertainty, noise=Noise(NOISE))
    assert (stated.verdict, stated.what) == ("changed", "robot")
    assert found.reasons[1].endswith(f"`changed`: {stated.reasons[0]}")
    # A noise that is larger by far explains it, with a distance that the residuals do not contradict.
    noisy = recheck(fit.chain, [data], fit.uncertainty, noise=Noise(3e-4), size=2e-3)
    assert noisy.verdict == "ok"
    assert stated_distance(noisy) > found.residual_rms / 2
    # Without a calibration's noise, the residuals may be a change or noise.
    unknown = recheck(fit.chain, [data], None, size=2e-3)
    assert (unknown.verdict == "ok") <= (stated_distance(unknown) >= 0.99 * unknown.residual_rms)
    assert recheck(fit.chain, [data], None, size=0.5 * unknown.residual_rms).verdict != "ok"


def stated_distance(result: Recheck) -> float:
    """Return the distance that a check excludes [m]."""
    return 1e-3 * float(result.reasons[0].split("more than ")[1].split(" mm")[0])


def test_a_noise_that_is_larger_than_stated_is_not_ok():
    """Errors of twice the stated noise, equal in size, so that no single sample is far from the others."""
    sim, fit, _ = calibrated("ur10", 7, Position)
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        q, errors = rng.uniform(-2.5, 2.5, (40, 6)), rng.standard_normal((40, 3))
        errors *= 3.5 * NOISE / np.linalg.norm(errors, axis=1, keepdims=True)
        points = np.array([(sim.base * arm * sim.tool).translation for arm in sim.poses(q)])
        found.append(recheck(fit.chain, [Position(q, points + errors, NOISE)], fit.uncertainty))
    assert not any(result.verdict == "ok" for result in found)
    assert any("Either the noise is larger" in result.reasons[0] for result in found)


@pytest.mark.parametrize("n_seeds", some_slow([2, 12], {0}))
@pytest.mark.parametrize("kind", [Position, Pose])
@pytest.mark.parametrize("factor", [2, 3])
def test_noise_that_the_calibration_showed_is_no_change_whatever_is_stated(factor, kind, n_seeds):
    """Stated standard deviations are too small, at the calibration and at the check."""

    def state(data):
        names = ("sigma", "rotation_sigma") if kind is Pose else ("sigma",)
        return data.replace(**{name: getattr(data, name) / factor for name in names})

    for arm, seed in product(("ur10", "panda"), range(n_seeds)):
        sim = Simulation(arm, 60, seed)
        data = state(measured(sim, sim.q, kind, True))
        fit = calibrate(sim.chain, data, extend="none", session="off")
        q = sim.rng.uniform(-1.5, 1.5, (10, sim.chain.n_joints))
        for what in ("nothing", "base"):
            keywords, name = changed(sim, what)
            check = state(measured(sim, q, kind, True, **keywords))
            assert is_right(recheck(fit.chain, [check], fit.uncertainty), name)


@pytest.mark.parametrize("n_seeds", some_slow([3, 30], {0}))
@pytest.mark.parametrize(
    ("factor", "verdicts"), [(1, {"ok"}), (2, {"ok", "cannot say"}), (5, {"cannot say"})]
)
def test_more_noise_than_that_of_the_calibration_is_no_change(factor, verdicts, n_seeds):
    """An unchanged arm, measured by another instrument whose noise is not stated."""
    sim, fit, _ = calibrated("ur10", 7, Position)
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        data = measured(sim, rng.uniform(-2.5, 2.5, (12, 6)), Position, False)
        more = NOISE * np.sqrt(factor**2 - 1)
        noisy = Position(data.conditions().q, data.positions() + rng.normal(0, more, (12, 3)))
        found = recheck(fit.chain, [noisy], fit.uncertainty)
        assert found.verdict in verdicts
        if found.verdict == "ok":
            assert stated_distance(found) >= 0.99 * found.residual_rms


@pytest.mark.parametrize("n_seeds", some_slow([2, 20], {0}))
@pytest.mark.parametrize("size", [8e-4, 2e-3])
def test_an_instrument_that_moved_during_the_check_is_named_with_its_line(size, n_seeds):
    sim, fit, _ = calibrated("ur10", 7, Position)
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        first = int(rng.integers(4, 9))
        data = measured(sim, rng.uniform(-2.5, 2.5, (12, 6)), Position, True)
        data.positions()[first:] += size * sim.direction()
        found = recheck(fit.chain, [data], fit.uncertainty)
        assert (found.verdict, found.what) == ("changed", f"base from sample {first + 1} on")
        (change,) = found.changes
        assert abs(change.size - size) < 4 * change.std
        assert found.reasons[0].endswith(f" from sample {first + 1} on.")
        assert "the samples fit to the calibrated arm" in found.reasons[1]
        # The remedy: what was measured before and after has one base each.
        rest = measured(sim, data.conditions().q, Position, True)
        assert recheck(fit.chain, [rest], fit.uncertainty).verdict == "ok"


@pytest.mark.parametrize("n_seeds", some_slow([2, 20], {0}))
def test_changes_of_the_arm_are_no_motion_of_the_instrument(n_seeds):
    """Two zeros, or the origin of a joint, changed before the check."""
    sim, fit, _ = calibrated("ur10", 7, Position)
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-2.5, 2.5, (12, 6))
        zeros = 2e-3 * np.isin(np.arange(6), rng.choice(np.arange(1, 5), 2, replace=False))
        bent = sim.model.copy()
        shift = pin.SE3(np.eye(3), 1e-3 * sim.direction())
        bent.jointPlacements[sim.ids[int(rng.integers(1, 6))]] *= shift
        points = np.array([(sim.base * arm * sim.tool).translation for arm in sim.poses(q, bent)])
        for data in (
            measured(sim, q, Position, True, zeros=zeros),
            Position(q, points + rng.normal(0, NOISE, points.shape), NOISE),
        ):
            found = recheck(fit.chain, [data], fit.uncertainty)
            assert found.verdict != "ok"
            assert "the samples fit to the calibrated arm" not in " ".join(found.reasons)


def with_shifted_origin(sim, q, kind, joint, shift, **changes) -> Measurement:
    """Measure an arm of which the origin of a joint moved."""
    own, sim.model = sim.model, sim.model.copy()
    sim.model.jointPlacements[sim.ids[joint]] *= pin.SE3(np.eye(3), np.asarray(shift))
    data = measured(sim, q, kind, True, **changes)
    sim.model = own
    return data


@pytest.mark.parametrize(
    "base", [STILL, pin.SE3(pin.exp3(np.array([0, 0.01, 0.015])), np.array([0.01, 0, 0]))]
)
@pytest.mark.parametrize("kind", [Position, Pose])
@pytest.mark.parametrize("seeds", some_slow([range(1), range(1, 6)], {0}))
def test_motions_along_parallel_axes_that_cancel_each_other_are_not_named(
    kind, seeds, base, tmp_path, monkeypatch
):
    """The origin of a joint of a SCARA moved by 0.3 mm; "the base moved by 50 mm, the tool by 50 mm"."""
    (tmp_path / "scara.urdf").write_text(SCARA)
    monkeypatch.setitem(ARMS, "scara", (str(tmp_path / "scara.urdf"), "tcp"))
    for seed, joint, axis in product(seeds, range(1, 4), range(2)):
        sim, fit, q = calibrated("scara", seed, kind)
        data = with_shifted_origin(sim, q, kind, joint, 3e-4 * np.eye(3)[axis], base=base)
        found = recheck(fit.chain, [data], fit.uncertainty)
        assert found.verdict != "ok"
        assert all(each.unit == "rad" or abs(each.size) < 0.03 for each in found.changes), found.reasons


@pytest.mark.parametrize("n_seeds", some_slow([1, 8], {0}))
@pytest.mark.parametrize(("arm", "kind"), [("ur10", Position), ("panda", Pose)])
def test_a_moved_origin_is_not_blamed_on_a_sample(arm, kind, n_seeds):
    """Measured again, another sample did not fit to the others."""
    for seed, joint, axis in product(range(n_seeds), (2, 4), range(3)):
        sim, fit, q = calibrated(arm, seed, kind)
        data = with_shifted_origin(sim, q, kind, joint, 3e-4 * np.eye(3)[axis])
        reasons = " ".join(recheck(fit.chain, [data], fit.uncertainty).reasons)
        assert "measure it again" not in reasons
        assert "sample" not in reasons.replace("These samples", "")


@pytest.mark.parametrize("n_seeds", some_slow([2, 20], {0}))
@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_a_wrong_sample_is_blamed_beside_a_changed_zero_too(angle, n_seeds):
    sim, fit, q = calibrated("ur10", 7, Position)
    zeros = np.deg2rad(angle) * np.eye(6)[2]
    for seed in range(n_seeds):
        wrong = int(np.random.default_rng(seed).integers(len(q)))
        data = measured(sim, q, Position, True, zeros=zeros)
        data.positions()[wrong] += 0.02 * sim.direction()
        found = recheck(fit.chain, [data], fit.uncertainty)
        assert found.reasons[0] == f"The sample {wrong + 1} does not fit to the others; measure it again."
        # The advice: without it, the others agree with the robot or with the changed zero.
        rest = recheck(fit.chain, [data.take(np.flatnonzero(np.arange(len(q)) != wrong))], fit.uncertainty)
        assert (rest.verdict, rest.what) == (("changed", "joint elbow_joint") if angle else ("ok", ""))


def test_a_motion_during_the_check_is_named_as_possible_if_the_samples_do_not_exclude_it():
    """With two samples after it, a motion of the instrument is one of several explanations."""
    sim, fit, _ = calibrated("ur10", 7, Position)
    data = measured(sim, sim.test_q[:5], Position, True)
    data.positions()[3:] += np.array([2e-3, -1e-3, 3e-3])
    found = recheck(fit.chain, [data], fit.uncertainty)
    assert (found.verdict, found.what) == ("changed", "robot")
    assert "or the base or the instrument moved during the check, from sample 4 on." in found.reasons[0]
    zeros = np.deg2rad([0.0, 0.5, -0.4, 0.6, 0.5, 0.0])
    arm = measured(sim, sim.test_q[:10], Position, True, zeros=zeros)
    assert "instrument" not in recheck(fit.chain, [arm], fit.uncertainty).reasons[0]


@pytest.mark.parametrize("n_seeds", some_slow([1, 6], {0}))
@pytest.mark.parametrize(("arm", "kind"), [("ur10", Position), ("panda", Pose)])
def test_an_error_that_is_larger_than_that_of_the_calibration(arm, kind, n_seeds):
    """A zero that is off by 1 mrad; 8 and 14 samples, and more than a check takes."""
    for seed in range(n_seeds):
        sim, fit, _ = calibrated(arm, seed, kind)
        zeros = 1e-3 * np.eye(sim.chain.n_joints)[2]
        for count, is_stated in product((8, 14, 200), (True, False)):
            q = sim.test_q[:count]
            same = measured(sim, q, kind, is_stated)
            assert find_excess_error(fit.chain, [same], fit.uncertainty) is None
            other = measured(sim, q, kind, is_stated, zeros=zeros)
            found = find_excess_error(fit.chain, [other], fit.uncertainty)
            assert found is not None
            true = fit.chain.poses(q)[:, :3, 3] - other.positions()
            assert found[0] == pytest.approx(np.sqrt(np.mean(np.sum(true**2, 1))), rel=0.15)
            # About the noise, and the uncertainty of 60 samples.
            assert np.sqrt(3) * 0.8 * NOISE < found[1] < np.sqrt(3) * 1.7 * NOISE
        # Noise that is stated to be larger explains it.
        coarse, q = Noise(20 * NOISE, 20 * ANGLE_NOISE), sim.test_q[:14]
        other = measured(sim, q, kind, False, zeros=zeros)
        values = other.positions() if kind is Position else other.poses
        noises = (coarse.position,) if kind is Position else (coarse.position, coarse.rotation)
        assert find_excess_error(fit.chain, [kind(q, values, *noises)], fit.uncertainty) is None


def test_validate_says_that_the_error_is_larger_than_that_of_the_calibration(tmp_path: Path, capsys):
    sim, fit, _ = calibrated("ur10", 7, Position)
    robot, file = tmp_path / "cal.urdf", tmp_path / "later.csv"
    write_urdf(fit, robot)
    inside = [row for row in sim.test_q if np.abs(row).max() < 2.0][:12]
    for angle, hints in ((0.0, 0), (1.5e-3, 1)):
        zeros = angle * np.eye(6)[2]
        data = measured(sim, np.array(inside), Position, False, zeros=zeros)
        file.write_text(measurement_text(data, fit.chain, []))
        args = [str(robot), str(file), "--tip", "tool0", "--json", "-"]
        assert main(["validate", *args]) == 0
        answer = json.loads(capsys.readouterr().out)
        found = [text for text in answer["warnings"] if "times that of the calibration" in text]
        assert len(found) == hints
    ratio = float(found[0].split(" is ")[1].split(" times")[0])
    usual = float(found[0].split("calibration, ")[1].split(" mm")[0])
    assert ratio * usual == pytest.approx(1e3 * answer["after"]["position_rms_m"], rel=0.1)
    # The command that it names finds the change.
    assert main(["recheck", *args, "--sigma", "0.05mm"]) == 1
    assert json.loads(capsys.readouterr().out)["what"] == "joint elbow_joint"
    # With base and tool fitted, there is no such comparison.
    assert main(["validate", *args, "--fit-frames"]) == 0
    assert "times that of the calibration" not in capsys.readouterr().out


def test_missing_columns_are_named():
    """Elasticity needs the payload only if the calibration had several."""
    chain, _ = conditional("compliance", -3e-5)
    data = Position(np.zeros((2, 6)), np.zeros((2, 3)), NOISE)
    assert find_unstated_conditions(chain, known_conditions([data])) == []
    assert find_unstated_conditions(chain, known_conditions([data]), (5.0, 5.0)) == []
    (note,) = find_unstated_conditions(chain, known_conditions([data]), (0.0, 5.0))
    assert "the mass at the tip is not stated" in note
    assert note.endswith("add the column payload[kg]")
    stated = data.with_conditions(payload=np.array([1.0, 2.0]))
    assert find_unstated_conditions(chain, known_conditions([stated]), (0.0, 5.0)) == []
    chain, _ = conditional("thermal", 2e-5)
    assert find_unstated_conditions(chain, known_conditions([data]))[0].endswith(
        "add the column temperature[degC]"
    )


def conditional(family: str, size: float) -> tuple[Chain, np.random.Generator]:
    """Return an UR10 with errors of a family."""
    chain = nominal_arm("ur10").with_payload(Payload(5.0, (0.0, 0.0, 0.1)))
    tool = pin.SE3(np.eye(3), np.array([0.05, -0.04, 0.1])).homogeneous
    errors = select_parameters(chain.with_base_and_tool(np.eye(4), tool), family)
    return errors.at(np.full(len(errors.parameters), size)), np.random.default_rng(3)


@pytest.mark.parametrize("n_times", some_slow([2, 5], {0}))
@pytest.mark.parametrize(
    ("family", "size", "condition", "values"),
    [
        ("compliance", -3e-5, "payload", (0.0, 0.0)),
        ("compliance", -3e-5, "payload", (0.0, 10.0)),
        ("thermal", 2e-5, "temperature", (36.0, 40.0)),
    ],
)
def test_unknown_conditions_count_as_uncertainty(family, size, condition, values, n_times):
    """An arm that did not change, with a payload or temperature that is not stated."""
    chain, rng = conditional(family, size)
    for _ in range(n_times):
        q = rng.uniform(-2, 2, (12, 6))
        conditions = {condition: rng.choice(np.array(values, float), 12)}
        if condition == "temperature":
            conditions[condition] += chain.reference_temperature - 25
        points = chain.poses(Conditions(q, **conditions))[:, :3, 3] + rng.normal(0, NOISE, (12, 3))
        unstated = Position(q, points, NOISE)
        keywords = {"payloads": (0.0, 10.0), "size": 5e-3}
        assert recheck(chain, [unstated.with_conditions(**conditions)], **keywords).verdict == "ok"
        assert recheck(chain, [unstated], **keywords).verdict == "ok"
        # With one payload in the calibration, it is that of the model.
        if condition == "payload":
            assert recheck(chain, [unstated], size=5e-3).verdict != "ok"
        moved = Position(q, points + np.array([0.02, 0.0, 0.0]), NOISE)
        assert recheck(chain, [moved], **keywords).what == "base"


@pytest.mark.parametrize("n_times", some_slow([2, 20], {0}))
def test_a_payload_beyond_those_of_the_calibration_counts_as_uncertainty(n_times):
    """Its centre is 80 mm from that of the model, which has no large effect with the calibrated payloads."""
    chain, rng = conditional("compliance", -3e-5)
    true = chain.with_payload(Payload(5.0, (0.0, 0.05, 0.18)))
    keywords = {"payloads": (0.0, 3.0), "size": 5e-3}
    for _ in range(n_times):
        q, masses = rng.uniform(-2, 2, (14, 6)), np.full(14, 12.0)
        points = true.poses(Conditions(q, payload=masses))[:, :3, 3] + rng.normal(0, NOISE, (14, 3))
        data = Position(q, points, NOISE).with_conditions(payload=masses)
        assert recheck(chain, [data], **keywords).verdict == "ok"
        assert recheck(chain, [data], payloads=(0.0, 12.0), size=5e-3).verdict != "ok"
        moved = Position(q, points + np.array([0.02, 0.0, 0.0]), NOISE).with_conditions(payload=masses)
        assert recheck(chain, [moved], **keywords).what == "base"


def test_a_payload_beyond_those_of_the_calibration_is_no_mistake_of_the_file(tmp_path: Path, capsys):
    """An elastic arm that was calibrated with 0 to 5 kg, now with 10 kg in all rows."""
    chain, rng = conditional("compliance", -3e-5)
    chain = chain.with_payload(None)

    def write(name: str, count: int, masses: np.ndarray) -> str:
        q = rng.uniform(-2, 2, (count, 6))
        points = chain.poses(Conditions(q, payload=masses))[:, :3, 3] + rng.normal(0, NOISE, (count, 3))
        data = Position(q, points, NOISE).with_conditions(payload=masses)
        (tmp_path / name).write_text(measurement_text(data, chain, []))
        return str(tmp_path / name)

    fitted = write("fitted.csv", 70, rng.choice([0.0, 2.0, 5.0], 70))
    robot = str(tmp_path / "cal.urdf")
    source = str(robot_file(ARMS["ur10"][0]))
    parameters = "minimal,base,tool,compliance"
    assert main(["calibrate", source, fitted, "--tip", "tool0", "--parameters", parameters, "-o", robot]) == 0
    for mass, has_note in ((10.0, True), (5.0, False)):
        file = write(f"{mass:g}.csv", 12, np.full(12, mass))
        for command in ("recheck", "validate"):
            capsys.readouterr()
            assert main([command, robot, file, "--tip", "tool0", "--json", "-"]) == 0
            answer = json.loads(capsys.readouterr().out)
            text = " ".join(answer["warnings"])
            assert "--payload" not in text
            assert ("the payload is 10 kg in lines" in text) == has_note
            assert ("the calibration has 0 to 5 kg" in text) == has_note
            assert answer.get("verdict", "ok") == "ok" or command == "validate"


@pytest.mark.parametrize("n_known", [0, 9, 10])
def test_backlash_counts_as_uncertainty_where_directions_are_unknown(n_known):
    """An arm whose directions of motion are known in all ten samples, in all but the first, or in none."""
    sim, fit, q = calibrated("ur10", 7, Position)
    sizes = 6e-4 * np.isin(np.arange(6), [1, 2, 3])
    backlash = select_parameters(fit.chain, "backlash").at(sizes)
    directions = sim.rng.choice([-1.0, 1.0], q.shape)
    shift = -0.5 * sizes * directions
    data = measured(sim, q + shift, Position, True).resample(q)
    if n_known:
        data = data.with_conditions(approach=np.where(np.arange(10)[:, None] < 10 - n_known, 0, directions))
    found = recheck(backlash, [data], fit.uncertainty)
    assert found.verdict == "ok"
    assert found.residual_rms < 2 * found.expected_rms
    changed_zero = recheck(backlash, [data.resample(q + 5e-3 * np.eye(6)[2])], fit.uncertainty)
    assert changed_zero.verdict == "changed"


def test_mistakes_in_files_are_named_beside_the_answer(tmp_path: Path, run, capsys):
    sim, fit, q = calibrated("ur10", 7, Position)
    robot, file = tmp_path / "cal.urdf", tmp_path / "check.csv"
    write_urdf(fit, robot)
    text = measurement_text(measured(sim, q, Position, True), fit.chain, [])
    args = ["recheck", str(robot), str(file), "--tip"]
    file.write_text(text)
    assert "tip ee_link; expected --tip tool0" in error_of(run(*args, "ee_link"))
    file.write_text(measurement_text(fit.data[0], fit.chain, []))
    assert "60 of 60 rows were fitted" in json_of(run(*args, "tool0", "--json", "-"))["warnings"][0]
    assert "x[m],y[m],z[m]" in text
    file.write_text(text.replace("x[m],y[m],z[m]", "y[m],x[m],z[m]"))
    assert main([*args, "tool0", "--json", "-"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert "The measuring frame is mirrored" in found["warnings"][0]
    assert (found["verdict"], found["changes"]) == ("cannot say", [])
    # The reason stands alone with --quiet.
    (reason,) = found["reasons"]
    assert reason.startswith("The measurements contain a mistake: ")
    assert "The measuring frame is mirrored" in reason
    assert reason.endswith(". Correct them, and check again.")


@pytest.mark.parametrize("kind", [Position, Pose])
def test_a_given_noise_replaces_that_of_the_measurements(kind):
    chain, q = nominal_arm("ur10"), np.random.default_rng(0).uniform(-2, 2, (10, 6))
    poses = chain.poses(q)
    values, noise = (poses, (3e-4, 2e-3)) if kind is Pose else (poses[:, :3, 3], (3e-4,))
    stated = recheck(chain, [kind(q, values, *noise)])
    given = recheck(chain, [kind(q, values, *(0.1 * n for n in noise))], noise=Noise(3e-4, 2e-3))
    assert given.to_dict() == stated.to_dict()
    assert given.expected_rms == pytest.approx(np.sqrt(3) * 3e-4)


@pytest.mark.parametrize(("ratio", "is_hidden"), [(0, True), (10, True), (100, False)])
def test_joints_that_hardly_move_the_measured_point_are_named(ratio, is_hidden):
    """The flange is on the last axis. A turn of 0.1 rad moves a point at ten times the noise by the noise."""
    tool = pin.SE3(np.eye(3), np.array([ratio * NOISE, 0.0, 0.0])).homogeneous
    chain = nominal_arm("ur10").with_base_and_tool(np.eye(4), tool)
    q = np.random.default_rng(0).uniform(-2, 2, (10, 6))
    result = recheck(chain, [Position(q, chain.poses(q)[:, :3, 3], NOISE)])
    assert (
        any("The zero of wrist_3_joint does not move it" in reason for reason in result.reasons) == is_hidden
    )


def test_residuals_have_the_size_of_a_motion_of_all_points():
    chain = nominal_arm("ur10")
    q = np.random.default_rng(0).uniform(-2, 2, (10, 6))
    data = Position(q, chain.poses(q)[:, :3, 3], NOISE)
    result = recheck(chain, [data])
    assert result.verdict == "ok"
    shifted = data.replace(values=data.positions() + np.array([0.003, 0.004, 0.0]))
    assert recheck(chain, [shifted]).residual_rms == pytest.approx(5e-3)


def test_likelihoods_of_a_change_are_those_of_the_normal_distribution():
    chain, rng = nominal_arm("ur10"), np.random.default_rng(0)
    q = rng.uniform(-2, 2, (4, 6))
    model = _CheckModel(chain, (Position(q, chain.poses(q)[:, :3, 3], NOISE),), None, {})
    columns, residual = rng.normal(size=(12, 2)), rng.normal(size=12)
    sets = model.scaled_sets(residual[:, None])
    found = model.log_likelihoods(columns, sets, model.null_likelihoods(sets))[0, :, 0]
    for width, value in zip(WIDTHS, found, strict=True):
        covariance = np.eye(12) + width**2 * columns @ columns.T
        square = residual @ np.linalg.solve(covariance, residual) - residual @ residual
        expected = -0.5 * (square + np.linalg.slogdet(covariance)[1])
        assert value - model.null_likelihoods(sets)[0, 0] == pytest.approx(expected, abs=1e-9)


def test_the_limit_of_the_evidence_grows_with_the_prior_probability():
    chain, rng = nominal_arm("ur10"), np.random.default_rng(0)
    q = rng.uniform(-2, 2, (4, 6))
    model = _CheckModel(chain, (Position(q, chain.poses(q)[:, :3, 3], NOISE),), None, {})
    columns, log_priors = [rng.normal(size=(12, 1)) for _ in range(2)], np.log([0.3, 0.1])
    more, less = (model.limit(columns, log_priors + shift) for shift in (np.log(2), 0.0))
    assert more - less == pytest.approx(np.log(2))


def test_only_single_changes_have_a_size():
    """The robot and a wrong sample have none; the other sizes are those of a change of everything."""
    sim, fit, q = calibrated("ur10", 7, Position)
    moved = pin.SE3(np.eye(3), np.array([0.003, 0.0, -0.004]))
    found = recheck(fit.chain, [measured(sim, q, Position, True, tool=moved)], fit.uncertainty).hypotheses
    assert {each.kind for each in found} == {"joint", "base", "tool", "robot", "sample"}
    for each in found:
        if each.kind in ("robot", "sample"):
            assert (each.size, each.std, each.unit) == (0.0, 0.0, "m")
        else:
            assert abs(each.size) > 0
            assert each.std > 0
            assert each.unit == ("rad" if each.kind == "joint" else "m")


@pytest.mark.parametrize("is_stated", [True, False])
def test_size_of_a_motion_of_the_base_is_as_uncertain_as_near_points_show_it(is_stated):
    """Points that are near to each other show turns poorly, and so the motion of the base far from them."""
    chain, rng = nominal_arm("ur10"), np.random.default_rng(0)
    q = np.array([0.3, -1.2, 1.5, -0.5, 0.7, 0.2]) + rng.uniform(-0.3, 0.3, (12, 6))
    points = chain.poses(q)[:, :3, 3]
    moved = points + np.array([0.003, 0.004, 0.0]) + rng.normal(0, NOISE, points.shape)
    first = recheck(chain, [Position(q, moved, NOISE if is_stated else None)]).hypotheses[0]
    # Motion v + ω x p of the points p, and the size of v.
    rows = np.concatenate([np.concatenate([np.eye(3), -pin.skew(point)], 1) for point in points])
    covariance = NOISE**2 * np.linalg.inv(rows.T @ rows)
    along = np.linalg.lstsq(rows, (moved - points).ravel())[0][:3]
    expected = np.sqrt(along @ covariance[:3, :3] @ along) / np.linalg.norm(along)
    assert (first.kind, first.unit) == ("base", "m")
    assert first.std == pytest.approx(expected, rel=0.01 if is_stated else 0.5)
    assert abs(first.size - 0.005) < 4 * first.std


def test_lengths_of_wires_are_refused():
    simulation = Simulation("ur10", 10, 3)
    with pytest.raises(InvalidArgumentError, match="of the kind wires; expected position or pose"):
        recheck(simulation.chain, [simulation.measure_wires()])
