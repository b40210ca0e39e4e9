"""Error statistics against values by hand and against their scatter over repeats."""

import numpy as np
import pytest
from scipy.special import stdtrit
from scipy.stats import binom
from slow_cases import some_slow

from dhcal_pin.calibration import Accuracy
from dhcal_pin.calibration.evaluation import MAX_CHANCES, MIN_SAMPLES, SURE_T, PairedErrors


def test_standard_error_of_rms_matches_scatter_over_repeats():
    rng = np.random.default_rng(1)
    runs = [Accuracy.from_errors([{"position": rng.standard_normal((200, 3))}]) for _ in range(400)]
    scatter = np.std([run["position_rms_m"] for run in runs])
    stated = np.mean([run["position_rms_std_m"] for run in runs])
    assert stated == pytest.approx(scatter, rel=0.15)


def test_statistics_match_values_by_hand():
    error = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])
    found = Accuracy.from_errors(
        [{"position": error[:2]}, {"position": error[2:], "orientation": np.zeros((1, 3))}]
    )
    assert found["position_mean_m"] == pytest.approx(8 / 3)
    assert found["position_rms_m"] == pytest.approx(np.sqrt(10))
    assert found["position_max_m"] == 5
    assert found["position_p95_m"] == pytest.approx(2 + 0.9 * 3)
    assert found["position_axes_rms_m"] == pytest.approx([np.sqrt(3), 4 / np.sqrt(3), np.sqrt(5 / 3)])
    assert found["orientation_rms_rad"] == 0
    assert list(found.groups) == ["position", "orientation"]
    assert found.groups["position"].rms == found["position_rms_m"]


def test_accuracy_is_a_mapping_of_the_keys_of_the_json_document():
    found = Accuracy.from_errors([{"length": np.array([[3e-3], [-4e-3]])}])
    assert list(found) == [
        "residual_samples",
        "residual_rms",
        "residual_rms_std",
        "residual_mean",
        "residual_p95",
        "residual_max",
        "unit",
    ]
    assert dict(found) == found.to_dict()
    assert found["unit"] == "m"
    assert "position_rms_m" not in found
    assert not Accuracy()


def paired_errors(rng, n, shape, ratio=1.0):
    """Draw squared errors of n samples before a calibration and `ratio` times as large ones after it."""
    before, after = rng.standard_normal((2, n, 3))
    if shape == "correlated":
        after = 0.9 * before + np.sqrt(1 - 0.9**2) * after
    if shape == "heavy-tailed":
        before, after = (each / np.sqrt(rng.chisquare(2, (n, 1)) / 2) for each in (before, after))
    if shape == "along one axis":
        before, after = (each[:, :1] for each in (before, after))
    return PairedErrors(np.sum(before**2, 1), ratio**2 * np.sum(after**2, 1), before.shape[1])


@pytest.mark.parametrize("shape", ["equal", "correlated", "heavy-tailed", "along one axis"])
@pytest.mark.parametrize("n", some_slow([2, 3, 5, 10, 30, 100], [2, 4]))
def test_robots_that_are_equally_wrong_rarely_appear_better(n, shape):
    rng, n_trials = np.random.default_rng(n), 2000
    count = sum(paired_errors(rng, n, shape).is_better for _ in range(n_trials))
    assert count <= binom.isf(1e-4, n_trials, sum(MAX_CHANCES))


@pytest.mark.parametrize(
    ("n", "shape", "ratio", "least"),
    [
        (4, "equal", 0.07, 0.95),
        (12, "heavy-tailed", 0.07, 0.97),
        (12, "equal", 0.5, 0.88),
        (20, "along one axis", 0.3, 0.93),
    ],
)
def test_few_samples_show_that_a_robot_is_better(n, shape, ratio, least):
    """Student's t of the squared errors found 41, 50, 92 and 95 % of them."""
    rng, n_trials = np.random.default_rng(n), 1000
    count = sum(paired_errors(rng, n, shape, ratio).is_better for _ in range(n_trials))
    assert count >= binom.isf(1 - 1e-4, n_trials, least)


def test_the_quantiles_that_decide_without_a_computation_hold_for_all_numbers_of_samples():
    freedom = np.arange(MIN_SAMPLES - 1, 10_000)[:, None]
    assert np.all(np.array(SURE_T) <= stdtrit(freedom, MAX_CHANCES))


def test_a_robot_with_a_larger_rms_error_is_not_better():
    before, after = np.ones(12), np.full(12, 0.1)
    assert PairedErrors(before, after * np.linspace(0.9, 1.1, 12), 3).is_better
    after[0] = 20.0
    assert not PairedErrors(before, after, 3).is_better
    assert not PairedErrors(before[:1], after[1:2], 3).is_better
