"""Robust losses by reweighting whole samples, with a scale that gross errors do not reach.

A sample's squared whitened residuals sum to a χ² of as many degrees as it has rows. The median over the
samples tells the scale, and the cube root (Wilson and Hilferty) makes of each sum a score that is normal
for a good sample whatever its number of rows, so that one threshold serves every kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .chain import Chain
from .measurements import Measurement
from .se3 import Array

# Scores beyond this are gross: one good sample in three million.
OUTLYING = 5.0


def _linear(score: Array) -> Array:
    return np.ones_like(score)


def _huber(score: Array) -> Array:
    return 1.345 / np.maximum(score, 1.345)


def _cauchy(score: Array) -> Array:
    return 1 / (1 + (np.maximum(score, 0) / 2.385) ** 2)


def _tukey(score: Array) -> Array:
    return np.maximum(1 - (np.clip(score, 0, 4.685) / 4.685) ** 2, 0) ** 2


# Weight of a sample by its score; the constants keep 95 % of the efficiency on normal errors.
LOSSES: dict[str, Callable[[Array], Array]] = {
    "linear": _linear,
    "huber": _huber,
    "cauchy": _cauchy,
    "tukey": _tukey,
}
# A weight below this leaves a sample out without leaving a hole in the arithmetic.
_LEAST = 1e-12


def scores(chain: Chain, item: Measurement, u: Array) -> Array:
    """How far each sample (m,) lies from its kind's scatter: standard normal for good ones."""
    residual = item.residual(chain.sweep(item.configurations()), u)
    k = len(residual)
    middle = 1 - 2 / (9 * k)
    ratio = np.sum(residual**2, 0) / k
    # The median of χ²_k / k is middle³.
    scale = np.median(ratio) / middle**3
    if scale <= 0:
        return np.zeros(residual.shape[1])
    return (np.cbrt(ratio / scale) - middle) / np.sqrt(2 / (9 * k))


def reweighted(
    chain: Chain, data: Sequence[Measurement], values: Sequence[Array], loss: str
) -> tuple[tuple[Measurement, ...], list[Array]]:
    """The data with every sample's sigmas widened as the loss wants, and the weights (m,) an item.

    What is named as a gross error counts for nothing whatever the loss: of Huber's a constant pull remains,
    and a tenth of them would cost a quarter of the accuracy.
    """
    found = [scores(chain, item, u) for item, u in zip(data, values, strict=True)]
    weights = [np.maximum(np.where(score > OUTLYING, 0.0, LOSSES[loss](score)), _LEAST) for score in found]
    return tuple(item.weighted(w) for item, w in zip(data, weights, strict=True)), weights


def outliers(chain: Chain, item: Measurement, u: Array) -> Array:
    """Row numbers of samples that are gross errors."""
    return item.rows[scores(chain, item, u) > OUTLYING]
