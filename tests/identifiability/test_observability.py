"""Numbers on what the data see: indices by hand, shares against many repeats, claims against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.identifiability import observability
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.robot.chain import Chain

NOISE = Noise(1e-4, np.deg2rad(0.01))


def turned(values, seed=0):
    """A triangle with these singular values."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(len(values),) * 2))[0] for _ in range(2))
    return np.linalg.qr(u * np.array(values) @ v, mode="r")


def test_indices_by_hand():
    """σ = 4, 2, 1 from four samples: ∛8/2, 1/4, 1, 1/4, 1/(1/4 + 1/2 + 1)."""
    found = observability.observability_indices(turned([4.0, 2.0, 1.0]), 4)
    assert found == pytest.approx({"O1": 1.0, "O2": 0.25, "O3": 1.0, "O4": 0.25, "O5": 4 / 7})


def test_indices_are_of_what_is_seen():
    found = observability.observability_indices(turned([4.0, 1.0, 0.0]), 1)
    assert found == pytest.approx({"O1": 2.0, "O2": 0.25, "O3": 1.0, "O4": 0.25, "O5": 0.8})
    assert set(observability.observability_indices(np.zeros((3, 3)), 1).values()) == {0.0}


def test_second_index_is_the_inverse_condition(sim_6dof):
    q = np.random.default_rng(0).uniform(-3, 3, (30, 6))
    fit = calibrate(sim_6dof, Pose.simulate(sim_6dof, q, NOISE, np.random.default_rng(0)), "dh")
    assert fit.observability_indices["O2"] == pytest.approx(1 / fit.condition)


def test_correlation_by_hand():
    found = observability.correlation(np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, np.inf]]))
    assert found[0, 1] == found[1, 0] == 0.5
    assert np.array_equal(np.diag(found), np.ones(3))
    assert found[0, 2] == 0 or np.isnan(found[0, 2])


def test_correlation_is_that_of_repeats(sim_3dof):
    """Over 100 repeats with the same joints; the spread of a correlation of 0 is 1/√100."""
    q = np.random.default_rng(0).uniform(-3, 3, (12, 3))
    fits = [
        calibrate(sim_3dof, Pose.simulate(sim_3dof, q, NOISE, np.random.default_rng(s)), "dh")
        for s in range(100)
    ]
    seen = fits[0].posterior_to_prior_std < 0.1
    repeats = np.corrcoef(np.array([fit.x[seen] for fit in fits]).T)
    assert seen.sum() >= 9
    assert np.abs(repeats - fits[0].correlation[np.ix_(seen, seen)]).max() < 0.4


def test_weak_directions_by_hand():
    """Independent parameters: with s·expected/noise = 1 the share left is 1/√2, with 10 it is known."""
    triangle = np.diag([1e3, 1e4, 0.0, 200.0])
    expected = np.array([1e-3, 1e-3, 1e-3, 5e-3])
    directions, left = observability.weakly_observable(triangle, expected, 1.0)
    np.testing.assert_allclose(left, [2**-0.5, 2**-0.5])
    np.testing.assert_allclose(np.sort(np.abs(directions).sum(1)), [0, 0, 1e-3, 5e-3], atol=1e-12)
    assert len(observability.weakly_observable(triangle, expected, 0.1)[1]) == 0
    assert len(observability.weakly_observable(triangle, expected, 10.0)[1]) == 3


def test_weak_directions_know_no_units():
    """The same unknowns in millimetres and degrees."""
    triangle, expected = turned([1e4, 1e3, 300.0, 30.0], seed=3), np.array([1e-3, 5e-3, 1e-3, 0.03])
    unit = np.array([1e3, 180 / np.pi, 1e3, 180 / np.pi])
    _, left = observability.weakly_observable(triangle, expected, 1.0)
    directions, again = observability.weakly_observable(triangle / unit, expected * unit, 1.0)
    np.testing.assert_allclose(left, again)
    np.testing.assert_allclose(np.linalg.norm(directions / (expected * unit)[:, None], axis=0), 1.0)


def test_near_parallel_axes_count_in_the_rank_and_are_named_as_weakly_seen(sim_6dof, sim_6dof_actual):
    """Offsets along nearly parallel axes: off by centimetres under priors of none, as the paper's arm is."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (30, 6)), NOISE, rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert fit.rank == 24
    assert fit.unobservable == []
    assert [text.split(":")[0] for text in fit.weakly_observable] == ["d2, d3 and d4", "d5 and d6"]
    assert all("parallel to within" in text for text in fit.weakly_observable)
    names = [p.name for p in fit.parameters]
    assert {names[i] for i in np.flatnonzero(fit.posterior_to_prior_std > 1)} == {
        "d2",
        "d3",
        "d4",
        "d5",
        "d6",
    }


def test_without_a_row_left_nothing_is_believed(sim_6dof, sim_6dof_actual):
    """Two poses without sigmas and without priors: exact fit, no noise to go by."""
    q = np.random.default_rng(0).uniform(-3, 3, (2, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert not np.any(fit.posterior_to_prior_std < 1)
    assert "nothing tells how far to believe" in fit.weakly_observable[0]
    assert "12 readings for 24 unknowns" in fit.unobservable[-1]


def claims(chain: Chain, kind, draw, seeds: int):
    """Scores of what a fit says it knows, and of all else, and how often the held-out error grew."""
    errors = select_parameters(chain, chain.parameters)
    known, others, worse = [], [], 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x = errors.priors * rng.normal(size=len(errors.parameters))
        truth = errors.at(x)
        fit = calibrate(chain, kind.simulate(truth, draw(rng), NOISE, rng))
        score = (fit.x - x) / fit.std
        sure = fit.posterior_to_prior_std < observability.MAX_KNOWN_STD_RATIO
        known += score[sure].tolist()
        others += score[~sure].tolist()
        test = Pose.simulate(truth, rng.uniform(-3, 3, (50, chain.n_joints)), Noise(), rng)
        before, after = (one.poses(test.q)[:, :3, 3] - test.poses[:, :3, 3] for one in (chain, fit.chain))
        worse += np.sum(after**2) > np.sum(before**2)
    return np.array(known), np.array(others), worse


def two(rng):
    """Two poses anywhere."""
    return rng.uniform(-3, 3, (2, 6))


def corner(rng):
    """Forty poses within ±11° a joint."""
    return 0.4 + rng.uniform(-0.2, 0.2, (40, 6))


def hold(known, others, worse, seeds):
    # Scores of one fit hang together, so allow the spread of that many fits, not of that many scores.
    share = np.mean(np.abs(known) < 1.96)
    assert share == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / seeds) + 0.005)
    assert np.mean(np.abs(others) < 1.96) > 0.90
    assert worse <= 0.01 * seeds


@pytest.mark.parametrize("kind", [Pose, Position])
@pytest.mark.parametrize("draw", [two, corner])
def test_what_is_claimed_is_so(kind, draw, sim_6dof):
    """Errors as expected, far too few poses or all in one corner: what is said to be known is."""
    hold(*claims(sim_6dof, kind, draw, 25), 25)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
@pytest.mark.parametrize("draw", [two, corner])
def test_what_is_claimed_is_so_in_200_seeds(kind, draw, sim_6dof):
    hold(*claims(sim_6dof, kind, draw, 200), 200)
