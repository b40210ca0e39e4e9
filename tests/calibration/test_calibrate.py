"""The loop's own promises: frames without a guess, honest convergence, spread, and sigmas."""

from __future__ import annotations

import numpy as np
import pytest
from robots import paper, random_joints, random_table
from scipy.linalg import null_space

from dhcal_pin import se3
from dhcal_pin.calibration.evaluation import accuracy
from dhcal_pin.calibration.partition import k_fold
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.contact import PointContact, PointDistance
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.dh import DHTable

NONE = np.empty(0)


def any_rotation(rng: np.random.Generator):
    """A rotation drawn evenly from all of them."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def placed(chain: Chain, rng: np.random.Generator) -> Chain:
    """The chain with an instrument metres away and a target on an arm's length of tool."""
    away = lambda reach: reach * rng.uniform(-1, 1, 3) / np.sqrt(3)  # noqa: E731
    base = se3.transform(any_rotation(rng), away(5.0))
    tool = se3.transform(any_rotation(rng), away(0.5))
    return chain.perturbed_at({0: base, chain.tool_frame_index: tool})


def frames_found(kind, sim_6dof, sim_6dof_actual, seeds):
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = placed(sim_6dof_actual, rng)
        data = kind.simulate(truth, rng.uniform(-3, 3, (30, 6)), Noise(1e-4, 1e-4), rng)
        fit = calibrate(sim_6dof, data, "dh,base,tool", priors="none")
        other = kind.simulate(truth, rng.uniform(-3, 3, (50, 6)), Noise(), rng)
        assert fit.validate(other)["position_rms_m"] < 5e-4, seed


@pytest.mark.parametrize("kind", [Pose, Position])
def test_frames_need_no_guess(kind, sim_6dof, sim_6dof_actual):
    frames_found(kind, sim_6dof, sim_6dof_actual, 15)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
def test_frames_need_no_guess_in_any_of_200(kind, sim_6dof, sim_6dof_actual):
    frames_found(kind, sim_6dof, sim_6dof_actual, 200)


def test_before_differs_from_after_by_the_robot_alone(sim_6dof, sim_6dof_actual):
    """A far tracker must not count as an error of the nominal robot."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(placed(sim_6dof_actual, rng), rng.uniform(-3, 3, (60, 6)), Noise(), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool", priors="none")
    assert fit.validate(data)["position_rms_m"] < 1e-9
    assert 1e-3 < accuracy(fit.nominal_refitted, [data])["position_rms_m"] < 0.05


def test_stated_spread_is_the_scatter_over_repeats(sim_6dof, sim_6dof_actual):
    """Standard deviations of seen parameters cover the truth as normal ones do."""
    truth = {p.name: p.nominal for p in select_parameters(sim_6dof_actual, "dh").parameters}
    scores = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (40, 6)), Noise(1e-4, 1e-4), rng)
        fit = calibrate(sim_6dof, data, "dh", priors="none")
        for p, x, std in zip(fit.parameters, fit.x, fit.std, strict=True):
            if p.name in ("a1", "a2", "alpha1", "d1", "theta1", "a6", "alpha4"):
                scores.append((p.nominal + x - truth[p.name]) / std)
    assert np.std(scores) == pytest.approx(1.0, abs=0.1)
    assert abs(np.mean(scores)) < 0.15


def test_predicted_spread_of_the_tool_is_its_scatter_over_repeats(sim_6dof, sim_6dof_actual):
    """True poses lie where the predicted covariance says, in all six directions together."""
    scores, squares, expected = [], [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (15, 6)), Noise(1e-4, 2e-4), rng)
        q = rng.uniform(-3, 3, (20, 6))
        found = calibrate(sim_6dof, data, "dh", priors="none").predict(q)
        away = se3.inverse(found.poses) @ sim_6dof_actual.poses(q)
        turn = found.poses[:, :3, :3]
        moved = np.concatenate(
            [
                np.einsum("mij,mj->mi", turn, away[:, :3, 3]),
                np.einsum("mij,mj->mi", turn, se3.log3(away[:, :3, :3])),
            ],
            1,
        )
        scores.append(np.einsum("mi,mij,mj->m", moved, np.linalg.inv(found.covariance), moved))
        squares.append(np.sum(moved[:, :3] ** 2, 1))
        expected.append(found.position_std**2)
    assert np.mean(scores) == pytest.approx(6, rel=0.1)
    assert np.sqrt(np.mean(squares) / np.mean(expected)) == pytest.approx(1, abs=0.1)


def test_predicted_spread_says_where_nothing_is_known(sim_6dof):
    """Without priors and with the last rotations unseen, the tool's place is known and its rotation not."""
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_6dof, rng.uniform(-3, 3, (40, 6)), Noise(1e-4), rng)
    found = calibrate(sim_6dof, data, "dh", priors="none").predict(rng.uniform(-3, 3, (5, 6)))
    assert (found.position_std < 1e-3).all()
    assert np.isinf(found.orientation_std).all()


