"""Gross errors: named, and without a say in the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.calibration.summary import headline
from dhcal_pin.estimation.problem import linearize_and_factor
from dhcal_pin.estimation.robust import residual_covariances, standardized_residuals
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.length import Wires
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.report.context import ReportContext
from dhcal_pin.report.document import Provenance
from dhcal_pin.report.figures import accuracy_figures


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
        return data, data.replace(poses=poses), np.sort(bad) + 1
    reading = data.values.copy()
    reading[bad] += jump
    return data, data.replace(values=reading), np.sort(bad) + 1


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


@pytest.mark.parametrize("loss", ["auto", "huber", "cauchy", "tukey"])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_gross_errors_do_not_matter_and_are_named(kind, loss, sim_6dof, sim_6dof_actual):
    ratios, found, wrong = trial(kind, loss, sim_6dof, sim_6dof_actual, 6)
    assert np.median(ratios) <= 1.15
    assert found >= 0.99
    assert wrong <= 0.01


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["auto", "huber", "cauchy", "tukey"])
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
        found = standardized_residuals(data.residual(sim_6dof_actual.forward_kinematics(data.q), np.empty(0)))
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


def test_two_gross_errors_among_few_readings_are_named_and_do_not_matter(sim_6dof, sim_6dof_actual):
    for seed in range(5):
        clean, dirty, bad = spoiled(Position, sim_6dof_actual, seed, m=30, share=0.07)
        best, fit = calibrate(sim_6dof, clean, "dh"), calibrate(sim_6dof, dirty, "dh")
        np.testing.assert_array_equal(fit.outliers[0], bad)
        q = np.random.default_rng(100 + seed).uniform(-3, 3, (200, 6))
        test = Position.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
        error, least = (one.validate(test)["position_rms_m"] for one in (fit, best))
        assert error < 1.3 * least


@pytest.mark.parametrize("loss", ["auto", "huber", "tukey"])
def test_good_samples_among_few_readings_are_not_named(loss, sim_6dof, sim_6dof_actual):
    """45 readings for 23 directions: half of each sample is drawn to the fit, of some nearly all."""
    for seed in range(10):
        data, _, _ = spoiled(Position, sim_6dof_actual, seed, m=15)
        fit = calibrate(sim_6dof, data, "dh", loss=loss)
        assert fit.outliers[0].size == 0
        if loss == "auto":
            np.testing.assert_array_equal(fit.x, calibrate(sim_6dof, data, "dh", loss="linear").x)


def test_spreads_of_residuals_are_those_of_many_draws(sim_6dof, sim_6dof_actual):
    """Of samples in the fit, and of one that is not."""
    q = np.random.default_rng(0).uniform(-3, 3, (14, 6))
    exact = Position.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    weights = np.where(np.arange(14) == 3, 1e-12, 1.0)
    fit = calibrate(sim_6dof, Position(q, exact.values, np.full((14, 3), 1e-4)), "dh", priors="none")
    problem = fit.problem.with_data([fit.problem.data[0].with_weights(weights)])
    solution = replace(fit.solution, system=linearize_and_factor(problem, fit.x, small_angle=False))
    expected = residual_covariances(problem, solution, [weights])[0]
    # Linear least squares by numpy on the same rows, its misses over many draws of noise.
    rows = problem.linearize(fit.x).rows(fit.problem.chunks[0])[:-1].transpose(2, 1, 0).reshape(42, -1)
    noise = np.random.default_rng(1).normal(size=(42, 20000))
    root = np.sqrt(np.repeat(weights, 3))[:, None]
    missed = noise - rows @ np.linalg.pinv(root * rows, rcond=1e-9) @ (root * noise)
    for sample in (3, 5):
        drawn = np.cov(missed.reshape(14, 3, -1)[sample])
        np.testing.assert_allclose(drawn, expected[sample], atol=0.05 * np.abs(expected[sample]).max())


def test_wrong_losses_are_named(sim_6dof, sim_6dof_actual):
    data = Pose.simulate(sim_6dof_actual, np.zeros((5, 6)), Noise(), np.random.default_rng(0))
    with pytest.raises(DhcalError, match="choose from auto, linear, huber"):
        calibrate(sim_6dof, data, loss="l1")
    with pytest.raises(DhcalError, match="requires method 'lm'"):
        calibrate(sim_6dof, data, method="gn", loss="huber")


def test_what_is_told_of_a_fit_is_of_the_samples_that_count(sim_6dof, sim_6dof_actual):
    """A gross error of 40 mm is in no figure of the fit, and in those of what was held out beside them."""
    clean, dirty, _ = spoiled(Position, sim_6dof_actual, 3, m=60, share=0.05)
    best, fit = calibrate(sim_6dof, clean, "dh"), calibrate(sim_6dof, dirty, "dh")
    told, expected = fit.comparisons[0], best.comparisons[0]
    assert (told.n_samples, told.n_rejected) == (57, 3)
    assert told.after["position_rms_m"] < 1.3 * expected.after["position_rms_m"]
    assert "3 outliers rejected." in headline(fit.comparisons).text
    figures = accuracy_figures(ReportContext.from_result(fit, Provenance()))[0]
    assert figures.panels[0].caption == "Position error, 57 fitted samples"
    held = calibrate(sim_6dof, clean, "dh", holdout=[dirty]).comparisons[0]
    assert (held.n_samples, held.n_outliers) == (60, 3)
    assert held.after["position_rms_m"] > 10 * held.after_without_outliers["position_rms_m"]
    assert "without 3 outliers" in headline([held]).text


def test_only_the_worst_gross_errors_are_left_aside_unasked(sim_6dof, sim_6dof_actual):
    """Nine sigmas at one pose may be the model's own error; four hundred are not."""
    q = np.random.default_rng(3).uniform(-3, 3, (60, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(1e-4, 1e-4), np.random.default_rng(3))
    poses = data.poses.copy()
    poses[[5, 20], :3, 3] += [[9e-4, 0, 0], [0, 4e-2, 0]]
    fit = calibrate(sim_6dof, data.replace(poses=poses), "dh")
    assert fit.outliers[0].tolist() == [6, 21]
    assert np.flatnonzero(fit.weights[0] < 0.5).tolist() == [20]


def test_what_samples_draw_to_themselves_is_a_share_of_the_unknowns(sim_6dof, sim_6dof_actual):
    """Wires leave base and anchors where their wide priors have them, and these have no say in it."""
    rng = np.random.default_rng(4)
    data = Wires.simulate(sim_6dof_actual, rng.uniform(-3, 3, (60, 6)), Noise(1e-4), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool")
    rows = fit.problem.linearize(fit.x).rows(fit.problem.chunks[0])[:-1].transpose(2, 1, 0).reshape(180, -1)
    basis = np.linalg.qr(np.concatenate([rows, np.diag(fit.problem.weights)]))[0][:180].reshape(60, 3, -1)
    drawn = np.eye(3) - residual_covariances(fit.problem, fit.solution, fit.weights)[0]
    np.testing.assert_allclose(drawn, basis @ basis.transpose(0, 2, 1), atol=1e-4)
    assert fit.outliers[0].size == 0
