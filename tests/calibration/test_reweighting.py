"""Reweighting: standard deviations that instruments do not state are estimated with the fit."""

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate, reweighting
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.priors import effective_parameters
from dhcal_pin.estimation.robust import SolvedProblem
from dhcal_pin.measurements import Noise, PointContact, PointDistance, Pose

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")


@pytest.mark.parametrize(("stated", "expected"), [(False, 1e-4), (True, 1e-3)])
def test_single_distance_takes_the_pooled_noise(sim_6dof, sim_6dof_actual, stated, expected):
    """It can be fitted exactly, so it takes the noise of the contacts, or the placeholder."""
    rng = np.random.default_rng(4)
    contacts = PointContact.simulate(sim_6dof_actual, rng.uniform(-2.5, 2.5, (200, 6)), Noise(1e-4), rng)
    initialized = contacts.initialized(sim_6dof_actual)
    points = np.reshape([parameter.nominal for parameter in initialized.instrument_parameters], (-1, 3))
    distance = np.linalg.norm(points[1] - points[0]) + 1e-3
    known = PointDistance(6, [(contacts.names[0], contacts.names[1])], [distance])
    names = [contacts.names[i] for i in contacts.label]
    data = PointContact(contacts.q, names, 1e-4 if stated else None)
    fit = calibrate(sim_6dof, [data, known], "minimal,tool")
    assert fit.problem.data[1].sigma.item() == pytest.approx(expected, rel=0.2)


def test_unstated_standard_deviations_are_estimated(sim_6dof, sim_6dof_actual):
    """Positions 20 times worse than the placeholder and rotations 20 times better."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (300, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(2e-2, 5e-5), rng)
    fit = calibrate(sim_6dof, Pose(q, data.poses), "dh")
    (used,) = fit.problem.data
    assert used.sigma.mean() == pytest.approx(2e-2, rel=0.1)
    assert used.rotation_sigma.mean() == pytest.approx(5e-5, rel=0.1)


def test_noise_estimated_from_few_poses_has_no_bias(sim_6dof, sim_6dof_actual):
    """Eight poses, 48 rows and 24 parameters: without the degrees of freedom the variance is half of it."""
    variances = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        data = Pose.simulate(sim_6dof_actual, rng.uniform(-2.5, 2.5, (8, 6)), Noise(1e-4, 1e-4), rng)
        fit = calibrate(sim_6dof, Pose(data.q, data.poses), "dh", priors="none", loss="linear")
        (used,) = fit.problem.data
        variances.append((np.mean(used.sigma**2) + np.mean(used.rotation_sigma**2)) / 2)
    assert np.mean(variances) == pytest.approx(1e-8, rel=0.15)


@pytest.mark.parametrize("max_rounds", [2, 3, 30])
def test_the_last_solution_is_iterated_to_full_convergence(
    sim_6dof, sim_6dof_actual, monkeypatch, max_rounds
):
    """Early rounds stop loosely; the last one does not, even if the rounds are used up."""
    monkeypatch.setattr(reweighting, "MAX_ROUNDS", max_rounds)
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (30, 6)), Noise(3e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, Pose(data.q, data.poses), "dh")
    assert fit.converged
    assert fit.is_converged(1e-7)


def test_stated_standard_deviations_are_kept(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (50, 6)), Noise(2e-2, 5e-5), rng)
    (used,) = calibrate(sim_6dof, data, "dh").problem.data
    np.testing.assert_array_equal(used.sigma, data.sigma)


def test_leverages_are_those_of_the_orthogonal_projection(sim_6dof, sim_6dof_actual):
    """Positions and rotations lose different numbers of degrees of freedom, effective parameters in sum."""
    rng = np.random.default_rng(1)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-2.5, 2.5, (15, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, data, "dh,harmonics")
    problem, solution = fit.problem, fit.solution
    rows = problem.linearize(solution.x).rows(problem.chunks[0])[:-1].reshape(len(solution.x), -1).T
    basis = np.linalg.qr(np.concatenate([rows, np.diag(problem.weights)]))[0][:90]
    wanted = np.sum(basis.reshape(2, 45, -1) ** 2, (1, 2))
    solved = SolvedProblem(problem, solution)
    found = reweighting.leverages(solved, np.array([45.0, 45.0]))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    assert found.sum() == pytest.approx(effective_parameters(problem, solution), rel=1e-6)
    many = reweighting.leverages(solved, np.array([1e6, 3e6]))
    np.testing.assert_allclose(many, found.sum() * np.array([0.25, 0.75]), rtol=1e-6)


def test_noise_of_each_group_has_no_bias_with_families_of_joint_errors(sim_6dof, sim_6dof_actual):
    """20 poses and up to 84 parameters; an equal share would bias positions by 12 and rotations by -17 %."""
    harmonics, ratios = select_parameters(sim_6dof_actual, "harmonics"), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = harmonics.at(harmonics.priors * rng.standard_normal(len(harmonics.parameters)))
        data = Pose.simulate(truth, rng.uniform(-2.5, 2.5, (20, 6)), Noise(1e-4, 1e-4), rng)
        fit = calibrate(sim_6dof, Pose(data.q, data.poses), "dh", extend=["harmonics"])
        (used,) = fit.problem.data
        ratios.append(np.log([np.median(used.sigma) / 1e-4, np.median(used.rotation_sigma) / 1e-4]))
    np.testing.assert_allclose(np.mean(ratios, 0), 0.0, atol=0.1)


def test_noise_of_one_group_does_not_vanish_with_many_coefficients(sim_6dof, sim_6dof_actual):
    """30 poses and hundreds of coefficients; with an equal share rotations were fitted exactly."""
    families = ("harmonics", "curves", "fine-curves")
    errors = select_parameters(sim_6dof_actual, ",".join(families))
    rng = np.random.default_rng(0)
    truth = errors.at(errors.priors * rng.standard_normal(len(errors.parameters)))
    data = Pose.simulate(truth, rng.uniform(-2.5, 2.5, (30, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(sim_6dof, Pose(data.q, data.poses), "dh", extend=families)
    (used,) = fit.problem.data
    assert len(fit.x) > 200
    for sigma in used.sigma, used.rotation_sigma:
        assert 0.1 < np.median(sigma) / 1e-4 < 10
