"""Motions of a base during a check, from rows with a known motion."""

import numpy as np
import pytest

from dhcal_pin.session.slip import Fit, find_slip

COUNT, DIM = 9, 3
NUMBERS = np.repeat(np.arange(COUNT), DIM)
MOTION = np.array([2.0, -1.0, 3.0, 0.5, -0.5, 1.0])


def rows_of(first, noise=0.0):
    """Return columns of the base, residuals after a motion from a sample on, and the square root of noise."""
    rng = np.random.default_rng(first)
    base, root = rng.normal(size=(len(NUMBERS), 6)), np.diag(rng.uniform(0.5, 2.0, len(NUMBERS)))
    residual = np.where(NUMBERS[:, None] >= first, base, 0.0) @ MOTION
    return base, residual + noise * root @ rng.normal(size=len(NUMBERS)), root


@pytest.mark.parametrize(
    ("first", "is_determined"), [(2, False), (3, True), (5, True), (6, True), (7, False)]
)
def test_a_motion_of_the_base_is_found_with_its_uncertainty(first, is_determined):
    base, residual, root = rows_of(first, 1e-3)
    whitening = 1e3 * np.linalg.inv(root)
    other = np.random.default_rng(9).normal(size=(len(NUMBERS), 4))
    slip = find_slip(base, residual, whitening, NUMBERS, [other, base])
    assert (slip.first, slip.is_determined) == (first, is_determined)
    moved = whitening @ np.where(NUMBERS[:, None] >= first, base, 0.0)
    np.testing.assert_allclose(slip.values, MOTION, atol=0.02)
    np.testing.assert_allclose(slip.covariance, np.linalg.inv(moved.T @ moved), rtol=1e-6, atol=1e-9)
    left = whitening @ residual - moved @ slip.values
    assert slip.chi_square == pytest.approx(left @ left)
    assert slip.freedom == len(NUMBERS) - 6
    # The criterion is that of Schwarz, of the best other change.
    criteria = []
    for columns in (other, base):
        scaled, target = whitening @ columns, whitening @ residual
        left = target - scaled @ np.linalg.lstsq(scaled, target)[0]
        criteria.append(left @ left + columns.shape[1] * np.log(len(NUMBERS)))
    assert slip.lead == pytest.approx(min(criteria) - slip.chi_square - 6 * np.log(len(NUMBERS)))


def test_columns_without_an_effect_do_not_count():
    """Two of three columns are multiples of each other."""
    columns = np.outer(np.arange(1.0, 9.0), [1.0, 2.0, 0.0]) + np.outer(np.arange(8) % 2, [0.0, 0.0, 1.0])
    fit = Fit.of(columns, columns @ [1.0, 0.0, 4.0])
    assert (fit.rank, fit.chi_square) == (2, pytest.approx(0.0, abs=1e-12))
    assert fit.criterion == pytest.approx(2 * np.log(8))
    assert fit.coefficients @ [1.0, 2.0, 0.0] == pytest.approx(1.0)
