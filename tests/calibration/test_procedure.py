"""Calibration procedure: the minimum of the cost, bounds, the scale of robots without length measurements."""

import numpy as np
import pytest
from robots import nominal_arm, random_joints, random_table, with_random_frames, with_small_errors
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import Accuracy, blocked_folds, calibrate, evidence
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.estimation import select_parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import Noise, PointContact, PointDistance, Pose, Position
from dhcal_pin.measurements.base import concatenate
from dhcal_pin.plausibility import diagnose_mixups
from dhcal_pin.robot import Chain, DHTable

NONE = np.empty(0)


def test_solution_is_the_minimum_that_scipy_finds(sim_6dof, sim_6dof_actual):
    """The least-squares solver of scipy, started at the nominal robot, finds no lower cost."""
    from scipy.optimize import least_squares

    rng = np.random.default_rng(4)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (15, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    residual = lambda x: data.residual(fit.errors.at(x).forward_kinematics(data.q), NONE).ravel()  # noqa: E731
    other = least_squares(residual, np.zeros(24), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.sum(residual(fit.x) ** 2) <= 2 * other.cost * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_poses_and_positions_together_on_random_robots(seed):
    rng = np.random.default_rng(seed)
    table = random_table(rng, size=5)
    nominal = Chain.from_dh(table)
    errors = select_parameters(nominal, "minimal,base,tool")
    x = np.array([0.02 if p.unit == "rad" else 0.005 for p in errors.parameters]) * rng.normal(
        size=len(errors.parameters)
    )
    truth = errors.at(x)
    draw = lambda m: rng.uniform(-1, 1, (m, 5)) * np.where(table.prismatic, 0.5, np.pi)  # noqa: E731
    data = [Pose.simulate(truth, draw(15), Noise(), rng), Position.simulate(truth, draw(25), Noise(), rng)]
    fit = calibrate(nominal, data, "minimal,base,tool", priors="none")
    assert fit.validate(Pose.simulate(truth, draw(50), Noise(), rng))["position_max_m"] < 1e-9


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"priors": "weak"}, "choose default, none"),
        ({"priors": {"x9": 1.0}}, "no such parameter"),
        ({"priors": {"d*": -1.0}}, "must be positive"),
    ],
)
def test_wrong_priors_are_named(sim_6dof, kwargs, message):
    data = Position.simulate(sim_6dof, np.zeros((10, 6)), Noise(1e-3), np.random.default_rng(0))
    with pytest.raises(DhcalError, match=message):
        calibrate(sim_6dof, data, "dh", **kwargs)


def test_bounded_solution_is_the_minimum_that_scipy_finds(sim_6dof, sim_6dof_actual, unsuspected_once):
    """Two parameters at their bounds and one inside: the bounded solver of scipy finds no lower cost."""
    from scipy.optimize import least_squares

    rng = np.random.default_rng(5)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (15, 6)), Noise(1e-4, 1e-4), rng)
    errors = select_parameters(sim_6dof, "dh")
    nominal = {p.name: p.nominal for p in errors.parameters}
    bounds = {
        "a2": (nominal["a2"], nominal["a2"] + 1e-3),
        "theta1": (nominal["theta1"] - 0.1, nominal["theta1"] + 0.01),
        "d5": (nominal["d5"] - 1.0, nominal["d5"] + 1.0),
    }
    fit = calibrate(sim_6dof, data, "dh", priors="none", bounds=bounds)
    assert fit.converged
    assert fit.is_converged(1e-4)
    assert fit.problem.bounds is not None
    # The fits of the cross-validation have the same bounds.
    assert fit.comparisons[0].after["position_rms_m"] > 1e-3
    low, high = fit.problem.bounds
    assert np.all((low - 1e-12 <= fit.x) & (fit.x <= high + 1e-12))
    residual = lambda x: data.residual(errors.at(x).forward_kinematics(data.q), NONE).ravel()  # noqa: E731
    other = least_squares(residual, np.zeros(24), bounds=(low - 1e-12, high + 1e-12), xtol=1e-14, ftol=1e-14)
    assert np.sum(residual(fit.x) ** 2) <= 2 * other.cost * (1 + 1e-6)
    free = calibrate(sim_6dof, data, "dh", priors="none")
    assert np.any((free.x < low) | (free.x > high))


