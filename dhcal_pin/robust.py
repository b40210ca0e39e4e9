"""Robust losses by reweighting whole samples, with a scale that gross errors do not reach.

A sample's squared whitened residuals sum to a χ² of as many degrees as it has rows. The median over the
samples tells the scale, and the cube root (Wilson and Hilferty) makes of each sum a score that is normal
for a good sample whatever its number of rows, so that one threshold serves every kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

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


# Weight of a sample by its score, and the score from which it counts for nothing; the constants keep 95 % of
# the efficiency on normal errors. Of Huber's weights a constant pull would remain, and a tenth of gross
# errors cost a quarter of the accuracy. What is left aside unasked must be more than a far corner of the
# workspace that the model does not bend to.
WEIGHTS: dict[str, tuple[Callable[[Array], Array], float]] = {
    "all": (_linear, np.inf),
    "gentle": (_huber, np.inf),
    "good": (_linear, 12.0),
    "huber": (_huber, OUTLYING),
    "cauchy": (_cauchy, OUTLYING),
    "tukey": (_tukey, OUTLYING),
}
# The weights that a loss goes through, each until it has settled. The next ones are for gross errors only:
# good samples then count in full, after a loss that no single one could draw away has told which they are.
LOSSES: dict[str, tuple[str, ...]] = {
    "auto": ("all", "gentle", "good"),
    "linear": ("all",),
    "huber": ("huber",),
    "cauchy": ("cauchy",),
    "tukey": ("tukey",),
}
# Whitened residuals of less variance than this are the fit's own doing.
LEAST_SPREAD = 1e-3
# Weights that change by more than this share of what they did last are not about to settle.
TURNS = 0.8
# A weight of this leaves a sample out without leaving a hole in the arithmetic.
NOTHING = 1e-12


def scores(residual: Array, spread: Array | None = None) -> Array:
    """How far each sample (m,) lies from its kind's scatter: standard normal for good ones.

    Args:
        residual: (k, m) whitened.
        spread: (m, k, k) its covariances up to a scale; unit ones without it.
    """
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
    scale = np.median(ratio) / middle**3 if len(ratio) else 0.0
    if scale <= 0:
        return np.zeros(len(ratio))
    return (np.cbrt(ratio / scale) - middle) / np.sqrt(2 / (9 * k))


def weight(score: Array, how: str) -> Array:
    """Weights (m,) of scores (m,)."""
    weights, gross = WEIGHTS[how]
    return np.maximum(np.where(score > gross, 0.0, weights(score)), NOTHING)


def reweighted(
    before: Sequence[Array], score: Sequence[Array], how: str, last: float
) -> tuple[list[Array], float]:
    """Weights of each item's samples by their scores, and by how much the largest change is.

    Where that is hardly less than the `last`, two sets of weights take turns, and what lies between is next.
    """
    weights = [weight(each, how) for each in score]
    moved = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(weights, before, strict=True))
    if moved > TURNS * last:
        weights = [0.5 * (a + b) for a, b in zip(weights, before, strict=True)]
    return weights, moved


def suspect(score: Array) -> bool:
    """Whether gross errors, which hide behind each other, may be among samples of scores (m,)."""
    return bool((score > OUTLYING).any())
