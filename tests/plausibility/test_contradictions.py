"""Measurements of different kinds that contradict each other, simulated with a joint zero that differs."""

from dataclasses import replace

import numpy as np
import pytest
from robots import nominal_arm

from dhcal_pin import calibrate, select_parameters
from dhcal_pin.measurements import KINDS, Noise
from dhcal_pin.plausibility.contradictions import MIN_RATIO, own_fit_ratio

ELBOW = 2
OTHERS = ("distance", "inclination", "point", "pose")


def measured(kind: str, rng: np.random.Generator, zero: float):
    """Simulate positions, and 60 measurements of another kind whose joint values have another zero."""
    chain = nominal_arm("ur10")
    errors = select_parameters(chain, "minimal,base,tool")
    true = errors.at(np.minimum(errors.priors, 0.3) * rng.standard_normal(len(errors.priors)))
    positions, others = (
        KINDS[name].simulate(true, rng.uniform(-2.5, 2.5, (count, 6)), Noise(5e-5, 5e-5), rng)
        for name, count in (("position", 40), (kind, 60))
    )
    shift = np.zeros(6)
    shift[ELBOW] = zero
    others = others.resample(others.configurations() + shift)
    unknown = [
        item.replace(source=f"{item.kind}.csv", has_stated_sigma=False) for item in (positions, others)
    ]
    return chain, true, unknown


def position_error(chain, true, rng: np.random.Generator) -> float:
    """Return the RMS difference of the tool positions of two arms [m]."""
    q = rng.uniform(-2.5, 2.5, (200, 6))
    difference = chain.poses(q)[:, :3, 3] - true.poses(q)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(difference**2, 1))))


@pytest.mark.parametrize("kind", OTHERS)
def test_a_file_with_another_zero_needs_caution(kind):
    rng = np.random.default_rng(3)
    chain, true, data = measured(kind, rng, np.deg2rad(0.3))
    fit = calibrate(chain, data, extend="none", session="off")
    assert fit.verdict.status == "caution"
    assert any("contradicts the other measurements" in reason for reason in fit.verdict.reasons)
    # As the reason advises.
    alone = calibrate(chain, data[0], extend="none")
    assert alone.verdict.status == "ok"
    assert position_error(alone.chain, true, rng) < 2e-4


@pytest.mark.parametrize("kind", OTHERS)
def test_files_that_agree_contradict_nothing(kind):
    chain, _, data = measured(kind, np.random.default_rng(4), 0.0)
    fit = calibrate(chain, data, extend="none")
    assert fit.verdict.status == "ok", fit.verdict.reasons
    ratios = [own_fit_ratio(fit.inlier_problem, fit.solution.x, item) for item in fit.inlier_problem.data]
    assert max(ratios) < 0.75 * MIN_RATIO


def test_the_ratio_is_that_of_two_calibrations():
    """Noise is large, so that the priors matter as little as for a calibration without them."""
    chain, _, data = measured("distance", np.random.default_rng(5), np.deg2rad(0.1))
    both = calibrate(chain, data, extend="none", session="off")
    alone = calibrate(chain, data[1], extend="none", session="off")
    errors = [fit.file_comparisons[-1].after["residual_rms"] for fit in (both, alone)]
    item = both.inlier_problem.data[1]
    freedom = (len(item.rows) - alone.rank) / len(item.rows)
    expected = errors[0] / errors[1] * np.sqrt(freedom)
    assert own_fit_ratio(both.inlier_problem, both.solution.x, item) == pytest.approx(expected, rel=0.2)


def test_the_ratio_does_not_depend_on_first_values_of_instruments():
    """Each file has first values of its own; the calibration takes those of the first file."""
    chain, _, data = measured("sphere", np.random.default_rng(3), np.deg2rad(0.3))
    fit = calibrate(chain, data, extend="none", session="off")
    problem, x, item = fit.inlier_problem, fit.solution.x, fit.inlier_problem.data[1]
    moved = [replace(p, nominal=p.nominal + 0.1) for p in item.instrument_parameters]
    other = item.replace(instrument_parameters=tuple(moved))
    expected = own_fit_ratio(problem, x, item)
    assert expected > 1.1
    assert own_fit_ratio(problem, x, other) == pytest.approx(expected, rel=1e-6)
