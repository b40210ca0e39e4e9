"""Initialization: base and tool frames anywhere are found without a guess."""

import numpy as np
import pytest
from robots import with_random_frames

from dhcal_pin.calibration import calibrate
from dhcal_pin.measurements import Noise, Pose, Position

pytestmark = pytest.mark.usefixtures("unsuspected")


def assert_frames_are_found(kind, sim_6dof, sim_6dof_actual, seeds):
    """Calibrate robots with instruments metres away and targets half a metre from the tip."""
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = with_random_frames(sim_6dof_actual, rng)
        data = kind.simulate(truth, rng.uniform(-3, 3, (30, 6)), Noise(1e-4, 1e-4), rng)
        fit = calibrate(sim_6dof, data, "dh,base,tool", priors="none", extend="none")
        other = kind.simulate(truth, rng.uniform(-3, 3, (50, 6)), Noise(), rng)
        assert fit.validate(other)["position_rms_m"] < 5e-4, seed


@pytest.mark.parametrize("kind", [Pose, Position])
def test_frames_are_found_without_a_guess(kind, sim_6dof, sim_6dof_actual):
    assert_frames_are_found(kind, sim_6dof, sim_6dof_actual, 15)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Pose, Position])
def test_frames_are_found_without_a_guess_in_200_trials(kind, sim_6dof, sim_6dof_actual):
    assert_frames_are_found(kind, sim_6dof, sim_6dof_actual, 200)
