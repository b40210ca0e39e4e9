"""Reweighting: standard deviations that instruments do not state are estimated with the fit."""

from __future__ import annotations

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate, reweighting
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
