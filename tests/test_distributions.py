"""Distribution functions against scipy.special."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import special

from dhcal_pin.distributions import chi_square_cdf, normal_cdf, student_cdf


def test_normal_distribution():
    x = np.concatenate([np.linspace(-30, 8, 400), [-np.inf, np.inf]])
    np.testing.assert_allclose(normal_cdf(x), special.ndtr(x), rtol=1e-12)


@pytest.mark.parametrize("k", [*range(1, 12), 40])
def test_chi_square_distribution(k):
    x = np.linspace(0, 90, 300)
    np.testing.assert_allclose(chi_square_cdf(x, k), special.gammainc(k / 2, x / 2), rtol=0, atol=1e-14)


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 10, 59, 999, 1000, 100001])
def test_student_distribution(freedom):
    t = np.array([-np.inf, -40.0, -3.0, -1.96, 0.0, 0.3, 5.0])
    found = [student_cdf(value, freedom) for value in t]
    np.testing.assert_allclose(found, special.stdtr(freedom, t), rtol=0, atol=1e-12)


def test_student_distribution_needs_freedom():
    assert math.isnan(student_cdf(0.0, 0))
