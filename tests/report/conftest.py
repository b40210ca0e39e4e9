"""Fixtures for the tests of reports."""

from collections.abc import Callable

import numpy as np
import pytest

from dhcal_pin.calibration import Result, calibrate, split
from dhcal_pin.calibration.presentation import workspace
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain


@pytest.fixture(scope="session")
def calibrated(sim_6dof: Chain, sim_6dof_actual: Chain) -> Callable[[float], Result]:
    """Return a function from the hold-out fraction to a calibration with 40 simulated poses."""

    def calibrate_with(holdout: float) -> Result:
        rng = np.random.default_rng(0)
        data = Pose.simulate(sim_6dof_actual, rng.uniform(-1.5, 1.5, (40, 6)), Noise(2e-4, 3e-4), rng)
        fitted, held_out = split([data], holdout, 0)
        return calibrate(sim_6dof, fitted, "dh", holdout=held_out)

    return calibrate_with


@pytest.fixture(scope="session")
def fit(calibrated: Callable[[float], Result]) -> Result:
    return calibrated(0.3)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Predict the accuracy in few configurations."""
    monkeypatch.setattr(workspace, "N_PREDICTED_CONFIGURATIONS", 300)
