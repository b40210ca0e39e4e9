"""Knowledge before measuring: priors, measurements, or the uncertainty of a calibration."""

import numpy as np
import pytest
from robots import joint_sample, measured_arm

from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.planning import Information, PlannedCalibration

SETS, NOISE = "minimal,base,tool", Noise(1e-4, 1e-4)


@pytest.mark.parametrize(("kind", "count"), [(Position, 15), (Pose, 30)])
def test_a_calibration_replaces_the_priors(kind, count):
    """Few positions leave some parameters nearly unknown; their priors must not count a second time."""
    nominal, rng = measured_arm("ur5"), np.random.default_rng(0)
    errors = select_parameters(nominal, SETS)
    truth = errors.at(np.where(errors.is_of_arm, errors.priors, 0.3) * rng.standard_normal(36))
    data = kind.simulate(truth, joint_sample(nominal, count, rng), NOISE, rng)
    fit = calibrate(nominal, data, SETS, extend="none")
    assert fit.shrinkage_factor == 1
    task = joint_sample(nominal, 20, rng)
    found = Information.from_prior(
        PlannedCalibration(fit.chain, "pose", NOISE, SETS, prior_uncertainty=fit.uncertainty), task
    )
    root = np.linalg.inv(found.prior_factor[:36, :36]) * found.prior_sigma[:36, None]
    std = np.sqrt(np.sum(root**2, 1))
    np.testing.assert_allclose(std, fit.std[:36], rtol=0.05)
    # The priors alone are known from the definition of the parameters.
    alone = Information.from_prior(PlannedCalibration(fit.chain, "pose", NOISE, SETS), task)
    root = np.linalg.inv(alone.prior_factor[:36, :36]) * alone.prior_sigma[:36, None]
    np.testing.assert_allclose(np.sqrt(np.sum(root**2, 1)), errors.priors, rtol=1e-9)
