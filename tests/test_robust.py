"""Gross errors: named, and without a say in the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dhcal_pin.calibration import calibrate
from dhcal_pin.errors import DhcalError
from dhcal_pin.measurements import Noise
from dhcal_pin.poses import Pose
from dhcal_pin.positions import Position
from dhcal_pin.robust import scores


def spoiled(kind, chain, seed, m=100, share=0.1):
    """Readings with a tenth of gross errors of 50 to 500 sigma, and which these are."""
    rng = np.random.default_rng(seed)
    data = kind.simulate(chain, rng.uniform(-3, 3, (m, 6)), Noise(1e-4, 1e-4), rng)
    bad = rng.permutation(m)[: int(share * m)]
    jump = rng.normal(size=(len(bad), 3))
    jump *= (rng.uniform(50, 500, len(bad)) * 1e-4 / np.linalg.norm(jump, axis=1))[:, None]
    if kind is Pose:
        poses = data.poses.copy()
        poses[bad, :3, 3] += jump
        return data, replace(data, poses=poses), np.sort(bad) + 1
    reading = data.reading.copy()
    reading[bad] += jump
    return data, replace(data, reading=reading), np.sort(bad) + 1


def trial(kind, loss, sim_6dof, actual, seeds):
    """Held-out error over that of the clean fit, share of gross rows named, share of good rows named."""
    ratios, found, wrong = [], [], []
    for seed in range(seeds):
        clean, dirty, bad = spoiled(kind, actual, seed)
        q = np.random.default_rng(10**6 + seed).uniform(-3, 3, (200, 6))
        test = kind.simulate(actual, q, Noise(), np.random.default_rng(0))
        best = calibrate(sim_6dof, clean, "dh", priors="none").validate(test)["position_rms_m"]
        fit = calibrate(sim_6dof, dirty, "dh", priors="none", loss=loss)
        ratios.append(fit.validate(test)["position_rms_m"] / best)
        (named,) = fit.outliers
        found.append(np.isin(bad, named).mean())
        wrong.append(np.isin(named, bad, invert=True).sum() / (len(dirty.rows) - len(bad)))
    return np.array(ratios), np.mean(found), np.mean(wrong)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_gross_errors_do_not_matter_and_are_named(kind, loss, sim_6dof, sim_6dof_actual):
    ratios, found, wrong = trial(kind, loss, sim_6dof, sim_6dof_actual, 6)
    assert np.median(ratios) <= 1.15
    assert found >= 0.99
    assert wrong <= 0.01


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_gross_errors_in_200_seeds(kind, loss, sim_6dof, sim_6dof_actual):
    ratios, found, wrong = trial(kind, loss, sim_6dof, sim_6dof_actual, 200)
    print(kind.kind, loss, np.median(ratios), np.quantile(ratios, 0.95), found, wrong)
    assert np.median(ratios) <= 1.15
    assert found >= 0.99
    assert wrong <= 0.01


def test_linear_is_ruined_by_them(sim_6dof, sim_6dof_actual):
    """So that the test above can fail."""
    ratios, _, _ = trial(Position, "linear", sim_6dof, sim_6dof_actual, 3)
    assert np.median(ratios) > 5


def test_scores_of_good_samples_are_normal(sim_6dof_actual):
    for kind in (Pose, Position):
        rng = np.random.default_rng(0)
        data = kind.simulate(sim_6dof_actual, rng.uniform(-3, 3, (20000, 6)), Noise(1e-4, 2e-4), rng)
        found = scores(sim_6dof_actual, data, np.empty(0))
        np.testing.assert_allclose(np.quantile(found, [0.5, 0.841, 0.9987]), [0, 1, 3], atol=0.15)


def test_clean_data_fit_alike_with_any_loss(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (100, 6)), Noise(1e-4, 1e-4), rng)
    test = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (100, 6)), Noise(), rng)
    linear = calibrate(sim_6dof, data, "dh", priors="none").validate(test)["position_rms_m"]
    for loss in ("huber", "cauchy", "tukey"):
        fit = calibrate(sim_6dof, data, "dh", priors="none", loss=loss)
        assert fit.validate(test)["position_rms_m"] < 1.15 * linear
        assert fit.outliers[0].size == 0


def test_wrong_losses_are_named(sim_6dof, sim_6dof_actual):
    data = Pose.simulate(sim_6dof_actual, np.zeros((5, 6)), Noise(), np.random.default_rng(0))
    with pytest.raises(DhcalError, match="choose from linear, huber"):
        calibrate(sim_6dof, data, loss="l1")
    with pytest.raises(DhcalError, match="needs method lm"):
        calibrate(sim_6dof, data, method="gn", loss="huber")
