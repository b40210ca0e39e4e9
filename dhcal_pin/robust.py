"""Robust losses by reweighting whole samples, with a scale that gross errors do not reach.

A sample's squared whitened residuals sum to a χ² of as many degrees as it has rows. The median over the
samples tells the scale, and the cube root (Wilson and Hilferty) makes of each sum a score that is normal
for a good sample whatever its number of rows, so that one threshold serves every kind.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .chain import Chain
from .measurements import Measurement
from .se3 import Array

# Scores beyond this are gross: one good sample in three million. Gross errors in a fit hide behind the
# scatter that they make themselves, so that it is looked into from this one on.
OUTLYING, SUSPECT = 5.0, 3.5


def _linear(score: Array) -> Array:
    return np.ones_like(score)


def _huber(score: Array) -> Array:
    return 1.345 / np.maximum(score, 1.345)


def _cauchy(score: Array) -> Array:
    return 1 / (1 + (np.maximum(score, 0) / 2.385) ** 2)


def _tukey(score: Array) -> Array:
    return np.maximum(1 - (np.clip(score, 0, 4.685) / 4.685) ** 2, 0) ** 2


# Weight of a sample by its score; the constants keep 95 % of the efficiency on normal errors.
WEIGHTS: dict[str, Callable[[Array], Array]] = {
    "all": _linear,
    "good": _linear,
    "huber": _huber,
    "cauchy": _cauchy,
    "tukey": _tukey,
}
# The weights that a loss goes through, each until it has settled. The next ones are for gross errors only:
# good samples then count in full, after a loss that no single one could draw away has told which they are.
LOSSES: dict[str, tuple[str, ...]] = {
    "auto": ("all", "huber", "good"),
    "linear": ("all",),
    "huber": ("huber",),
    "cauchy": ("cauchy",),
    "tukey": ("tukey",),
}
# Whitened residuals of less variance than this are the fit's own doing.
LEAST_SPREAD = 1e-3
# A weight of this leaves a sample out without leaving a hole in the arithmetic.
NOTHING = 1e-12


def scores(chain: Chain, item: Measurement, u: Array, spread: Array | None = None) -> Array:
    """How far each sample (m,) lies from its kind's scatter: standard normal for good ones.

    Args:
        chain: as fitted.
        item: the samples.
        u: values of their unknowns.
        spread: (m, k, k) covariances of their whitened residuals up to a scale; unit ones without it.
    """
    residual = item.residual(chain.sweep(item.configurations()), u)
    k = len(residual)
    if spread is None:
        return scored(np.sum(residual**2, 0) / k, k)
    # A reading that the fit meets whatever it is tells nothing.
    freed = spread + LEAST_SPREAD * np.eye(k)
    return scored(np.sum(residual.T * np.linalg.solve(freed, residual.T[..., None])[..., 0], 1) / k, k)


def scored(ratio: Array, k: int) -> Array:
    """Scores (m,) of mean squares (m,) of k residuals each, against their own median."""
    middle = 1 - 2 / (9 * k)
    # The median of χ²_k / k is middle³.
    scale = np.median(ratio) / middle**3
    if scale <= 0:
        return np.zeros(len(ratio))
    return (np.cbrt(ratio / scale) - middle) / np.sqrt(2 / (9 * k))


def weight(score: Array, how: str) -> Array:
    """Weights (m,) of scores (m,).

    What is named as a gross error counts for nothing whatever the loss: of Huber's a constant pull remains,
    and a tenth of them would cost a quarter of the accuracy.
    """
    gross = (score > OUTLYING) & (how != "all")
    return np.maximum(np.where(gross, 0.0, WEIGHTS[how](score)), NOTHING)


def suspect(score: Array) -> bool:
    """Whether gross errors may be among samples of scores (m,)."""
    return bool((score > SUSPECT).any())
