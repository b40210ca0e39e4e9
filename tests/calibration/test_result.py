"""Result: convergence, accuracy and uncertainty against the truth of many simulated robots."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from robots import joint_sample, measured_arm, paper, with_random_frames
from scipy.linalg import null_space
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import accuracy, calibrate, k_fold
from dhcal_pin.calibration.estimates import Estimate
from dhcal_pin.calibration.summary import definition_table
from dhcal_pin.calibration.verdict import Verdict
from dhcal_pin.estimation import Problem, linearize_and_factor, select_parameters
from dhcal_pin.estimation.solver import next_iterate
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.robot import Chain

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")

# Standard deviations of the simulated noise [m], [rad].
POSITION_STD, ROTATION_STD = 1e-4, np.deg2rad(0.01)
NOISE = Noise(POSITION_STD, ROTATION_STD)


def test_accuracy_before_has_refitted_frames(sim_6dof, sim_6dof_actual):
    """The unknown pose of a tracker is not an error of the nominal robot."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(with_random_frames(sim_6dof_actual, rng), rng.uniform(-3, 3, (60, 6)), Noise(), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool", priors="none")
    assert fit.validate(data)["position_rms_m"] < 1e-9
    assert 1e-3 < accuracy(fit.nominal_refitted, [data])["position_rms_m"] < 0.05


