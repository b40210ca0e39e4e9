"""A constant error of the distances that a tracker measures, with another model of the arm."""

import numpy as np
import pytest
from sessions import NOISE, Simulation
from slow_cases import some_slow

from dhcal_pin import calibrate, se3
from dhcal_pin.calibration import Result
from dhcal_pin.measurements import Position
from dhcal_pin.plausibility import mend_files

# Radius of a usual reflector, that of a smaller one less it, and a wrong home position [m].
ERRORS = 12.7e-3, -6.35e-3, 1e-3


def tracked(simulation: Simulation, error: float, distance: float = 3.0) -> Position:
    """Return positions in the frame of a tracker that stands at a distance from the arm."""
    points = np.array([(pose * simulation.tool).translation for pose in simulation.poses(simulation.q)])
    points = points - distance * simulation.direction()
    points = points @ se3.exp3(simulation.rng.normal(size=3)).T
    points *= 1 + error / np.linalg.norm(points, axis=1)[:, None]
    noise = simulation.rng.normal(0, NOISE, points.shape)
    return Position(simulation.q, points + noise, np.full_like(points, NOISE))


def true_error(simulation: Simulation, fit: Result) -> float:
    """Return the RMS position error in the measured region, with the best base and tool point [m]."""
    simulation.end_model, simulation.end_zeros = simulation.model, 0.0
    return simulation.true_error(fit.chain)


@pytest.mark.parametrize(
    ("arm", "error", "seed"),
    some_slow(
        [(arm, error, seed) for arm in ("ur10", "panda") for error in ERRORS for seed in range(6)], {0, 7}
    ),
)
def test_a_wrong_radius_of_the_reflector_is_named_and_its_change_helps(arm, error, seed):
    simulation = Simulation(arm, 80, seed)
    data = tracked(simulation, error)
    fit = calibrate(simulation.chain, data, extend="none")
    assert fit.verdict.status == "caution"
    assert fit.session is not None
    found = fit.session.range_error
    assert found is not None
    assert abs(found.value - error) < 4 * found.std
    assert f"--mend range:{found.value:.6f}" in fit.verdict.reasons[0]
    mended = mend_files(simulation.chain, [data], f"range:{found.value:.6f}")
    again = calibrate(simulation.chain, mended, extend="none")
    assert again.verdict.status == "ok"
    assert again.session is not None
    assert again.session.found == ()
    true = [true_error(simulation, each) for each in (fit, again)]
    assert true[1] < true[0] / 3
    assert true[1] < 2 * NOISE


@pytest.mark.parametrize("seed", some_slow(range(20), {0, 1}))
def test_right_distances_are_not_named(seed):
    simulation = Simulation(("ur10", "panda")[seed % 2], 60, seed)
    fit = calibrate(simulation.chain, tracked(simulation, 0.0, 1.0 + 0.2 * seed), extend="none")
    assert fit.verdict.status == "ok"
    assert fit.session is not None
    assert fit.session.found == ()
