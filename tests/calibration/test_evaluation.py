"""Error statistics against values by hand and against their scatter over repeats."""

import numpy as np
import pytest

from dhcal_pin.calibration import Accuracy


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
