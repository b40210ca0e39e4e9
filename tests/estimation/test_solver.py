"""Solvers: loose and continued iterations, dispatch by method, and the step rules for floats and arrays."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import tracked_setup
from robots import joint_sample, measured_arm, nominal_arm
from scipy.optimize import least_squares

from dhcal_pin.calibration.cross_validation import refit
from dhcal_pin.estimation import (
    METHODS,
    Problem,
    gauss_newton,
    levenberg_marquardt,
    minimize,
    select_parameters,
)
from dhcal_pin.estimation import solver_rules as rules
from dhcal_pin.estimation.initialization import initialize_frames, make_problem
from dhcal_pin.estimation.solver import complete, next_iterate, remaining_change
from dhcal_pin.exceptions import ConvergenceError, UnknownNameError
from dhcal_pin.measurements import Noise, Position, SphereContact


def case(sim_6dof, sim_6dof_actual, sets="dh", m=20):
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_6dof_actual, rng.uniform(-3, 3, (m, 6)), Noise(1e-4), rng)
    errors = select_parameters(sim_6dof, sets)
    return Problem(errors, (data,), 1 / errors.priors)


@pytest.mark.parametrize("sets", ["dh", "minimal,base,tool"])
def test_a_warm_start_continues_a_loose_solution_exactly(sets, sim_6dof, sim_6dof_actual):
    problem = case(sim_6dof, sim_6dof_actual, sets)
    zero = np.zeros(len(problem.weights))
    full = levenberg_marquardt(problem, zero, 100)
    loose = levenberg_marquardt(problem, zero, 100, loose=True)
    continued = levenberg_marquardt(problem, loose.x, 100, warm_start=loose)
    assert full.converged
    assert continued.converged
    assert not loose.converged
    assert loose.iterations < full.iterations
    np.testing.assert_array_equal(continued.iterates, full.iterates)


@pytest.mark.parametrize("seed", [0, 10])
def test_a_loose_solution_is_not_a_step_that_damping_shortened(seed):
    """Touches of a sphere: in a curved valley a damped step is negligible, and the undamped one is not."""
    nominal = measured_arm("paper")
    errors = select_parameters(nominal, "minimal,base,tool")
    rng = np.random.default_rng(seed)
    size = np.where(errors.is_of_arm, errors.priors, 0.3)
    truth = errors.at(size * rng.uniform(-1, 1, len(size)))
    data = SphereContact.simulate(truth, joint_sample(nominal, 40, rng), Noise(1e-4), rng)
    problem = make_problem(errors, (data.initialized(nominal),), 1 / errors.priors, {})
    start = np.zeros(len(problem.weights))
    full, loose = (levenberg_marquardt(problem, start, 100, loose=loose) for loose in (False, True))
    # Loose steps change the rows by a tenth of their norm, their squares by a hundredth.
    assert problem.cost(loose.x) <= 1.02 * problem.cost(full.x)


@pytest.fixture(scope="module")
def curved_valley():
    """Return the problem of a tracker, which does not show the rotation of the tool, and a board on the tool.

    A board that turns back takes up that rotation, but moves along a circle. Images of a tool that keeps its
    orientation hardly determine the displacement of board and cameras together.
    """
    setup = tracked_setup("panda", 1e-3, 3)
    errors = initialize_frames(select_parameters(setup.nominal, "minimal,base,tool"), setup.data, {}, 100)
    positions, images = (item.initialized(errors.chain) for item in setup.data)
    images = images.with_scaled_sigma({"pixels": 0.2})
    return make_problem(errors, (positions, images), 1 / errors.priors, {})


def test_the_minimum_of_a_curved_valley_is_found(curved_valley):
    """Without the rotation of the tool, which no row needs, the minimum has the same cost."""
    start = np.zeros(len(curved_valley.weights))
    found = levenberg_marquardt(curved_valley, start, 100)
    is_rotation = np.array([p.name in ("tool.rx", "tool.ry", "tool.rz") for p in curved_valley.parameters])
    without = curved_valley.with_prior_weights(np.where(is_rotation, 1e9, curved_valley.weights))
    held = levenberg_marquardt(without, start, 100)
    assert found.converged
    assert held.converged
    assert remaining_change(curved_valley, found.x) < 0.1
    assert curved_valley.cost(found.x) == pytest.approx(curved_valley.cost(held.x), abs=0.1**2)


def test_a_fold_is_not_ended_by_an_undamped_step_that_raises_the_cost(curved_valley):
    start = np.zeros(len(curved_valley.weights))
    loose = levenberg_marquardt(curved_valley, start, 100, loose=True)
    assert curved_valley.cost(next_iterate(curved_valley, loose)) > curved_valley.cost(loose.x)
    assert complete(curved_valley, loose, 100)[1] < curved_valley.cost(loose.x)
    fit: Any = SimpleNamespace(x=start, converged=True)
    assert curved_valley.cost(refit(fit, curved_valley, start)) < curved_valley.cost(loose.x)


@pytest.mark.parametrize(
    ("remaining", "last_remaining", "expected"),
    [(0.095, 0.1, True), (0.09, math.inf, False), (0.02, 0.1, False), (0.11, 0.12, False)],
)
def test_slow_steps_end_within_a_tenth_of_the_standard_deviations(remaining, last_remaining, expected):
    assert rules.is_slow_and_short(remaining, last_remaining) == expected


def test_steps_with_curved_rows_converge():
    """A robot without unknown base and tool poses does not explain the residuals, whose curvature remains.

    Undamped steps grow or hardly shrink there. The trust region method of SciPy ends at the same cost.
    """
    chain = nominal_arm("ur10")
    placement, errors = select_parameters(chain, "placement"), select_parameters(chain, "minimal")
    n_iterations = []
    for seed in range(6):
        rng = np.random.default_rng([71, seed])
        size = np.where([p.unit == "m" for p in placement.parameters], 1e-3, 3e-3)
        truth = placement.at(size * rng.normal(size=len(size)))
        data = Position.simulate(truth, rng.uniform(-3, 3, (60, 6)), Noise(5e-5), rng)
        problem = Problem(errors, (data,), 1 / errors.priors)
        found = levenberg_marquardt(problem, np.zeros(len(problem.weights)), 100)
        assert found.converged
        n_iterations.append(found.iterations)

        def rows(x, problem=problem):
            return np.append(problem.residuals(x, problem.data)[0].ravel(), problem.weights * x)

        expected = least_squares(rows, np.zeros(len(problem.weights)), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert problem.cost(found.x) == pytest.approx(2 * expected.cost, rel=1e-9)
    assert max(n_iterations) < 40


@pytest.mark.parametrize("ratio", [-0.9, 0.5, 0.95])
def test_the_limit_of_slow_steps_is_that_of_their_geometric_series(ratio):
    step = np.array([3.0, -1.0])
    rest = sum(ratio**k * step for k in range(1, 1000))
    np.testing.assert_allclose(rules.extrapolation_factor(step, step / ratio) * step, rest, rtol=1e-9)


def test_fast_steps_and_turning_steps_are_not_extrapolated():
    step = np.array([3.0, -1.0])
    assert rules.extrapolation_factor(0.1 * step, step) == 0
    assert rules.extrapolation_factor(1.1 * step, step) == 0
    assert rules.extrapolation_factor(np.array([2.5, 0.0]), step) == 0
    assert rules.extrapolation_factor(step, np.zeros(2)) == 0


def test_undamped_steps_grow_only_above_rounding():
    assert rules.is_growing(1e-5, 2e-5, 1e-9)
    assert not rules.is_growing(2e-5, 1e-5, 1e-9)
    assert not rules.is_growing(1e-9, 2e-9, 1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_minimize_calls_the_method_and_reports_progress(method, sim_6dof, sim_6dof_actual):
    problem, seen = case(sim_6dof, sim_6dof_actual), []
    result = minimize(problem, method, progress=lambda i, cost: seen.append((i, cost)))
    alone = METHODS[method](problem, np.zeros(24), 100)
    np.testing.assert_array_equal(result.iterates, alone.iterates)
    assert [i for i, _ in seen] == list(range(1, result.iterations + 1))
    assert len(result.iterates) == result.iterations + 1


def test_minimize_names_an_unknown_method(sim_6dof, sim_6dof_actual):
    with pytest.raises(UnknownNameError, match="unknown method 'newton'; choose from lm, gn"):
        minimize(case(sim_6dof, sim_6dof_actual), "newton")


def test_gauss_newton_stops_when_it_diverges(sim_6dof, sim_6dof_actual):
    with pytest.raises(ConvergenceError, match=r"method gn.*--method lm"):
        gauss_newton(case(sim_6dof, sim_6dof_actual), np.full(24, 1e7), 100)


def test_step_rules_agree_for_floats_and_arrays():
    """Over the ranges that occur, zeros included; the cubes of Python and NumPy differ in the last digit."""
    rng = np.random.default_rng(0)
    n = 2000
    cost, predicted = 10.0 ** rng.uniform(-20, 8, n), 10.0 ** rng.uniform(-30, 8, n)
    trial = cost - predicted * rng.uniform(-2, 2, n)
    roundoff, last = 10.0 ** rng.uniform(-16, -8, n), 10.0 ** rng.uniform(-14, 2, n)
    predicted[:50], last[50:100] = 0.0, 0.0
    change = np.sqrt(cost) * 10.0 ** rng.uniform(-12, 1, n)
    damping, norm = 10.0 ** rng.uniform(-18, 18, n), np.sqrt(cost)

    def decide(cost, trial, predicted, roundoff, last, change, damping, norm):
        gain = rules.gain_ratio(cost, trial, predicted)
        within = rules.is_within_roundoff(predicted, trial, norm, roundoff)
        return (
            gain,
            rules.cost_roundoff(norm, roundoff),
            within,
            rules.is_acceptable(cost, trial, gain, within),
            rules.damping_after_acceptance(damping, gain, within),
            *rules.damping_after_rejection(damping, rules.INITIAL_GROWTH),
            rules.step_is_negligible(change, norm, last, roundoff),
        )

    columns = (cost, trial, predicted, roundoff, last, change, damping, norm)
    together = decide(*columns)
    single = [decide(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]
    for one, many in zip(zip(*single, strict=True), together, strict=True):
        np.testing.assert_allclose(np.broadcast_to(many, n).astype(float), one, rtol=1e-15, atol=0)
    # All branches occur.
    assert 0 < together[2].sum() < n
    assert 0 < together[3].sum() < n
    assert 0 < together[7].sum() < n


@pytest.mark.parametrize(
    ("gain", "factor"), [(1.0, 1e-2), (0.91, 1e-2), (0.9, 1 - 0.8**3), (0.5, 1.0), (0.25, 1.125)]
)
def test_damping_follows_the_gain_ratio(gain, factor):
    assert rules.damping_after_acceptance(1.0, gain, False) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("trial_cost", "predicted", "accepted"),
    [
        (0.5, 0.6, True),
        # A thousandth of the predicted reduction is the least (Nocedal and Wright, algorithm 4.1, η > 0).
        (1 - 2e-3, 1.0, True),
        (1 - 5e-4, 1.0, False),
        (1.0, 1.0, False),
        (1 + 1e-6, 1.0, False),
        (2.0, -1.0, False),
    ],
)
def test_a_step_must_reduce_the_cost_by_a_part_of_the_prediction(trial_cost, predicted, accepted):
    gain = rules.gain_ratio(1.0, trial_cost, predicted)
    assert bool(rules.is_acceptable(1.0, trial_cost, gain, False)) is accepted


def test_undamped_steps_become_rarer():
    due, last = [], 0
    for iteration in range(1, 100):
        if rules.undamped_steps_are_due(iteration, last):
            due.append(iteration)
            last = iteration
    assert due == [8, 16, 32, 64]


def test_divergence_includes_what_is_not_finite():
    x = np.array([[0.0, 1.0], [0.0, 2e6], [np.nan, 0.0], [np.inf, 0.0]])
    assert rules.has_diverged(x).tolist() == [False, True, True, True]
