"""Joint positions over time against the splines of SciPy."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dhcal_pin.robot.joint_path import joint_path


@pytest.mark.parametrize("m", [2, 3, 4, 5, 40])
def test_a_path_is_the_cubic_spline_of_scipy(m):
    rng = np.random.default_rng(m)
    times, q = np.cumsum(rng.uniform(0.1, 3, m)), rng.normal(size=(m, 3))
    at = rng.uniform(times[0] - 0.5, times[-1] + 0.5, 50)
    path, expected = joint_path(times, q), CubicSpline(times, q)
    for order in (0, 1):
        np.testing.assert_allclose(path(at, order), expected(at, order), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(path(times), q, atol=1e-12)
    np.testing.assert_allclose(path(times[0]), q[0], atol=1e-12)


def test_a_time_that_repeats_is_left_out_and_a_single_one_gives_a_constant():
    q = np.arange(8.0).reshape(4, 2)
    path = joint_path(np.array([0.0, 1.0, 1.0, 2.0]), q)
    np.testing.assert_allclose(path([0.0, 1.0, 2.0]), q[[0, 1, 3]], atol=1e-12)
    single = joint_path(np.array([4.0, 4.0]), q[:2])
    np.testing.assert_array_equal(single([0.0, 9.0]), q[[0, 0]])
    np.testing.assert_array_equal(single([0.0, 9.0], 1), np.zeros((2, 2)))
