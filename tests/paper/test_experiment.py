"""Experiment of the paper against verified figures."""

from functools import partial

import numpy as np
import pytest

from dhcal_pin.calibration import accuracy, calibrate, cross_validate, k_fold
from dhcal_pin.calibration.cross_validation import cross_validate_folds, refit
from dhcal_pin.calibration.evaluation import Accuracy
from dhcal_pin.cli.commands import demo
from dhcal_pin.diagnostics import find_unreachable_rows
from dhcal_pin.io import measurement_text, read_measurement_file
from dhcal_pin.paper import run_experiment


@pytest.fixture(scope="module")
def experiment():
    return run_experiment()


def test_experiment_figures(experiment):
    mm = {key: 1e3 * value for key, value in experiment.figures.items()}
    assert mm["before"] == pytest.approx(25.547, abs=5e-4)
    assert mm["one_step"] == pytest.approx(5.629, abs=5e-4)
    assert mm["one_step_left_out"] == pytest.approx(11.4, abs=0.05)
    assert mm["least_squares"] == pytest.approx(4.724, abs=5e-4)
    assert mm["least_squares_left_out"] == pytest.approx(13.1, abs=0.05)
    assert mm["published_parameters"] == pytest.approx(51.58, abs=5e-3)
    assert mm["paper_before"] == pytest.approx(25.574, abs=5e-4)
    assert mm["paper_after"] == pytest.approx(18.208, abs=5e-4)
    assert mm["paper_before_all"] == pytest.approx(26.716, abs=5e-4)
    assert mm["paper_after_all"] == pytest.approx(20.174, abs=5e-4)


@pytest.mark.parametrize(
    ("options", "fitted", "left_out"),
    [
        ({"priors": "none", "fix": ["d3", "alpha3"]}, 4.724, 13.133),
        ({"method": "gn", "max_iterations": 1}, 5.629, 11.441),
    ],
)
def test_the_cross_validation_of_a_result_agrees(experiment, options, fitted, left_out):
    """Folds far from linear are fitted again; one of them takes a single step of the paper's loop."""
    fit = calibrate(experiment.chain, experiment.data, "dh", **options)
    first, second = fit.comparisons
    assert (first.title, second.title) == ("cross-validated", "fitted")
    assert 1e3 * fit.validate(experiment.data)["position_rms_m"] == pytest.approx(fitted, abs=5e-4)
    folds = k_fold(fit.data, len(experiment.data.rows))
    held_out = cross_validate_folds(fit.problem, fit.solution.x, fit.data, folds, partial(refit, fit))
    every = Accuracy.from_errors([item for fold in held_out for item in fold.errors])
    assert 1e3 * every["position_rms_m"] == pytest.approx(left_out, abs=2e-3)
    # Figures of a result are without outliers.
    counted = cross_validate(fit, folds).accuracy["position_rms_m"]
    assert counted == pytest.approx(first.after["position_rms_m"], rel=1e-6)
    for without, all_samples in ((counted, left_out), (second.after["position_rms_m"], fitted)):
        assert (without < 1e-3 * all_samples - 1e-4) == bool(second.n_outliers)


def test_unreachable_rows_are_found_with_their_reasons(experiment):
    assert [finding.row for finding in experiment.unreachable_rows] == [7, 8]
    seven, eight = experiment.unreachable_rows
    assert 1e3 * seven.error == pytest.approx(1095, abs=0.5)
    assert 1e3 * eight.error == pytest.approx(767, abs=0.5)
    assert "(29.95°, 29.69°, -29.39°)" in seven.reason
    assert "1305.8 mm" in eight.reason
    assert "745.0 mm" in eight.reason


def test_unreachable_rows_are_found_in_any_order(experiment, tmp_path):
    """Shuffled, and without the columns of commanded positions."""
    data = experiment.measurements.data.take(np.array([7, 0, 1, 6, 2, 3, 4, 5]))
    path = tmp_path / "t.csv"
    path.write_text(measurement_text(data, experiment.chain))
    assert [
        f.row for f in find_unreachable_rows(experiment.chain, read_measurement_file(path, experiment.chain))
    ] == [2, 5]


def test_unobservable_parameters_are_held(experiment):
    assert experiment.fixed == ["alpha3", "d3"]
    assert "little redundancy" in demo.experiment_remarks(experiment)[0]
    assert "51.6 mm" in demo.experiment_remarks(experiment)[2]


def test_angle_offsets_alone_fit_worse(experiment):
    """Δθ alone: 13.124 mm."""
    fit = calibrate(experiment.chain, experiment.data, "dh", priors="none",
                    fix=[f"{key}{i}" for key in ("d", "a", "alpha") for i in (1, 2, 3)])  # fmt: skip
    assert 1e3 * accuracy(fit.chain, [experiment.data])["position_rms_m"] == pytest.approx(13.124, abs=5e-4)
