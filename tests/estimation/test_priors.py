"""Priors: limits, and their scale from the errors that the data show."""

from dataclasses import replace

import numpy as np
import pytest

from dhcal_pin.estimation import Problem, levenberg_marquardt, select_parameters
from dhcal_pin.estimation.priors import MAX_WIDENING, group_default_priors, prior_weights, update_prior_scales
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.measurements import Noise, Pose


def solved(nominal, error_scale: float):
    """Precise poses of a robot whose errors are the expected ones times a factor."""
    rng = np.random.default_rng(0)
    errors = select_parameters(nominal, "dh")
    truth = errors.at(error_scale * errors.priors * rng.standard_normal(len(errors.parameters)))
    data = Pose.simulate(truth, rng.uniform(-3, 3, (100, 6)), Noise(1e-7, 1e-7), rng)
    weights = prior_weights(errors, "default")
    problem = Problem(errors, (data,), weights)
    groups = group_default_priors(errors, weights, np.full(len(weights), True))
    return problem, levenberg_marquardt(problem, np.zeros(len(weights)), 100), groups


def test_no_prior_becomes_narrower_than_the_narrowest_expected_one_of_its_unit(sim_6dof):
    """A robot without errors would otherwise get priors of zero width."""
    problem, solution, groups = solved(sim_6dof, 0.0)
    weights = update_prior_scales(problem, solution, groups)
    units = [parameter.unit for parameter in problem.errors.parameters]
    for unit in set(units):
        chosen = [i for i, other in enumerate(units) if other == unit]
        # The wider priors become narrower, the narrowest ones stay.
        narrowest = problem.weights[chosen].max()
        is_wider = problem.weights[chosen] < 0.9 * narrowest
        assert (weights[chosen][is_wider] > 2 * problem.weights[chosen][is_wider]).all()
        assert weights[chosen].max() == pytest.approx(narrowest, rel=1e-12)


@pytest.mark.parametrize("scale", [3.0, 10.0])
def test_priors_widen_to_the_errors_that_precise_data_show(sim_6dof, scale):
    """With data that determine everything, the width of a group is the RMS of its errors."""
    problem, solution, groups = solved(sim_6dof, scale)
    weights = update_prior_scales(problem, solution, groups)
    for group in groups:
        rms = np.sqrt(np.mean(solution.x[group.members] ** 2))
        assert rms > 1 / group.expected_weight
        np.testing.assert_allclose(1 / weights[group.members], rms, rtol=0.06)


def test_one_large_error_does_not_widen_the_priors_without_limit(sim_6dof):
    problem, solution, groups = solved(sim_6dof, 1.0)
    group = groups[0]
    x = solution.x.copy()
    x[group.members[0]] = 1000 / group.expected_weight
    weights = update_prior_scales(problem, replace(solution, x=x), groups)
    np.testing.assert_allclose(weights[group.members], group.expected_weight / MAX_WIDENING, rtol=1e-12)


def test_groups_have_their_own_widths_and_limits(sim_6dof):
    problem, solution, groups = solved(sim_6dof, 10.0)
    first, second = groups[:2]
    alone = update_prior_scales(problem, solution, groups)
    limited = replace(second, min_weight=second.expected_weight)
    together = update_prior_scales(problem, solution, (first, limited))
    np.testing.assert_array_equal(together[first.members], alone[first.members])
    # The errors are ten times the expected ones, but the second group must not become wider.
    np.testing.assert_array_equal(together[second.members], second.expected_weight)


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-13, 1e7, np.nan, np.inf])
def test_standard_deviations_beyond_the_limits_are_refused(sim_6dof, value):
    with pytest.raises(InvalidArgumentError, match=r"prior for 'a1': .* must be positive, from 1e-12 to"):
        prior_weights(select_parameters(sim_6dof, "dh"), {"a1": value})
