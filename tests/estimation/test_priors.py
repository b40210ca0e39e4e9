"""Priors: limits, and their scale from the errors that the data show."""

from __future__ import annotations

import numpy as np
import pytest

from dhcal_pin.estimation import Problem, levenberg_marquardt, select_parameters
from dhcal_pin.estimation.priors import PriorGroups, prior_weights, update_prior_scales
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
    groups = PriorGroups.from_expected(errors, weights, np.full(len(weights), True))
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
    for members, expected in groups.groups():
        rms = np.sqrt(np.mean(solution.x[members] ** 2))
        assert rms > 1 / expected
        np.testing.assert_allclose(1 / weights[members], rms, rtol=0.06)


def test_joined_groups_keep_their_own_widths_and_limits(sim_6dof):
    problem, solution, groups = solved(sim_6dof, 10.0)
    first, second = (np.flatnonzero(groups.group_index == i) for i in (0, 1))
    parts = [
        PriorGroups(
            groups.members[chosen],
            np.zeros(len(chosen), int),
            groups.expected_weights[i : i + 1],
            limit * groups.expected_weights[i : i + 1],
            groups.max_weights[i : i + 1],
            groups.expectation_counts[i : i + 1],
        )
        for i, (chosen, limit) in enumerate([(first, 0.0), (second, 1.0)])
    ]
    alone = update_prior_scales(problem, solution, groups)
    together = update_prior_scales(problem, solution, parts[0].joined(parts[1]))
    np.testing.assert_array_equal(together[groups.members[first]], alone[groups.members[first]])
    # The errors are ten times the expected ones, but the second group must not become wider.
    np.testing.assert_array_equal(together[groups.members[second]], groups.expected_weights[1])


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-13, 1e7, np.nan, np.inf])
def test_standard_deviations_beyond_the_limits_are_refused(sim_6dof, value):
    with pytest.raises(InvalidArgumentError, match=r"prior for 'a1': .* must be positive, from 1e-12 to"):
        prior_weights(select_parameters(sim_6dof, "dh"), {"a1": value})