def test_a_nominal_robot_that_is_kept_has_no_figures_of_the_urdf_alone(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (60, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool,harmonics", extend="none", holdout="region")
    assert fit.bare
    assert fit.region_comparison
    assert fit.region_comparison.after_alone
    kept = replace(fit, decision=Verdict("caution", keeps_nominal=True)).accepted
    assert kept.is_kept_nominal
    assert [each.after_alone for each in kept.comparisons] == [None] * 3


def test_converged_means_that_a_new_step_is_negligible(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (30, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert fit.converged
    assert fit.is_converged(1e-6)
    short = calibrate(sim_6dof, data, "dh", priors="none", max_iterations=1)
    assert not short.converged
    assert not short.is_converged(1e-6)


# Fewer repeats have a wider bound.
@pytest.mark.parametrize(("n", "off", "mean"), some_slow([(40, 0.15, 0.2), (100, 0.1, 0.15)], {0}))
def test_standard_deviations_match_scatter_over_repeats(sim_6dof, sim_6dof_actual, n, off, mean):
    """Errors of observable parameters, divided by their standard deviations, are standard normal."""
    truth = {p.name: p.nominal for p in select_parameters(sim_6dof_actual, "dh").parameters}
    scores = []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (40, 6)), Noise(1e-4, 1e-4), rng)
        fit = calibrate(sim_6dof, data, "dh", priors="none")
        for p, x, std in zip(fit.parameters, fit.x, fit.std, strict=True):
            if p.name in ("a1", "a2", "alpha1", "d1", "theta1", "a6", "alpha4"):
                scores.append((p.nominal + x - truth[p.name]) / std)
    assert np.std(scores) == pytest.approx(1.0, abs=off)
    assert abs(np.mean(scores)) < mean


def coverage(nominal: Chain, actual: Chain, n_poses: int, n_repeats: int) -> float:
    """Fraction of the true parameters within ±1.96 standard deviations, with noise that is estimated."""
    truth = np.array([p.nominal for p in select_parameters(actual, "dh").parameters])
    within = []
    for seed in range(n_repeats):
        rng = np.random.default_rng(seed)
        data = Pose.simulate(actual, rng.uniform(-2.5, 2.5, (n_poses, 6)), NOISE, rng)
        fit = calibrate(nominal, Pose(data.q, data.poses), "dh", priors="none", loss="linear")
        value = np.array([p.nominal for p in fit.parameters]) + fit.x
        within += [np.abs(value - truth) < 1.96 * fit.std]
    return float(np.mean(within))


@pytest.mark.parametrize(("n", "least"), some_slow([(150, 0.935), (300, 0.94)], {0}))
def test_noise_that_few_poses_determine_widens_the_standard_deviations(sim_6dof, sim_6dof_actual, n, least):
    """91.5 to 92.8 % with the quantiles of a normal distribution."""
    assert least < coverage(sim_6dof, sim_6dof_actual, 8, n) < 0.97


@pytest.mark.slow
@pytest.mark.parametrize("n_poses", [6, 8, 12, 25, 60])
def test_standard_deviations_contain_the_truth_for_any_number_of_poses(sim_6dof, sim_6dof_actual, n_poses):
    assert 0.93 < coverage(sim_6dof, sim_6dof_actual, n_poses, 2000) < 0.96


def test_standard_deviations_follow_students_t_distribution(sim_6dof, sim_6dof_actual):
    """Its 97.5 % quantile with 12 degrees of freedom is 2.1788 (tables); eight poses have 2 x 24 rows."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-2.5, 2.5, (8, 6)), NOISE, rng)
    fit = calibrate(sim_6dof, Pose(data.q, data.poses), "dh", priors="none", loss="linear")
    assert fit.noise_degrees_of_freedom == pytest.approx(12)
    normal = np.linalg.norm(fit.solution.system.sqrt_covariance(fit.problem.weights)[0], axis=1)
    np.testing.assert_allclose(fit.std, 2.1788 / 1.95996 * fit.unit_weight_std * normal, rtol=1e-4)
    stated = calibrate(sim_6dof, data, "dh", priors="none")
    assert stated.noise_degrees_of_freedom == np.inf
    normal = np.linalg.norm(stated.solution.system.sqrt_covariance(stated.problem.weights)[0], axis=1)
    np.testing.assert_allclose(stated.std, normal, rtol=1e-12)


@pytest.mark.parametrize(("n", "off"), some_slow([(30, 0.15), (60, 0.1)], {0}))
def test_predicted_covariance_matches_scatter_over_repeats(sim_6dof, sim_6dof_actual, n, off):
    """The Mahalanobis distance of true poses has the mean of χ² with six degrees of freedom."""
    scores, squares, expected = [], [], []
    for seed in range(n):
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
    assert np.mean(scores) == pytest.approx(6, rel=off)
    assert np.sqrt(np.mean(squares) / np.mean(expected)) == pytest.approx(1, abs=0.1)


def test_predicted_orientation_is_unbounded_if_not_observable(sim_6dof):
    """Positions alone determine the position of the tool and not its orientation."""
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_6dof, rng.uniform(-3, 3, (40, 6)), Noise(1e-4), rng)
    found = calibrate(sim_6dof, data, "dh", priors="none").predict(rng.uniform(-3, 3, (5, 6)))
    assert (found.position_std < 1e-3).all()
    assert np.isinf(found.orientation_std).all()


def std_of_priors(fit):
    """Compute the standard deviations of priors within the null space of exact data, with scipy."""
    basis = null_space(fit.solution.system.r, rcond=1e-9)
    precision = basis.T @ (fit.problem.weights[:, None] ** 2 * basis)
    return np.sqrt(np.diag(basis @ np.linalg.solve(precision, basis.T)))


def test_exact_data_do_not_determine_unobservable_directions(sim_6dof, sim_6dof_actual):
    """A tilt before the first joint is equivalent to a tilt of the base, even without noise."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(with_random_frames(sim_6dof_actual, rng), rng.uniform(-3, 3, (40, 6)), Noise(), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool")
    assert fit.rank == 30
    expected = std_of_priors(fit)
    assert fit.std == pytest.approx(expected, rel=1e-6, abs=1e-8)
    names = [p.name for p in fit.parameters]
    assert fit.posterior_to_prior_std[names.index("joint_1.rx")] > 0.7
    assert not np.isinf(fit.std).any()
    # A damped step is negligible before the undamped one is. Undamped steps then follow at once.
    assert fit.iterations <= 10
    np.testing.assert_allclose(next_iterate(fit.problem, fit.solution), fit.solution.x, atol=1e-9)


def test_contradicted_standard_deviations_are_scaled_without_the_priors(sim_6dof, sim_6dof_actual):
    """Data ten times worse than stated give the standard deviations of correctly stated ones."""
    found = []
    for factor in (1.0, 0.1):
        rng = np.random.default_rng(1)
        q = rng.uniform(-3, 3, (200, 6))
        measured = Pose.simulate(with_random_frames(sim_6dof_actual, rng), q, Noise(1e-4, 1e-4), rng)
        data = Pose(q, measured.poses, 1e-4 * factor, 1e-4 * factor)
        found.append(calibrate(sim_6dof, data, "minimal,base,tool", priors={"*": 1e-2}))
    right, wrong = found
    assert wrong.unit_weight_std == pytest.approx(10, rel=0.1)
    assert wrong.std == pytest.approx(right.std, rel=0.1)


def test_unobservable_directions_stay_nominal(sim_6dof):
    """Unobservable parameters stay nominal, with priors or with damping alone."""
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


def test_result_without_hold_out_is_cross_validated(sim_6dof, sim_6dof_actual):
    """Ten calibrations without one fold each give the same errors."""
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


@dataclass
class Totals:
    """Sums over the trials of one robot."""

    extended: int = 0
    inside: int = 0
    count: int = 0
    squares: float = 0.0
    bound: float = 0.0
    claimed: float = 0.0


def run_trial(nominal: Chain, seed: int, totals: Totals):
    """Calibrate one robot with errors up to 2° and 10 mm on 10 to 100 poses, and test it on other poses."""
    rng = np.random.default_rng(seed)
    errors = select_parameters(nominal, "minimal,base,tool")
    size = np.array([np.deg2rad(2.0) if p.unit == "rad" else 1e-2 for p in errors.parameters])
    x = size * rng.uniform(-1, 1, len(size))
    truth = errors.at(x)
    data = Pose.simulate(
        truth, joint_sample(nominal, int(rng.integers(10, 101)), rng), Noise(POSITION_STD, ROTATION_STD), rng
    )
    fit = calibrate(nominal, data, "minimal,base,tool")
    assert fit.converged, seed

    # The cost at the true errors, and the Cramér-Rao bound of the variance there.
    problem = Problem(errors, (data,), np.zeros(len(x)))
    system = linearize_and_factor(problem, x, small_angle=False)
    cost_of_truth = system.min_cost + system.z @ system.z
    residual = data.residual(fit.chain.forward_kinematics(data.q), np.empty(0))
    assert np.sum(residual**2) < cost_of_truth, seed

    links = [
        i for i, p in enumerate(errors.parameters) if "." in p.name and p.name[:4] not in ("base", "tool")
    ]
    totals.extended += fit.extension is not None and bool(fit.extension.families)
    # A family of joint errors that chance has added has further parameters.
    place = {parameter.name: i for i, parameter in enumerate(fit.parameters)}
    links = [i for i in links if errors.parameters[i].name in place]
    found = [place[errors.parameters[i].name] for i in links]
    scores = (fit.x[found] - x[links]) / fit.std[found]
    totals.inside += int(np.sum(np.abs(scores) < 1.959964))
    totals.count += len(links)

    q = joint_sample(nominal, 50, rng)
    error = fit.chain.poses(q)[:, :3, 3] - truth.poses(q)[:, :3, 3]
    chain, bodies, twists = errors.derivative(x)
    jacobian = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)[:, :3]
    root = system.sqrt_covariance(problem.weights)[0]
    totals.squares += np.mean(np.sum(error**2, 1))
    totals.bound += np.mean(np.sum(np.einsum("pim,pr->mir", jacobian, root) ** 2, (1, 2)))
    totals.claimed += np.mean(fit.predict(q).position_std ** 2)


