"""Chi-square of hold-out samples of simulated arms, with and without errors that the model lacks."""

import numpy as np
import pytest
from robots import nominal_arm
from scipy import stats
from sessions import Simulation
from slow_cases import some_slow

from dhcal_pin import Result, calibrate, split
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import KINDS, Measurement, Noise, Pose, Position

ARMS = [("ur10", Position), ("panda", Pose)]
# A plane has unknowns of its own in each measurement, distances between points have no configurations, and
# images need configurations in which the board is seen.
OTHERS = ("plane", "point_distance", "camera")


def calibrated(
    arm: str, kind: type[Measurement], seed: int, *, size: float = 0.0, is_by_region: bool = False
) -> Result:
    """Calibrate with half of 100 samples and hold out the others; `size` is that of eccentricities [rad]."""
    sim = Simulation(arm, 100, seed)
    sim.add_eccentricities(size)
    data, order = sim.measure(kind), np.arange(100)
    if is_by_region:
        order = np.argsort(sim.q[:, 1])
    fitted, held_out = (data.take(np.sort(part)) for part in np.array_split(order, 2))
    return calibrate(sim.chain, fitted, extend="none", session="off", holdout=held_out)


def is_doubted(fit: Result) -> bool:
    """Return whether the verdict says that the model does not explain the arm."""
    has_reason = "The model does not explain the arm" in " ".join(fit.verdict.reasons)
    assert not (has_reason and fit.verdict.status == "ok")
    return has_reason


@pytest.mark.parametrize("count", some_slow([3, 100], [0]))
@pytest.mark.parametrize("is_by_region", [False, True])
@pytest.mark.parametrize(("arm", "kind"), some_slow(ARMS, [0]))
def test_hold_out_samples_of_a_right_model_raise_no_doubt(arm, kind, is_by_region, count):
    fits = [calibrated(arm, kind, seed, is_by_region=is_by_region) for seed in range(count)]
    assert np.mean([is_doubted(fit) for fit in fits]) <= 0.01
    p_values = [found[1] for fit in fits if (found := fit.holdout_chi_square)]
    assert len(p_values) == count
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("count", some_slow([2, 40], [0]))
def test_regions_of_an_arm_with_other_errors_raise_doubt(count):
    fits = [calibrated("ur10", Position, seed, size=1e-3, is_by_region=True) for seed in range(count)]
    assert np.mean([is_doubted(fit) for fit in fits]) >= 0.5


@pytest.mark.parametrize(
    ("kind", "seed"),
    some_slow([(kind, seed) for seed in range(3) for kind in KINDS if kind not in OTHERS], [2, 3, 7]),
)
def test_unknowns_of_the_instrument_explain_the_hold_out_samples(kind, seed):
    """A random part of the samples is held out; the chi-square has several hundred degrees of freedom."""
    arm = nominal_arm("ur10")
    rng = np.random.default_rng(seed)
    errors = select_parameters(arm, "minimal")
    std = np.array([5e-4 if p.unit == "m" else 2e-3 for p in errors.parameters])
    truth = errors.at(std * rng.standard_normal(len(std)))
    data = KINDS[kind].simulate(truth, rng.uniform(-2.5, 2.5, (90, 6)), Noise(5e-5, 2e-4), rng)
    (fitted,), held_out = split(data, 0.25, seed)
    fit = calibrate(arm, fitted, extend="none", session="off", holdout=held_out)
    assert fit.holdout_chi_square is not None
    ratio, p_value = fit.holdout_chi_square
    assert 0.3 < ratio < 2.0
    assert p_value > 1e-3
