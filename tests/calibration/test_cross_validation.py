"""Cross-validation against fits of the same samples from the start."""

from dataclasses import replace

import numpy as np
import pytest
from robots import paper

from dhcal_pin.calibration import Result, accuracy, calibrate, cross_validate, k_fold
from dhcal_pin.estimation import levenberg_marquardt
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import Measurement, Noise, PointContact, Pose, Position
from dhcal_pin.robot import Chain

# Calibrations of arms with large errors, of which nothing asks for mistakes.
pytestmark = pytest.mark.usefixtures("unsuspected")


def fitted(kind: type[Measurement] = Position, m: int = 40) -> Result:
    """Calibrate the simulated arm of the paper on simulated measurements."""
    arm = Chain.from_dh(paper("sim_6dof"))
    rng = np.random.default_rng(0)
    data = kind.simulate(
        Chain.from_dh(paper("sim_6dof_actual")), rng.uniform(-1, 1, (m, 6)), Noise(1e-4, 1e-4), rng
    )
    return calibrate(arm, data, "dh")


def test_folds_equal_fits_of_the_other_samples():
    fit = fitted(Pose)
    folds = k_fold(fit.data, 4, seed=1)
    found = cross_validate(fit, folds)
    for fold, fold_accuracy, error in zip(folds, found.folds, found.errors, strict=True):
        problem = replace(
            fit.problem, data=tuple(d.take(~m) for d, m in zip(fit.problem.data, fold, strict=True))
        )
        x = levenberg_marquardt(problem, np.zeros(len(fit.x)), 100, None).x
        held_out = [d.take(m) for d, m in zip(fit.problem.data, fold, strict=True)]
        chain = fit.errors.at(x)
        assert fold_accuracy["position_rms_m"] == pytest.approx(
            accuracy(chain, held_out)["position_rms_m"], rel=2e-3
        )
        rows = held_out[0].residual(chain.forward_kinematics(held_out[0].q), np.empty(0))
        assert error == pytest.approx(np.sqrt(np.mean(rows**2)), rel=2e-3)
    counts = [fold["position_samples"] for fold in found.folds]
    whole = np.sqrt(np.average([fold["position_rms_m"] ** 2 for fold in found.folds], weights=counts))
    assert found.accuracy["position_rms_m"] == pytest.approx(whole)


def test_errors_of_left_out_samples_are_larger_by_the_number_of_unknowns():
    """With p unknowns, the variance is 1 - p/n in n fitted rows, and 1 + p/n in a left-out one."""
    fit = fitted(Pose)
    p, n = len(fit.x), 6 * 40
    ratios = [
        cross_validate(fit, k_fold(fit.data, 4, seed)).accuracy["position_rms_m"]
        / fit.validate(fit.data)["position_rms_m"]
        for seed in range(10)
    ]
    expected = np.sqrt((1 + p / (0.75 * n)) / (1 - p / n))
    assert np.mean(ratios) == pytest.approx(expected, rel=0.03)


def test_outliers_do_not_count():
    """Two samples are wrong by decimetres; the figure is that of the others, calibrated without them."""
    clean = fitted(Position)
    (data,) = clean.data
    values = data.values.copy()
    values[[3, 20], 0] += [0.3, -0.2]
    fit = calibrate(clean.errors.chain, Position(data.q, values), "dh")
    assert fit.n_outliers == 2
    good = np.delete(np.arange(40), [3, 20])
    expected = calibrate(clean.errors.chain, Position(data.q[good], data.values[good]), "dh")
    folds = k_fold(fit.data, 5)
    found = cross_validate(fit, folds)
    others = cross_validate(expected, [(mask[0][good],) for mask in folds])
    assert found.accuracy["position_samples"] == 38
    assert sum(fold["position_samples"] for fold in found.folds) == 38
    assert found.accuracy["position_rms_m"] == pytest.approx(others.accuracy["position_rms_m"], rel=0.02)
    assert fit.validate(fit.data)["position_samples"] == 40


def test_folds_of_other_data_are_refused():
    with pytest.raises(DhcalError, match="made for other data"):
        cross_validate(fitted(m=30), k_fold(fitted().data, 5))


def test_point_of_held_out_samples_is_fitted_to_them():
    fit = fitted(PointContact, 60)
    groups = [item.kind for item in fit.data]
    assert groups == ["point"]
    found = cross_validate(fit)
    assert found.accuracy["position_rms_m"] < 0.05


@pytest.mark.parametrize("options", [{"method": "gn"}, {"priors": "none"}])
def test_samples_that_are_fitted_exactly_have_large_held_out_errors(sim_6dof, sim_6dof_actual, options):
    """Two poses can be fitted exactly, but a fit of one does not predict the other."""
    rng = np.random.default_rng(0)
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (2, 6)), Noise(), rng)
    cross_validated, fitted = calibrate(sim_6dof, data, "dh", **options).comparisons
    assert fitted.after["position_rms_m"] < 1e-9
    alone = [
        accuracy(
            calibrate(sim_6dof, data.take(np.array([one])), "dh", **options).chain,
            [data.take(np.array([1 - one]))],
        )
        for one in (0, 1)
    ]
    wanted = np.sqrt(np.mean([found["position_rms_m"] ** 2 for found in alone]))
    assert cross_validated.after["position_rms_m"] == pytest.approx(wanted, rel=0.05)
    assert wanted > 5e-3
