"""A base or an instrument that moved while a check was measured.

The samples before the motion fit to the calibrated robot, and those from sample s on to one whose base moved:

    r_i = b·A_i·β + ε_i,    b = 0 for i < s, else 1

with the columns A of a motion of the base. Every s is tried, and compared with other changes by

    χ² + rank(A)·ln n

of n rows, the Bayesian information criterion. χ² is the sum of the squared residuals that a change leaves, in
units of noise and uncertainty.

Reference: G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6, 1978.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .._frozen import frozen
from .._typing import Array

# Fewest samples before and after a motion that is named; three positions determine the pose of the base.
MIN_PART = 3
# Singular values of columns, relative to the largest one, that count as zero.
RANK_TOL = 1e-9


@frozen(eq=False)
class Fit:
    """What one change leaves of the residuals."""

    coefficients: Array  # Coefficients of the columns, (c,)
    chi_square: float  # Sum of the squared residuals in units of noise and uncertainty
    rank: int  # Number of the coefficients that the samples determine
    criterion: float  # Bayesian information criterion

    @classmethod
    def of(cls, columns: Array, residual: Array) -> Fit:
        """Fit columns (n, c) to a residual (n,), both in units of noise and uncertainty."""
        coefficients, _, rank, _ = np.linalg.lstsq(columns, residual, rcond=RANK_TOL)
        chi_square = float(np.sum((residual - columns @ coefficients) ** 2))
        return cls(coefficients, chi_square, int(rank), chi_square + float(rank * np.log(len(residual))))


@frozen(eq=False)
class Slip:
    """Motion of the base from one sample on."""

    first: int  # Number of the first sample after the motion
    values: Array  # Motion [v, ω] of the base, (6,)
    covariance: Array  # Its covariance, (6, 6)
    chi_square: float  # Sum of the squared residuals that remain, in units of noise and uncertainty
    freedom: int  # Their degrees of freedom
    lead: float  # By how much the criterion of the best other change is larger
    is_determined: bool  # Whether there are enough samples before and after it


def find_slip(
    base: Array, residual: Array, whitening: Array, numbers: Array, others: Iterable[Array]
) -> Slip:
    """Find the sample from which on a base that moved explains the residuals best."""
    # `base` (n, 6), `residual` (n,) and the columns of other changes are multiplied by `whitening` (n, n),
    # which gives them unit covariance. `numbers` (n,) are those of the samples of the rows.
    scaled, count = whitening @ residual, int(numbers[-1]) + 1
    tried = {
        first: Fit.of(whitening @ np.where(numbers[:, None] >= first, base, 0.0), scaled)
        for first in range(1, count)
    }
    first, best = min(tried.items(), key=lambda pair: pair[1].criterion)
    rivals = [Fit.of(whitening @ columns, scaled).criterion for columns in others]
    a = whitening @ np.where(numbers[:, None] >= first, base, 0.0)
    return Slip(
        first,
        best.coefficients,
        np.linalg.pinv(a.T @ a, rcond=RANK_TOL**2, hermitian=True),
        best.chi_square,
        len(residual) - best.rank,
        min(rivals) - best.criterion,
        MIN_PART <= first <= count - MIN_PART,
    )