def told_by_priors(fit):
    """Standard deviations that priors leave where exact data see nothing, with scipy's null space."""
    blind = null_space(fit.solution.system.r, rcond=1e-9)
    precision = blind.T @ (fit.problem.weights[:, None] ** 2 * blind)
    return np.sqrt(np.diag(blind @ np.linalg.solve(precision, blind.T)))


def test_exact_data_leave_what_they_do_not_see_as_unknown_as_it_was(sim_6dof, sim_6dof_actual):
    """No noise makes nothing seen that is not: a tilt before the first joint is the base's as well."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(placed(sim_6dof_actual, rng), rng.uniform(-3, 3, (40, 6)), Noise(), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool")
    assert fit.rank == 30
    expected = told_by_priors(fit)
    assert fit.std == pytest.approx(expected, rel=1e-6, abs=1e-8)
    names = [p.name for p in fit.parameters]
    assert fit.posterior_to_prior_std[names.index("joint_1.rx")] > 0.7
    assert not np.isinf(fit.std).any()


def test_sigmas_that_are_too_small_widen_what_the_data_tell_alone(sim_6dof, sim_6dof_actual):
    """Readings ten times worse than stated leave the spread that right sigmas do: priors stay as wide."""
    found = []
    for share in (1.0, 0.1):
        rng = np.random.default_rng(1)
        q = rng.uniform(-3, 3, (200, 6))
        read = Pose.simulate(placed(sim_6dof_actual, rng), q, Noise(1e-4, 1e-4), rng)
        data = Pose(q, read.poses, 1e-4 * share, 1e-4 * share)
        found.append(calibrate(sim_6dof, data, "minimal,base,tool", priors={"*": 1e-2}))
    right, wrong = found
    assert wrong.unit_weight_std == pytest.approx(10, rel=0.1)
    assert wrong.std == pytest.approx(right.std, rel=0.1)


@pytest.mark.parametrize(("stated", "expected"), [(False, 1e-4), (True, 1e-3)])
def test_a_single_distance_tells_no_scatter_of_its_own(sim_6dof, sim_6dof_actual, stated, expected):
    """It can be met exactly, and is no better for that: it counts as the touches, unless theirs is stated."""
    rng = np.random.default_rng(4)
    touches = PointContact.simulate(sim_6dof_actual, rng.uniform(-2.5, 2.5, (200, 6)), Noise(1e-4), rng)
    tip = touches.initialized(sim_6dof_actual)
    places = np.reshape([unknown.nominal for unknown in tip.instrument_parameters], (-1, 3))
    far = np.linalg.norm(places[1] - places[0]) + 1e-3
    known = PointDistance(6, [(touches.names[0], touches.names[1])], [far])
    names = [touches.names[i] for i in touches.label]
    data = PointContact(touches.q, names, 1e-4 if stated else None)
    fit = calibrate(sim_6dof, [data, known], "minimal,tool")
    assert fit.problem.data[1].sigma.item() == pytest.approx(expected, rel=0.2)


def test_unstated_sigmas_are_found(sim_6dof, sim_6dof_actual):
    """Positions 20 times worse than the placeholder and rotations 20 times better, none stated."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (300, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(2e-2, 5e-5), rng)
    fit = calibrate(sim_6dof, Pose(q, data.poses), "dh")
    (used,) = fit.problem.data
    assert used.sigma.mean() == pytest.approx(2e-2, rel=0.1)
    assert used.rotation_sigma.mean() == pytest.approx(5e-5, rel=0.1)


