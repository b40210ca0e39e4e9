"""Even filling of the bins of the joints, which decides before any criterion.

A correction curve of a joint is determined near the joint values that were measured. A design for such curves
should therefore visit all bins of every joint (`robot.coverage`), and then fill them evenly. With c_b
configurations in bin b, the evenness of a design is

    E = Σ_b (1 + 1/2 + … + 1/c_b),

so a configuration counts 1 in each empty bin that it visits and 1/(1+c) in a bin that has c already. This is
close to the D-optimality Σ_b log(1 + c_b) of a curve that is constant in each bin.

Shapes: n and w configurations, j joints with curves.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..robot.coverage import N_BINS, bin_indices

# Weight of the evenness in units of a criterion's logarithm. It is so large that the criterion only decides
# between equal values of the evenness.
_WEIGHT = 1e6


def filling_gains(values: Array, filled: Array) -> Array:
    """Compute how much each of some joint values (w, j) raises the weighted evenness of a design (n, j)."""
    out = np.zeros(len(values))
    for bins, counts in zip(bin_indices(values).T, _bin_counts(filled), strict=True):
        out += _WEIGHT / (1 + counts[bins])
    return out


def filling_cost(filled: Array) -> float:
    """Compute the negative weighted evenness of a design."""
    harmonic_numbers = np.cumsum(1 / np.arange(1, len(filled) + 1))
    return -_WEIGHT * sum(
        float(harmonic_numbers[counts[counts > 0] - 1].sum()) for counts in _bin_counts(filled)
    )


def _bin_counts(values: Array) -> list[Array]:
    """Count the configurations (n, j) in each bin of each joint."""
    return [np.bincount(bins, minlength=N_BINS) for bins in bin_indices(values).T]
