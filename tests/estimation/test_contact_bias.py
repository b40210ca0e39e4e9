"""Bias of estimates from contacts, compared with the mean of many simulated fits."""

import numpy as np
import pytest
from servo_arms import SO101, TIP
from slow_cases import some_slow

from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.contacts import contact_bias
from dhcal_pin.estimation.contacts.scale_gauge import ScaleGauge
from dhcal_pin.estimation.initialization import align, make_problem
from dhcal_pin.estimation.solver import minimize
from dhcal_pin.measurements import Noise, PointContact, Position, SphereContact
from dhcal_pin.robot import Chain

CHAIN = Chain.from_urdf(SO101, TIP)
ERRORS = select_parameters(CHAIN, "low-cost,tool")
TEST_Q = np.random.default_rng(1).uniform(-1, 1, (60, 5))


def fitted(kind, seed, noise=3e-3):
    """Fit an arm without errors; return the problem and its solution."""
    q = np.random.default_rng(0).uniform(-1.2, 1.2, (80, 5))
    data = kind.simulate(CHAIN, q, Noise(noise), np.random.default_rng(seed)).initialized(CHAIN)
    problem = make_problem(ERRORS, (data,), 1 / ERRORS.priors, {})
    return problem, minimize(problem)


def displacements(x):
    """Return the displacements of the tool (60, 3) by errors of the arm on the base that fits best [m]."""
    expected = CHAIN.poses(TEST_Q)[:, :3, 3]
    points = ERRORS.at(x).poses(TEST_Q)[:, :3, 3]
    base = align(points, expected)[0]
    return points @ base[:3, :3].T + base[:3, 3] - expected


def rms(displacements):
    """RMS length of displacements (..., 3)."""
    return float(np.sqrt(np.mean(np.sum(displacements**2, -1))))


@pytest.mark.parametrize("kind", some_slow([PointContact, SphereContact], {0}))
def test_bias_is_the_mean_error_of_many_fits(kind):
    found, predicted = [], []
    for seed in range(60):
        problem, solution = fitted(kind, seed)
        root = solution.system.sqrt_covariance(problem.weights)[0]
        count = len(ERRORS.parameters)
        found.append(displacements(solution.x[:count]))
        predicted.append(displacements(contact_bias(problem, solution.x, root)[:count]))
    mean, bias = np.mean(found, 0), np.mean(predicted, 0)
    assert rms(mean) > 1e-3
    assert rms(mean - bias) < 0.35 * rms(mean)


def test_an_arm_that_is_measured_at_one_configuration_keeps_its_size():
    """Distances from the mean position would be rounding errors."""
    gauge = ScaleGauge.from_configurations(CHAIN, np.tile(TEST_Q[:1], (4, 1)))
    assert gauge.nominal == 0.0
    larger = ERRORS.at(np.full(len(ERRORS.parameters), 1e-3))
    assert gauge.size(larger) == 1.0
    moving = ScaleGauge.from_configurations(CHAIN, TEST_Q)
    assert 0.9 < moving.size(larger) < 1.1
    assert moving.size(larger) != 1.0


def test_positions_have_no_bias():
    q = np.random.default_rng(0).uniform(-1.2, 1.2, (20, 5))
    data = Position.simulate(CHAIN, q, Noise(1e-3), np.random.default_rng(0))
    problem = make_problem(ERRORS, (data,), 1 / ERRORS.priors, {})
    assert not contact_bias(problem, np.zeros(len(problem.weights)), np.eye(len(problem.weights))).any()
