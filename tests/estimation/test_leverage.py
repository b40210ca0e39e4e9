"""Standardized residuals of samples that alone determine a parameter."""

import numpy as np

from dhcal_pin.estimation.robust import OUTLIER_THRESHOLD, standardized_residuals


def test_a_sample_that_the_fit_passes_through_is_no_outlier():
    """Its residual has no variance; a solver leaves a thousandth of a standard deviation of it."""
    residual = np.random.default_rng(0).normal(size=(3, 40))
    covariances = np.tile(np.eye(3), (40, 1, 1))
    residual[:, 7], covariances[7] = 1e-3, 1e-14 * np.eye(3)
    t = standardized_residuals(residual, covariances)
    assert abs(t[7]) < OUTLIER_THRESHOLD
    # The scale and the other samples do not depend on it.
    others = np.delete(np.arange(40), 7)
    alone = standardized_residuals(residual[:, others], covariances[others])
    np.testing.assert_allclose(t[others], alone, rtol=0.1, atol=0.1)


def test_an_outlier_of_some_leverage_is_found():
    """Half of its error goes into the fit: the residual is compared with its own standard deviation."""
    residual = np.random.default_rng(1).normal(size=(3, 40))
    covariances = np.tile(np.eye(3), (40, 1, 1))
    residual[:, 7], covariances[7] = 5.0, 0.5 * np.eye(3)
    t = standardized_residuals(residual, covariances)
    plain = standardized_residuals(residual)
    assert t[7] > plain[7] > OUTLIER_THRESHOLD