def test_stated_sigmas_stay(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (50, 6)), Noise(2e-2, 5e-5), rng)
    (used,) = calibrate(sim_6dof, data, "dh").problem.data
    np.testing.assert_array_equal(used.sigma, data.sigma)


def test_unseen_directions_do_not_move(sim_6dof):
    """With priors or with damping alone, what no pose sees stays nominal."""
    arm = Chain.from_dh(paper("sim_3dof"))
    rng = np.random.default_rng(0)
    data = Position.simulate(
        Chain.from_dh(paper("sim_3dof_actual")), rng.uniform(-3, 3, (20, 3)), Noise(), rng
    )
    for priors in ("default", "none"):
        fit = calibrate(arm, data, "dh", priors=priors)
        last = [p.name for p in fit.parameters].index("alpha3")
        assert abs(fit.x[last]) < 1e-12
        assert any("alpha3" in text for text in fit.unobservable)
        assert fit.observable_fraction[last] < 1e-9
    assert np.isinf(calibrate(arm, data, "dh", priors="none").std[last])


def test_converged_means_a_fresh_step_moves_nothing(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (30, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert fit.converged
    assert fit.is_converged(1e-6)
    short = calibrate(sim_6dof, data, "dh", priors="none", max_iterations=1)
    assert not short.converged
    assert not short.is_converged(1e-6)


def test_result_is_the_minimum_that_scipy_finds(sim_6dof, sim_6dof_actual):
    """Another solver, from the answer and from nominal, finds no lower cost."""
    from scipy.optimize import least_squares

    rng = np.random.default_rng(4)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (15, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    residual = lambda x: data.residual(fit.errors.at(x).forward_kinematics(data.q), NONE).ravel()  # noqa: E731
    other = least_squares(residual, np.zeros(24), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.sum(residual(fit.x) ** 2) <= 2 * other.cost * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_mixed_kinds_on_random_arms(seed):
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
        ({"method": "newton"}, "choose from lm, gn"),
        ({"priors": "weak"}, "choose default, none"),
        ({"priors": {"x9": 1.0}}, "no such parameter"),
        ({"priors": {"d*": -1.0}}, "must be positive"),
        ({"bounds": {"x9": (-1.0, 1.0)}}, "no such parameter"),
        ({"bounds": {"d1": (5.0, 6.0)}}, "must contain the nominal"),
        ({"bounds": {"d1": (-5.0, 6.0)}, "method": "gn"}, "bounds require method 'lm'"),
    ],
)
def test_wrong_choices_are_named(sim_6dof, kwargs, message):
    data = Position.simulate(sim_6dof, np.zeros((10, 6)), Noise(1e-3), np.random.default_rng(0))
    with pytest.raises(DhcalError, match=message):
        calibrate(sim_6dof, data, "dh", **kwargs)


def test_no_data_is_said(sim_6dof):
    with pytest.raises(DhcalError, match="no measurements"):
        calibrate(sim_6dof, [])


def test_a_fit_without_hold_out_is_judged_by_samples_left_out(sim_6dof, sim_6dof_actual):
    """Ten folds, each refitted from the start by the whole loop, give the same errors."""
    rng = np.random.default_rng(1)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (30, 6)), Noise(1e-3, 1e-3), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    squares = [
        accuracy(calibrate(sim_6dof, data.take(~mask), "dh", priors="none").chain, [data.take(mask)])
        for (mask,) in k_fold([data], 10)
    ]
    wanted = np.sqrt(np.mean([found["position_rms_m"] ** 2 for found in squares]))
    judged = fit.comparisons[0]
    assert judged.title == "cross-validated"
    assert judged.after["position_rms_m"] == pytest.approx(wanted, rel=0.02)
    assert judged.after["position_rms_m"] > 1.05 * fit.comparisons[1].after["position_rms_m"]


@pytest.mark.parametrize("options", [{"method": "gn"}, {"priors": "none"}])
def test_samples_that_are_met_exactly_do_not_foretell_the_others(sim_6dof, sim_6dof_actual, options):
    """Two poses fit without a rest and tell half of the errors: a fit to one misses the other."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (2, 6)), Noise(), rng)
    left_out, fitted = calibrate(sim_6dof, data, "dh", **options).comparisons
    assert fitted.after["position_rms_m"] < 1e-9
    alone = [
        accuracy(
            calibrate(sim_6dof, data.take(np.array([one])), "dh", **options).chain,
            [data.take(np.array([1 - one]))],
        )
        for one in (0, 1)
    ]
    wanted = np.sqrt(np.mean([found["position_rms_m"] ** 2 for found in alone]))
    assert left_out.after["position_rms_m"] == pytest.approx(wanted, rel=0.05)
    assert wanted > 5e-3


def test_bounds_hold_and_the_rest_is_least_squares(sim_6dof, sim_6dof_actual):
    """Two parameters at their bounds and one inside: scipy's own bounded solver finds no less."""
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
    # Samples that are left out are judged by arms within the same bounds.
    assert fit.comparisons[0].after["position_rms_m"] > 1e-3
    low, high = fit.problem.bounds
    assert np.all((low - 1e-12 <= fit.x) & (fit.x <= high + 1e-12))
    residual = lambda x: data.residual(errors.at(x).forward_kinematics(data.q), NONE).ravel()  # noqa: E731
    other = least_squares(residual, np.zeros(24), bounds=(low - 1e-12, high + 1e-12), xtol=1e-14, ftol=1e-14)
    assert np.sum(residual(fit.x) ** 2) <= 2 * other.cost * (1 + 1e-6)
    free = calibrate(sim_6dof, data, "dh", priors="none")
    assert np.any((free.x < low) | (free.x > high))


@pytest.mark.parametrize("noise", [5e-5, 1e-3])
def test_touches_without_a_length_leave_the_size_of_the_arm_to_the_priors(sim_6dof, noise):
    """The smallest arm would touch every point best, the more so the larger the noise."""
    rng = np.random.default_rng(1)
    errors = select_parameters(sim_6dof, "minimal")
    truth = errors.at(errors.priors * rng.normal(size=len(errors.parameters)))
    q = rng.uniform(-2.5, 2.5, (300, 6))
    data = PointContact.simulate(truth, q, Noise(noise), rng).replace(has_stated_sigma=False)
    fixed = ("tool.rx", "tool.ry", "tool.rz")
    fit = calibrate(sim_6dof, data, "minimal,tool", fix=fixed)
    assert [text for text in fit.unobservable if "the size of the robot" in text]
    assert fit.converged
    assert fit.iterations < 40
    # Joints 1 with the points 4, a shift and a turn behind joint 1, and the size; the rest is seen.
    assert fit.rank == len(fit.x) - 7
    assert spread(fit.chain) / spread(sim_6dof) == pytest.approx(1, abs=1e-3)
    assert fit.problem.data[0].sigma.mean() == pytest.approx(noise, rel=0.2)
    # One known distance between two of the points, and its size is known.
    first, second = truth.poses(q[:2])[:, :3, 3]
    known = PointDistance(6, [(data.names[0], data.names[1])], [np.linalg.norm(second - first)], 1e-5)
    sized = calibrate(sim_6dof, [data, known], "minimal,tool", fix=fixed)
    assert not [text for text in sized.unobservable if "the size of the robot" in text]
    assert spread(sized.chain) / spread(truth) == pytest.approx(1, abs=5e-5 + 0.5 * noise)


def spread(chain):
    """How far the tool spreads about its middle, RMS over the joint space."""
    points = chain.poses(np.random.default_rng(1).uniform(-2.5, 2.5, (500, chain.n_joints)))[:, :3, 3]
    return np.linalg.norm(points - points.mean(0)) / np.sqrt(500)


def test_lengths_that_are_held_tell_how_large_an_arm_is_that_touches(sim_6dof):
    rng = np.random.default_rng(1)
    data = PointContact.simulate(sim_6dof, rng.uniform(-2.5, 2.5, (300, 6)), Noise(1e-4), rng)
    said = calibrate(sim_6dof, data, "offset,tool").unobservable
    assert said
    assert not [text for text in said if "the size of the robot" in text]


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
def test_a_step_that_damping_makes_small_is_no_end(seed, prismatic, theta, d, a, quarters, tilt, beta):
    """Nearly parallel axes: of the turns of a narrow valley a damped loop sees nothing, a plain step does."""
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
