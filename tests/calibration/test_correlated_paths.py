"""Recorded paths, on which neighbours share slow noise that joint errors could imitate."""

import numpy as np
import pytest
from robots import nominal_arm, with_small_errors
from scipy.interpolate import CubicSpline
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.calibration.partition import path_folds
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Position

SLOW_NOISE, NOISE = 1.5e-4, 5e-5  # Standard deviations of a coordinate [m]
LENGTH = 8  # Number of samples in which the slow noise decays to 1/e
TOTAL = float(np.sqrt(3 * (SLOW_NOISE**2 + NOISE**2)))


def path(rng, m, n_knots, n_joints=6):
    """Return joint values (m, n) along a smooth path through random configurations."""
    knots = rng.uniform(-1.5, 1.5, (n_knots, n_joints))
    return CubicSpline(np.arange(n_knots), knots)(np.linspace(0, n_knots - 1, m))


def slow_noise(rng, m):
    """Return a stationary noise (m, 3) whose correlation decays exponentially [m]."""
    decay = np.exp(-1 / LENGTH)
    steps = SLOW_NOISE * rng.standard_normal((m, 3))
    steps[1:] *= np.sqrt(1 - decay**2)
    for i in range(1, m):
        steps[i] += decay * steps[i - 1]
    return steps


def recorded(seed, m, n_knots):
    """Return a nominal UR10, the true one, and positions with slow noise along a path."""
    rng, nominal = np.random.default_rng(seed), nominal_arm("ur10")
    true = with_small_errors(nominal, rng)
    q = path(rng, m, n_knots)
    exact = true.poses(q)[:, :3, 3]
    return nominal, true, Position(q, exact + slow_noise(rng, m) + NOISE * rng.standard_normal((m, 3)))


def true_error(fit, true, seed):
    """Return the RMS position error along another path [m]."""
    q = path(np.random.default_rng(1000 + seed), 400, 40)
    return np.sqrt(np.mean(np.sum((fit.chain.poses(q)[:, :3, 3] - true.poses(q)[:, :3, 3]) ** 2, 1)))


@pytest.mark.parametrize("seed", some_slow(range(12), {0}))
def test_joint_errors_do_not_adapt_to_slow_noise(seed):
    """They increased the true error by up to 50 %, with a smaller stated error."""
    nominal, true, data = recorded(seed, 1500, 25)
    fits = [calibrate(nominal, data, extend=extend, session="off") for extend in ("auto", "none")]
    errors = [true_error(fit, true, seed) for fit in fits]
    assert errors[0] < 1.2 * errors[1]


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_the_stated_error_contains_slow_noise(seed):
    """Random folds were judged by the neighbours of their samples: 0.7 to 0.8 of the noise."""
    nominal, _, data = recorded(seed, 500, 8)
    fit = calibrate(nominal, data, session="off")
    assert fit.random_folds
    assert fit.random_folds.comparison.after.groups["position"].rms > 0.9 * TOTAL


@pytest.mark.parametrize("seed", some_slow(range(8), {0}))
def test_joint_errors_that_are_there_are_found_along_a_path(seed):
    rng, nominal = np.random.default_rng(seed), nominal_arm("ur10")
    errors = select_parameters(nominal, "minimal,base,tool,harmonics")
    x = rng.standard_normal(len(errors.parameters)) * np.minimum(errors.priors, 1e-2)
    true = errors.at(x)
    data = Position.simulate(true, path(rng, 1000, 25), Noise(NOISE), rng).replace(has_stated_sigma=False)
    assert path_folds([data], 5) is not None
    fit = calibrate(nominal, data, session="off")
    assert fit.extension
    assert "harmonics" in fit.extension.families
    assert true_error(fit, true, seed) < NOISE


def test_only_dense_paths_are_divided_into_parts():
    rng = np.random.default_rng(0)
    for q, is_path in (
        (path(rng, 1000, 25), True),
        (path(rng, 100, 25), False),
        (path(rng, 130, 10), False),  # smooth, but with steps of 0.3 rad
        (path(rng, 60, 3), False),
        (rng.uniform(-2, 2, (1000, 6)), False),
        (rng.uniform(-2, 2, (1000, 2)), False),
        (np.repeat(rng.uniform(-2, 2, (20, 6)), 50, 0), False),
    ):
        folds = path_folds([Position(q, q[:, :3] if q.shape[1] > 2 else np.zeros((len(q), 3)))], 5)
        assert (folds is not None) == is_path
        if folds is not None:
            held_out = np.stack([fold[0] for fold in folds])
            np.testing.assert_array_equal(held_out.sum(0), 1)
            # Neighbours are mostly held out together.
            assert np.sum(held_out[:, :-1] != held_out[:, 1:]) < 0.2 * len(q)
            order = rng.permutation(len(q))
            again = path_folds([Position(q[order], q[order, :3])], 5)
            assert again is not None
            np.testing.assert_array_equal(np.stack([fold[0] for fold in again]), held_out[:, order])
