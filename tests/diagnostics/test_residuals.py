"""Residual errors of joints against a known error."""

import numpy as np
from robots import robot_file

from dhcal_pin.calibration import calibrate
from dhcal_pin.diagnostics import residuals
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain


def test_a_periodic_joint_error_appears_in_the_profile_of_that_joint_only():
    arm = Chain.from_urdf(robot_file("ur_description/urdf/ur5_robot.urdf"))
    rng = np.random.default_rng(2)
    q = rng.uniform(-2.5, 2.5, (1500, 6))
    wave = np.zeros_like(q)
    wave[:, 2] = 2e-3 * np.sin(q[:, 2])
    data = Pose.simulate(arm, q + wave, Noise(1e-4, 1e-4), rng)
    fit = calibrate(arm, data.replace(q=q), "tool", fix=["tool.y"])
    profiles = residuals.joint_offset_profiles(fit)
    assert [profile.name for profile in profiles] == list(arm.moving_joints)
    for j, profile in enumerate(profiles):
        expected = 2e-3 * np.sin(profile.centres) if j == 2 else 0 * profile.centres
        assert len(profile.centres) == residuals.N_BINS
        # A part is 0.42 rad wide; the mean of the sine over it differs so much from its value at the centre.
        assert np.abs(profile.after - expected).max() < (6e-5 if j == 2 else 4.5 * profile.after_std.max())
        assert np.all(profile.after_std > 0)
