"""Robust losses: outliers are reported and have no influence on the result."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from slow_cases import some_slow

from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.summary import headline
from dhcal_pin.estimation import LOSSES, linearize_and_factor
from dhcal_pin.estimation.robust import (
    CHI_SQUARE_DECILES,
    FAR_REJECTED,
    FAR_THRESHOLD,
    KEPT,
    MIN_VARIANCE,
    TRIMMED,
    WEIGHT_FUNCTIONS,
    ZERO_WEIGHT,
    SolvedProblem,
    WeightChange,
    is_chi_square,
    reject_groups,
    residual_covariances,
    sample_weights,
    standardized_residuals,
    update_weights,
)
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import Noise, Pose, Position, Wires
from dhcal_pin.report.context import ReportContext
from dhcal_pin.report.figures import accuracy_figures
from dhcal_pin.report.provenance import Provenance

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")


def with_outliers(kind, chain, seed, m=100, fraction=0.1):
    """Return clean measurements, the same with outliers of 50 to 500 sigma, and the rows of the outliers."""
    rng = np.random.default_rng(seed)
    data = kind.simulate(chain, rng.uniform(-3, 3, (m, 6)), Noise(1e-4, 1e-4), rng)
    bad = rng.permutation(m)[: int(fraction * m)]
    jump = rng.normal(size=(len(bad), 3))
    jump *= (rng.uniform(50, 500, len(bad)) * 1e-4 / np.linalg.norm(jump, axis=1))[:, None]
    if kind is Pose:
        poses = data.poses.copy()
        poses[bad, :3, 3] += jump
        return data, data.replace(poses=poses), np.sort(bad) + 1
    values = data.values.copy()
    values[bad] += jump
    return data, data.replace(values=values), np.sort(bad) + 1


def trial(kind, loss, sim_6dof, actual, seeds):
    """Return ratios of hold-out errors to those of clean fits, and the rates of true and false detections."""
    ratios, detected, false = [], [], []
    for seed in range(seeds):
        clean, dirty, bad = with_outliers(kind, actual, seed)
        q = np.random.default_rng(10**6 + seed).uniform(-3, 3, (200, 6))
        test = kind.simulate(actual, q, Noise(), np.random.default_rng(0))
        best = calibrate(sim_6dof, clean, "dh", priors="none").validate(test)["position_rms_m"]
        fit = calibrate(sim_6dof, dirty, "dh", priors="none", loss=loss)
        ratios.append(fit.validate(test)["position_rms_m"] / best)
        (outliers,) = fit.outliers
        detected.append(np.isin(bad, outliers).mean())
        false.append(np.isin(outliers, bad, invert=True).sum() / (len(dirty.rows) - len(bad)))
    return np.array(ratios), np.mean(detected), np.mean(false)


@pytest.mark.parametrize("loss", ["auto", "huber", "cauchy", "tukey"])
@pytest.mark.parametrize("kind", some_slow([Pose, Position], {1}))
def test_outliers_are_reported_and_have_no_influence(kind, loss, sim_6dof, sim_6dof_actual):
    ratios, detected, false = trial(kind, loss, sim_6dof, sim_6dof_actual, 6)
    assert np.median(ratios) <= 1.15
    assert detected >= 0.99
    assert false <= 0.01


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["auto", "huber", "cauchy", "tukey"])
@pytest.mark.parametrize("kind", [Pose, Position])
def test_outliers_in_200_seeds(kind, loss, sim_6dof, sim_6dof_actual):
    ratios, detected, false = trial(kind, loss, sim_6dof, sim_6dof_actual, 200)
    print(kind.kind, loss, np.median(ratios), np.quantile(ratios, 0.95), detected, false)
    assert np.median(ratios) <= 1.15
    assert detected >= 0.99
    assert false <= 0.01


def test_outliers_spoil_the_linear_loss(sim_6dof, sim_6dof_actual):
    """Otherwise the tests above would show nothing."""
    ratios, _, _ = trial(Position, "linear", sim_6dof, sim_6dof_actual, 3)
    assert np.median(ratios) > 5


def test_standardized_residuals_of_good_samples_are_normal(sim_6dof_actual):
    for kind in (Pose, Position):
        rng = np.random.default_rng(0)
        data = kind.simulate(sim_6dof_actual, rng.uniform(-3, 3, (20000, 6)), Noise(1e-4, 2e-4), rng)
        t = standardized_residuals(data.residual(sim_6dof_actual.forward_kinematics(data.q), np.empty(0)))
        np.testing.assert_allclose(np.quantile(t, [0.5, 0.841, 0.9987]), [0, 1, 3], atol=0.15)


def test_all_losses_agree_on_clean_data(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (100, 6)), Noise(1e-4, 1e-4), rng)
    test = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (100, 6)), Noise(), rng)
    linear = calibrate(sim_6dof, data, "dh", priors="none").validate(test)["position_rms_m"]
    for loss in ("huber", "cauchy", "tukey"):
        fit = calibrate(sim_6dof, data, "dh", priors="none", loss=loss)
        assert fit.validate(test)["position_rms_m"] < 1.15 * linear
        assert fit.outliers[0].size == 0


@pytest.mark.parametrize("n_seeds", some_slow([2, 5], {0}))
def test_two_outliers_among_few_measurements_are_reported_and_have_no_influence(
    n_seeds, sim_6dof, sim_6dof_actual
):
    for seed in range(n_seeds):
        clean, dirty, bad = with_outliers(Position, sim_6dof_actual, seed, m=30, fraction=0.07)
        best, fit = calibrate(sim_6dof, clean, "dh"), calibrate(sim_6dof, dirty, "dh")
        np.testing.assert_array_equal(fit.outliers[0], bad)
        q = np.random.default_rng(100 + seed).uniform(-3, 3, (200, 6))
        test = Position.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
        error, clean_error = (each.validate(test)["position_rms_m"] for each in (fit, best))
        assert error < 1.3 * clean_error


@pytest.mark.parametrize("n_seeds", some_slow([1, 3], {0}))
@pytest.mark.parametrize("loss", ["auto", "huber", "tukey"])
def test_good_samples_among_few_measurements_are_not_reported(loss, n_seeds, sim_6dof, sim_6dof_actual):
    """45 equations for 23 directions: the mean leverage is one half, and that of some samples nearly one."""
    for seed in range(n_seeds):
        data, _, _ = with_outliers(Position, sim_6dof_actual, seed, m=15)
        fit = calibrate(sim_6dof, data, "dh", loss=loss)
        assert fit.outliers[0].size == 0
        if loss == "auto":
            np.testing.assert_array_equal(fit.x, calibrate(sim_6dof, data, "dh", loss="linear").x)


def test_residual_covariances_agree_with_many_draws(sim_6dof, sim_6dof_actual):
    """For a sample in the fit, and for one that is rejected."""
    q = np.random.default_rng(0).uniform(-3, 3, (14, 6))
    exact = Position.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    weights = np.where(np.arange(14) == 3, 1e-12, 1.0)
    fit = calibrate(sim_6dof, Position(q, exact.values, np.full((14, 3), 1e-4)), "dh", priors="none")
    problem = fit.problem.with_data([fit.problem.data[0].with_weights(weights)])
    solution = replace(fit.solution, system=linearize_and_factor(problem, fit.x, small_angle=False))
    predictions = SolvedProblem(problem, solution).prediction_covariances
    expected = residual_covariances(predictions, [weights])[0]
    # Residuals of NumPy's linear least squares on the same rows, over many draws of noise.
    rows = problem.linearize(fit.x).rows(fit.problem.chunks[0])[:-1].transpose(2, 1, 0).reshape(42, -1)
    noise = np.random.default_rng(1).normal(size=(42, 20000))
    root = np.sqrt(np.repeat(weights, 3))[:, None]
    residuals = noise - rows @ np.linalg.pinv(root * rows, rcond=1e-9) @ (root * noise)
    for sample in (3, 5):
        drawn = np.cov(residuals.reshape(14, 3, -1)[sample])
        np.testing.assert_allclose(drawn, expected[sample], atol=0.05 * np.abs(expected[sample]).max())


def test_wrong_losses_list_the_choices(sim_6dof, sim_6dof_actual):
    data = Pose.simulate(sim_6dof_actual, np.zeros((5, 6)), Noise(), np.random.default_rng(0))
    with pytest.raises(DhcalError, match="choose from auto, linear, huber"):
        calibrate(sim_6dof, data, loss="l1")
    with pytest.raises(DhcalError, match="requires method 'lm'"):
        calibrate(sim_6dof, data, method="gn", loss="huber")


def test_statistics_of_a_fit_exclude_rejected_samples(sim_6dof, sim_6dof_actual):
    """An outlier of 40 mm is in no statistic, neither of the fit nor of hold-out data."""
    clean, dirty, _ = with_outliers(Position, sim_6dof_actual, 3, m=60, fraction=0.05)
    best, fit = calibrate(sim_6dof, clean, "dh"), calibrate(sim_6dof, dirty, "dh")
    judged, expected = fit.comparisons[0], best.comparisons[0]
    assert (judged.n_samples, judged.n_outliers) == (57, 3)
    assert judged.after["position_rms_m"] < 1.3 * expected.after["position_rms_m"]
    assert "without 3 outliers." in headline(fit.comparisons).text
    figures = accuracy_figures(ReportContext(fit, Provenance()))[0]
    assert figures.panels[0].caption == "Position error, 57 fitted samples"
    held = calibrate(sim_6dof, clean, "dh", holdout=[dirty]).comparisons[0]
    assert (held.n_samples, held.n_outliers) == (57, 3)
    assert held.after_with_outliers["position_rms_m"] > 10 * held.after["position_rms_m"]
    assert "without 3 outliers (" in headline([held]).text


def test_loss_auto_rejects_outliers_that_are_set_apart(sim_6dof, sim_6dof_actual):
    """Nine and four hundred sigma at two poses, whereas all others agree."""
    q = np.random.default_rng(3).uniform(-3, 3, (60, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(1e-4, 1e-4), np.random.default_rng(3))
    poses = data.poses.copy()
    poses[[5, 20], :3, 3] += [[9e-4, 0, 0], [0, 4e-2, 0]]
    fit = calibrate(sim_6dof, data.replace(poses=poses), "dh")
    assert fit.outliers[0].tolist() == [6, 21]
    assert np.flatnonzero(fit.weights[0] < 0.5).tolist() == [5, 20]


def test_leverages_are_those_of_the_orthogonal_projection(sim_6dof, sim_6dof_actual):
    """Wires hardly determine base and anchors; their wide priors have no influence on the leverages."""
    rng = np.random.default_rng(4)
    data = Wires.simulate(sim_6dof_actual, rng.uniform(-3, 3, (60, 6)), Noise(1e-4), rng)
    fit = calibrate(sim_6dof, data, "minimal,base,tool", session="off")
    rows = fit.problem.linearize(fit.x).rows(fit.problem.chunks[0])[:-1].transpose(2, 1, 0).reshape(180, -1)
    basis = np.linalg.qr(np.concatenate([rows, np.diag(fit.problem.weights)]))[0][:180].reshape(60, 3, -1)
    leverages = SolvedProblem(fit.problem, fit.solution).prediction_covariances[0]
    np.testing.assert_allclose(leverages, basis @ basis.transpose(0, 2, 1), atol=1e-4)
    assert fit.outliers[0].size == 0


def test_losses_name_their_stages_and_have_help_texts_of_one_line():
    for loss in LOSSES.values():
        assert set(loss.stages) <= {*WEIGHT_FUNCTIONS, TRIMMED, KEPT}
        assert 0 < len(loss.help) < 100
        assert "\n" not in loss.help


def test_a_wrong_group_is_rejected_as_a_whole(sim_6dof_actual):
    """Of 40 groups of ten samples, one is wrong as a whole, and another one has two wrong samples."""
    rng = np.random.default_rng(0)
    q = np.repeat(rng.uniform(-3, 3, (40, 6)), 10, axis=0)
    data = Position.simulate(sim_6dof_actual, q, Noise(1e-4), rng)
    residual = rng.normal(size=(3, 400))
    residual[:, :10] += 3.0
    residual[:, [20, 21]] += 100.0
    t = standardized_residuals(residual)
    weights = np.where(t > 3.5, ZERO_WEIGHT, 1.0)
    assert 0 < np.sum(weights[:10] <= ZERO_WEIGHT) < 10
    rejected = np.flatnonzero(reject_groups(weights, t, data) <= ZERO_WEIGHT)
    np.testing.assert_array_equal(rejected, [*range(10), 20, 21])
    # Groups in which no sample is rejected are kept, whatever their residuals are.
    assert reject_groups(np.ones(400), t, data).all()


def test_rejected_samples_are_no_evidence(sim_6dof, sim_6dof_actual):
    """Noise, families, temperature and indices are those of a fit of the good samples alone."""
    _, dirty, bad = with_outliers(Position, sim_6dof_actual, 5, m=80, fraction=0.3)
    good = dirty.take(np.setdiff1d(np.arange(80), bad - 1))
    fit, expected = (calibrate(sim_6dof, data, "dh", priors={"*": 1e-2}) for data in (dirty, good))
    np.testing.assert_array_equal(fit.outliers[0], bad)
    assert fit.sample_count == "56 of 80 samples"
    assert expected.sample_count == "56 samples"
    assert fit.extension
    assert expected.extension
    assert fit.extension.n_configurations == expected.extension.n_configurations
    assert fit.extension.temperature == pytest.approx(expected.extension.temperature, rel=1e-6)
    for found, wanted in zip(fit.extension.trials, expected.extension.trials, strict=True):
        assert found.family == wanted.family
        assert found.log_bayes_factor == pytest.approx(wanted.log_bayes_factor, rel=1e-3, abs=1e-2)
    for name, value in expected.observability_indices.items():
        assert fit.observability_indices[name] == pytest.approx(value, rel=1e-4), name
    assert fit.unit_weight_std == pytest.approx(expected.unit_weight_std, rel=1e-4)


@pytest.mark.parametrize("slope", [-0.5, -1.0, -2.0, -4.0, -7.0])
def test_weights_that_alternate_settle(slope):
    """Each new weight is the fixed point 0.5 plus `slope` times the distance of the old weight from it."""
    weights, last = [np.array([0.52, 1.0])], WeightChange()
    for _ in range(25):
        wanted = 0.5 + slope * (weights[0][0] - 0.5)
        # Huber's weight of this residual is the wanted one; the second sample is good.
        residuals = np.array([1.345 / min(max(wanted, 0.01), 1.0), 0.5])
        weights, last = update_weights(weights, [sample_weights(residuals, "huber")], "huber", last)
        if last.size < 1e-3:
            break
    assert last.size < 1e-3
    assert weights[0] == pytest.approx([0.5, 1.0], abs=2e-3)


def test_a_sample_that_no_weight_agrees_with_stays_rejected():
    """It is above the limit where it counts, and below it where it is rejected."""
    weights, last, found = [np.array([1.0, 1.0])], WeightChange(), []
    for _ in range(8):
        t = FAR_THRESHOLD + (0.1 if weights[0][0] > 0.5 else -0.1)
        wanted = [sample_weights(np.array([t, 0.5]), FAR_REJECTED)]
        weights, last = update_weights(weights, wanted, FAR_REJECTED, last)
        found.append(weights[0][0] > 0.5)
        assert weights[0][1] == 1
    assert found == [False, True, *[False] * 6]
    assert last.size == 0


def test_deciles_of_chi_square():
    """The stored deciles are those of SciPy."""
    for k, deciles in CHI_SQUARE_DECILES.items():
        np.testing.assert_allclose(deciles, stats.chi2.ppf(np.arange(1, 10) / 10, k) / k, atol=1e-6)


def test_pearsons_test_of_squares():
    """Squares of normal numbers pass; those of another scale, mixtures and equal ones do not."""
    rng = np.random.default_rng(0)
    passed = []
    for k in (1, 2, 3, 6):
        assert not is_chi_square(np.ones(400), k)
        for _ in range(100):
            squares = np.mean(rng.normal(size=(k, 400)) ** 2, 0)
            passed.append(is_chi_square(squares, k))
            mixture = np.where(np.arange(400) < 120, 36.0, 1.0) * squares
            assert not is_chi_square(4 * squares, k)
            assert not is_chi_square(mixture / mixture.mean(), k)
    # Pearson's statistic exceeds the limit in 1.8 % of the cases, 7.2 of 400.
    assert 380 <= np.sum(passed) <= 399


def test_samples_whose_residuals_are_hardly_determined_have_standardized_residuals():
    """A fit that leaves a direction of a sample undetermined makes its covariance singular in rounding."""
    direction = np.array([0.6, 0.8])
    covariances = np.eye(2) + 1e20 * np.outer(direction, direction) * np.ones((5, 1, 1))
    t = standardized_residuals(np.arange(10.0).reshape(2, 5), covariances)
    assert np.isfinite(t).all()


def test_covariances_that_rounding_errors_make_negative_have_an_inverse():
    """A fit to images of another board has predictions of 1e7 px, whose covariances are not determined."""
    covariances = np.array([[[-1e20, 0], [0, -MIN_VARIANCE]], np.eye(2)])
    assert np.isfinite(standardized_residuals(np.ones((2, 2)), covariances)[0])