def run_trials(name: str, seeds) -> Totals:
    """Run the trials of one robot."""
    nominal, totals = measured_arm(name), Totals()
    for seed in seeds:
        run_trial(nominal, seed, totals)
    return totals


ARMS = pytest.mark.parametrize("name", ["paper", "ur5", "panda", "slide"])


@pytest.mark.parametrize("name", some_slow(["paper", "ur5", "panda", "slide"], {3}))
def test_intervals_and_predictions_hold(name):
    totals = run_trials(name, range(12))
    assert 0.90 < totals.inside / totals.count < 0.99
    assert np.sqrt(totals.squares / totals.bound) == pytest.approx(1, abs=0.15)
    assert np.sqrt(totals.squares / totals.claimed) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
@ARMS
def test_intervals_and_predictions_hold_over_1000_robots(name):
    totals = run_trials(name, range(1000))
    # Odds of 250 to 1 for each of four families of joint errors.
    assert totals.extended <= 16
    assert 0.93 < totals.inside / totals.count < 0.97
    assert np.sqrt(totals.squares / totals.bound) == pytest.approx(1, abs=0.05)
    assert np.sqrt(totals.squares / totals.claimed) == pytest.approx(1, abs=0.10)


def test_the_definitions_name_the_harmonics_of_a_joint_once():
    values = {"unit": "rad", "nominal": 0.0, "value": 0.0, "std": 1.0, "prior": 1.0, "observability": 1.0}
    names = {"a.x": "along x", **{f"a.{f}{k}": "position" for k in range(1, 65) for f in ("sin", "cos")}}
    estimates = [
        Estimate(
            name,
            **values,
            posterior_to_prior_std=1.0,
            fixed=False,
            category="robot",
            frame="joint a",
            direction=way,
        )
        for name, way in names.items()
    ]
    text = "a.x along x, a.sin1 ... cos64 (128 harmonics) position"
    assert definition_table(estimates).texts == [["joint a", text]]