@pytest.mark.parametrize("noise", some_slow([5e-5, 1e-3], {1}))
def test_contacts_leave_the_scale_of_the_robot_to_the_priors(sim_6dof, noise):
    """Without priors the smallest robot would fit best, as its contact errors shrink with it."""
    rng = np.random.default_rng(1)
    errors = select_parameters(sim_6dof, "minimal")
    truth = errors.at(errors.priors * rng.normal(size=len(errors.parameters)))
    q = rng.uniform(-2.5, 2.5, (300, 6))
    data = PointContact.simulate(truth, q, Noise(noise), rng).replace(has_stated_sigma=False)
    fixed = ("tool.rx", "tool.ry", "tool.rz")
    fit = calibrate(sim_6dof, data, "minimal,tool", fix=fixed, session="off")
    assert [text for text in fit.unobservable if "the size of the robot" in text]
    assert fit.converged
    assert fit.iterations < 40
    # Not observable: joint 1 with the points (4), a shift and a turn along axis 1, and the scale.
    assert fit.rank == len(fit.x) - 7
    assert rms_radius(fit.chain) / rms_radius(sim_6dof) == pytest.approx(1, abs=1e-3)
    assert fit.problem.data[0].sigma.mean() == pytest.approx(noise, rel=0.2)
    # A known distance between two of the points determines the scale.
    first, second = truth.poses(q[:2])[:, :3, 3]
    known = PointDistance(6, [(data.names[0], data.names[1])], [np.linalg.norm(second - first)], 1e-5)
    sized = calibrate(sim_6dof, [data, known], "minimal,tool", fix=fixed, session="off")
    assert not [text for text in sized.unobservable if "the size of the robot" in text]
    assert rms_radius(sized.chain) / rms_radius(truth) == pytest.approx(1, abs=5e-5 + 0.5 * noise)


def rms_radius(chain):
    """Compute the RMS distance of the tool from its mean over the joint space."""
    points = chain.poses(np.random.default_rng(1).uniform(-2.5, 2.5, (500, chain.n_joints)))[:, :3, 3]
    return np.linalg.norm(points - points.mean(0)) / np.sqrt(500)


def test_fixed_lengths_determine_the_scale_of_the_robot(sim_6dof):
    rng = np.random.default_rng(1)
    data = PointContact.simulate(sim_6dof, rng.uniform(-2.5, 2.5, (300, 6)), Noise(1e-4), rng)
    texts = calibrate(sim_6dof, data, "offset,tool").unobservable
    assert texts
    assert not [text for text in texts if "the size of the robot" in text]


@pytest.mark.parametrize(
    ("seed", "prismatic", "theta", "d", "a", "quarters", "tilt", "beta"),
    [
        (1, "011", [0.1, -2, -2.6], [0.3, -0.3, 0.3], [0, 0.2, 0.4], [-1, 2, 0], [0, 0, 0.03], [-0.03, 0, 0]),
        (
            *(0, "1100", [-2.6, -0.9, -3, -0.6], [0, 0, 0.3, 0.5], [-0.3, 0, 0, 0]),
            *([-1, 2, -1, 0], [0.03, 0.01, 0, 0], [0, 0, 0.01, 0.001]),
        ),
    ],
)
def test_small_damped_step_does_not_end_the_iteration(seed, prismatic, theta, d, a, quarters, tilt, beta):
    """Nearly parallel axes make a narrow valley: damped steps are small there, an undamped one is not."""
    n = len(theta)
    table = DHTable(
        "modified",
        tuple(f"j{i + 1}" for i in range(n)),
        np.array([letter == "1" for letter in prismatic]),
        np.array(theta),
        np.array(d),
        np.array(a),
        np.pi / 2 * np.array(quarters) + tilt,
        np.array(beta),
        np.full(n, -np.inf),
        np.full(n, np.inf),
    )
    arm, rng = Chain.from_dh(table), np.random.default_rng(seed)
    errors = select_parameters(arm, "dh,base,tool")
    size = np.array([np.deg2rad(2) if p.unit == "rad" else 0.01 for p in errors.parameters])
    truth = errors.at(size * rng.uniform(-1, 1, len(size)))
    q = random_joints(rng, table, 80)
    fit = calibrate(arm, Pose(q[:40], truth.poses(q[:40])), "dh,base,tool", priors="none")
    assert fit.converged
    assert np.abs(fit.chain.poses(q[40:]) - truth.poses(q[40:])).max() < 1e-9


