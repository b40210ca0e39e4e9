"""Observability indices by hand, correlations against repetitions, standard deviations against the truth."""

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.qr import TriangularSystem
from dhcal_pin.identifiability import observability
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.robot import Chain

pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = Noise(1e-4, np.deg2rad(0.01))


def r_factor_with(values, seed=0):
    """Build an R factor with these singular values."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(len(values),) * 2))[0] for _ in range(2))
    return np.asarray(np.linalg.qr(u * np.array(values) @ v, mode="r"))


def system_of(r):
    """Build a triangular system without right-hand side."""
    return TriangularSystem(np.pad(r, (0, 1)))


def test_indices_by_hand():
    """σ = 4, 2, 1 from four samples: ∛8/2, 1/4, 1, 1/4, 1/(1/4 + 1/2 + 1)."""
    found = observability.observability_indices(system_of(r_factor_with([4.0, 2.0, 1.0])), 4)
    assert found == pytest.approx({"O1": 1.0, "O2": 0.25, "O3": 1.0, "O4": 0.25, "O5": 4 / 7})


def test_indices_ignore_unobservable_directions():
    found = observability.observability_indices(system_of(r_factor_with([4.0, 1.0, 0.0])), 1)
    assert found == pytest.approx({"O1": 2.0, "O2": 0.25, "O3": 1.0, "O4": 0.25, "O5": 0.8})
    assert set(observability.observability_indices(system_of(np.zeros((3, 3))), 1).values()) == {0.0}


def test_second_index_is_the_inverse_condition(sim_6dof):
    q = np.random.default_rng(0).uniform(-3, 3, (30, 6))
    fit = calibrate(
        sim_6dof, Pose.simulate(sim_6dof, q, NOISE, np.random.default_rng(0)), "dh", extend="none"
    )
    assert fit.observability_indices["O2"] == pytest.approx(1 / fit.condition)


def test_correlation_by_hand():
    found = observability.correlation(np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, np.inf]]))
    assert found[0, 1] == found[1, 0] == 0.5
    assert np.array_equal(np.diag(found), np.ones(3))
    assert found[0, 2] == 0 or np.isnan(found[0, 2])


def test_correlation_agrees_with_repetitions(sim_3dof):
    """100 repetitions at the same poses; the standard deviation of a correlation of 0 is 1/√100."""
    q = np.random.default_rng(0).uniform(-3, 3, (12, 3))
    fits = [
        calibrate(sim_3dof, Pose.simulate(sim_3dof, q, NOISE, np.random.default_rng(s)), "dh", extend="none")
        for s in range(100)
    ]
    seen = fits[0].posterior_to_prior_std < 0.1
    repeats = np.corrcoef(np.array([fit.x[seen] for fit in fits]).T)
    assert seen.sum() >= 9
    assert np.abs(repeats - fits[0].correlation[np.ix_(seen, seen)]).max() < 0.4


def test_weak_directions_by_hand():
    """Independent parameters: s·prior/noise = 1 gives a ratio of 1/√2, a value of 10 is known."""
    system = system_of(np.diag([1e3, 1e4, 0.0, 200.0]))
    expected = np.array([1e-3, 1e-3, 1e-3, 5e-3])
    directions, ratios = observability.weakly_observable(system, expected, 1.0)
    np.testing.assert_allclose(ratios, [2**-0.5, 2**-0.5])
    np.testing.assert_allclose(np.sort(np.abs(directions).sum(1)), [0, 0, 1e-3, 5e-3], atol=1e-12)
    assert len(observability.weakly_observable(system, expected, 0.1)[1]) == 0
    assert len(observability.weakly_observable(system, expected, 10.0)[1]) == 3


def test_weak_directions_do_not_depend_on_units():
    """Metres and radians against millimetres and degrees."""
    triangle, expected = r_factor_with([1e4, 1e3, 300.0, 30.0], seed=3), np.array([1e-3, 5e-3, 1e-3, 0.03])
    unit = np.array([1e3, 180 / np.pi, 1e3, 180 / np.pi])
    _, ratios = observability.weakly_observable(system_of(triangle), expected, 1.0)
    directions, again = observability.weakly_observable(system_of(triangle / unit), expected * unit, 1.0)
    np.testing.assert_allclose(ratios, again)
    np.testing.assert_allclose(np.linalg.norm(directions / (expected * unit)[:, None], axis=0), 1.0)


def test_nearly_parallel_axes_count_in_the_rank_and_are_poorly_identified(sim_6dof, sim_6dof_actual):
    """Offsets along nearly parallel axes have errors of centimetres without priors, as in the paper."""
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


def test_fit_without_redundancy_has_unknown_accuracy(sim_6dof, sim_6dof_actual):
    """Two poses without standard deviations and priors: the fit is exact and the noise is unknown."""
    q = np.random.default_rng(0).uniform(-3, 3, (2, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert not np.any(fit.posterior_to_prior_std < 1)
    assert "the accuracy of all parameters is unknown" in fit.weakly_observable[0]
    assert "12 equations for 24 parameters" in fit.unobservable[-1]


def standardized_errors(chain: Chain, kind, draw, seeds: int):
    """Return scores of known and of other parameters, and how often the hold-out error grew."""
    errors = select_parameters(chain, chain.parameters)
    known, others, worse = [], [], 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x = errors.priors * rng.normal(size=len(errors.parameters))
        truth = errors.at(x)
        fit = calibrate(chain, kind.simulate(truth, draw(rng), NOISE, rng), extend="none")
        score = (fit.x - x) / fit.std
        is_known = fit.posterior_to_prior_std < observability.MAX_KNOWN_STD_RATIO
        known += score[is_known].tolist()
        others += score[~is_known].tolist()
        test = Pose.simulate(truth, rng.uniform(-3, 3, (50, chain.n_joints)), Noise(), rng)
        before, after = (one.poses(test.q)[:, :3, 3] - test.poses[:, :3, 3] for one in (chain, fit.chain))
        worse += np.sum(after**2) > np.sum(before**2)
    return np.array(known), np.array(others), worse


def draw_two(rng):
    """Draw two poses over the full range."""
    return rng.uniform(-3, 3, (2, 6))


def draw_corner(rng):
    """Draw forty poses within ±11° per joint."""
    return 0.4 + rng.uniform(-0.2, 0.2, (40, 6))


def check_coverage(known, others, worse, seeds):
    # The scores of one fit are correlated, so the bound uses the number of fits, not of scores.
    coverage = np.mean(np.abs(known) < 1.96)
    assert coverage == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / seeds) + 0.005)
    assert np.mean(np.abs(others) < 1.96) > 0.90
    assert worse <= 0.01 * seeds


@pytest.mark.parametrize("kind", [Pose, Position])
@pytest.mark.parametrize("draw", [draw_two, draw_corner])
def test_stated_accuracy_is_true(kind, draw, sim_6dof):
    """Errors drawn from the priors, too few poses or all in one corner: stated intervals cover the truth."""
    check_coverage(*standardized_errors(sim_6dof, kind, draw, 25), 25)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
@pytest.mark.parametrize("draw", [draw_two, draw_corner])
def test_stated_accuracy_is_true_in_200_seeds(kind, draw, sim_6dof):
    check_coverage(*standardized_errors(sim_6dof, kind, draw, 200), 200)
