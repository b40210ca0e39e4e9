"""Distribution functions of the normal, the χ² and Student's t distribution by closed forms.

They serve tests against a probability. `scipy.special` takes longer to load than a calibration takes.

References:
    M. Abramowitz and I. A. Stegun, Handbook of Mathematical Functions, 1964, sections 26.2, 26.4 and 26.7.
"""

from __future__ import annotations

import math

import numpy as np

from ._typing import Array

_erf = np.vectorize(math.erf, otypes=[float])
_erfc = np.vectorize(math.erfc, otypes=[float])


def normal_cdf(x: Array) -> Array:
    """Compute the probability that a standard normal variable is at most x."""
    return _erfc(-x / math.sqrt(2)) / 2


def chi_square_cdf(x: Array, k: int) -> Array:
    """Compute the probability that the sum of k squared standard normal variables is at most x."""
    half = x / 2
    a, out = (1.0, -np.expm1(-half)) if k % 2 == 0 else (0.5, _erf(np.sqrt(half)))
    # Abramowitz & Stegun, eq. 26.4.4 and 26.4.5
    while a < k / 2:
        out = out - half**a * np.exp(-half) / math.gamma(a + 1)
        a += 1
    return out


def student_cdf(t: float, freedom: int) -> float:
    """Compute the probability that a variable of Student's distribution is at most t; NaN without freedom."""
    if freedom < 1:
        return math.nan
    angle = math.atan(t / math.sqrt(freedom))
    # Abramowitz & Stegun, eq. 26.7.3 and 26.7.4: a finite series in powers of cos².
    is_odd = freedom % 2
    j = np.arange(2 + is_odd, freedom - 1, 2)
    terms = np.cumprod((j - 1) / j * math.cos(angle) ** 2)
    central = math.sin(angle) * (1 + terms.sum())
    if is_odd:
        central = 2 / math.pi * (angle + math.cos(angle) * central * (freedom > 1))
    return (1 + central) / 2