@pytest.mark.parametrize("options", [{"priors": "none"}, {"method": "gn"}])
def test_missing_priors_are_named_where_they_are_needed(options):
    """A point on the axis of the last joint does not show the turns of that axis."""
    chain = nominal_arm("ur10")
    errors, rng = select_parameters(chain, "minimal"), np.random.default_rng(5)
    size = np.where([p.unit == "m" for p in errors.parameters], 1e-3, 3e-3)
    truth = errors.at(size * rng.normal(size=len(size)))
    data = Position.simulate(truth, rng.uniform(-3, 3, (60, 6)), Noise(5e-5), rng)
    without = calibrate(chain, data, "minimal,base,tool", **options)
    assert without.verdict.is_refused
    assert without.verdict.reasons[0].endswith("--priors default.")
    assert (
        calibrate(chain, data, "minimal,base,tool", **options | {"priors": "default"}).verdict.status == "ok"
    )


@pytest.mark.parametrize("step", [0.01, pytest.param(0.0, marks=pytest.mark.slow)])
def test_left_out_regions_keep_the_mistakes_and_changes_that_all_samples_show(step, monkeypatch):
    """Calibrations that look for both again, in the samples of the result, give the same accuracy."""
    arm, rng = nominal_arm("ur10"), np.random.default_rng(5)
    truth, other = (with_random_frames(with_small_errors(arm, rng), rng) for _ in range(2))
    moved = truth.with_base_and_tool(se3.transform(np.eye(3), [0.0, step, 0.0]) @ truth.base, truth.tool)
    # Samples of another robot between those of the first one ask for mistakes in the measurements.
    parts = ((truth, 30), (moved, 30)) if step else ((truth, 60), (other, 20))
    data = concatenate(
        [Pose.simulate(robot, rng.uniform(-1.5, 1.5, (m, 6)), Noise(1e-4, 2e-4), rng) for robot, m in parts]
    )
    count = len(data.rows)
    data = data.replace(rows=np.arange(count) if step else rng.permutation(count))
    diagnosed = []
    monkeypatch.setattr(
        evidence, "diagnose_mixups", lambda *args: diagnosed.append(args) or diagnose_mixups(*args)
    )
    fit = calibrate(arm, data, "minimal,base,tool", holdout="region")
    assert len(diagnosed) <= 1
    assert fit.session is not None
    assert fit.session.changes.base.is_identity is not (step > 0)
    assert fit.n_outliers == count - 60
    (fitted,), (is_counted,) = fit.data, fit.is_counted
    errors = []
    for (mask,) in blocked_folds(fitted):
        part = calibrate(arm, fitted.take(~mask), "minimal,base,tool")
        errors += compute_errors(part.chain, [fitted.take(mask & is_counted)], {})
    assert len(diagnosed) > 5
    after, expected = fit.comparisons[0].after, Accuracy.from_errors(errors)
    assert after["position_rms_m"] == pytest.approx(expected["position_rms_m"], rel=1e-9)
