"""Robust losses by reweighting whole samples, with a scale that gross errors do not reach.

A sample's squared whitened residuals sum to a χ² of as many degrees as it has rows. The median over the
samples tells the scale, and the cube root (Wilson and Hilferty) makes of each sum a score that is normal
for a good sample whatever its number of rows, so that one threshold serves every kind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from .._typing import Array
from ..measurements.base import Measurement
from . import qr
from .problem import CHUNK_SIZE, Chunk, Linearization, Problem, chunk_residual, linearize_and_factor
from .qr import posterior_sqrt_covariance
from .solver import SolverResult

# Scores beyond this are gross: one good sample in three million.
OUTLIER_THRESHOLD = 5.0


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
    "uniform": (_linear, np.inf),
    "huber_no_cutoff": (_huber, np.inf),
    "reject": (_linear, 12.0),
    "huber": (_huber, OUTLIER_THRESHOLD),
    "cauchy": (_cauchy, OUTLIER_THRESHOLD),
    "tukey": (_tukey, OUTLIER_THRESHOLD),
}


# The weights that a loss goes through, each until it has settled. The next ones are for gross errors only:
# good samples then count in full, after a loss that no single one could draw away has told which they are.
LOSSES: dict[str, tuple[str, ...]] = {
    "auto": ("uniform", "huber_no_cutoff", "reject"),
    "linear": ("uniform",),
    "huber": ("huber",),
    "cauchy": ("cauchy",),
    "tukey": ("tukey",),
}


# Whitened residuals of less variance than this are the fit's own doing.
MIN_VARIANCE = 1e-3


# Weights that change by more than this share of what they did last are not about to settle.
OSCILLATION_RATIO = 0.8


# A weight of this leaves a sample out without leaving a hole in the arithmetic.
ZERO_WEIGHT = 1e-12


def standardized_residuals(residual: Array, spread: Array | None = None) -> Array:
    """How far each sample (m,) lies from its kind's scatter: standard normal for good ones.

    Args:
        residual: (k, m) whitened.
        spread: (m, k, k) its covariances up to a scale; unit ones without it.
    """
    k = len(residual)
    if spread is None:
        return standardize_mean_squares(np.sum(residual**2, 0) / k, k)
    # A reading that the fit meets whatever it is tells nothing.
    freed = spread + MIN_VARIANCE * np.eye(k)
    return standardize_mean_squares(
        np.sum(residual.T * np.linalg.solve(freed, residual.T[..., None])[..., 0], 1) / k, k
    )


def standardize_mean_squares(ratio: Array, k: int) -> Array:
    """Scores (m,) of mean squares (m,) of k residuals each, against their own median."""
    middle = 1 - 2 / (9 * k)
    # The median of χ²_k / k is middle³.
    scale = np.median(ratio) / middle**3 if len(ratio) else 0.0
    if scale <= 0:
        return np.zeros(len(ratio))
    return (np.cbrt(ratio / scale) - middle) / np.sqrt(2 / (9 * k))


def sample_weights(score: Array, stage: str) -> Array:
    """Weights (m,) of scores (m,)."""
    weights, gross = WEIGHTS[stage]
    return np.maximum(np.where(score > gross, 0.0, weights(score)), ZERO_WEIGHT)


def update_weights(
    previous: Sequence[Array], score: Sequence[Array], stage: str, last_change: float
) -> tuple[list[Array], float]:
    """Weights of each item's samples by their scores, and by how much the largest change is.

    Where that is hardly less than the `last`, two sets of weights take turns, and what lies between is next.
    """
    weights = [sample_weights(each, stage) for each in score]
    moved = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(weights, previous, strict=True))
    if moved > OSCILLATION_RATIO * last_change:
        weights = [0.5 * (a + b) for a, b in zip(weights, previous, strict=True)]
    return weights, moved


def has_possible_outliers(score: Array) -> bool:
    """Whether gross errors, which hide behind each other, may be among samples of scores (m,)."""
    return bool((score > OUTLIER_THRESHOLD).any())


# Where a row takes so small a share of the unknowns, what it draws to itself does not matter.
NEGLIGIBLE_LEVERAGE = 0.01


def studentized_residuals(
    problem: Problem, solution: SolverResult, data: Sequence[Measurement], weights: Sequence[Array]
) -> list[Array]:
    """How far each sample (m,) of each item lies from its kind's scatter; see `standardized_residuals`.

    Zero where no reading is left over: then the scatter tells nothing.

    Args:
        problem: as it was fitted.
        solution: where that ended.
        data: the fitted measurements with the sigmas of good samples.
        weights: (m,) of each item's samples in the fit.
    """
    rows = sum(np.count_nonzero(w > 0.5) * item.residual_dim for item, w in zip(data, weights, strict=True))
    most = len(solution.x)
    if rows <= most and rows <= qr.rank(solution.system.r):
        return [np.zeros(len(item.rows)) for item in data]
    chain = problem.errors.at(solution.x[: len(problem.errors.parameters)])
    found = problem.with_data(data).map_chunks(
        partial(chunk_residual, chain, problem.instruments(solution.x))
    )
    residuals = [np.concatenate([np.empty((item.residual_dim, 0)), *_parts(found, item)], 1) for item in data]
    spread = (
        residual_covariances(problem, solution, weights)
        if most >= NEGLIGIBLE_LEVERAGE * rows
        else [None] * len(data)
    )
    return [standardized_residuals(*both) for both in zip(residuals, spread, strict=True)]


def _parts(found: Iterator[Array], item: Measurement) -> Iterator[Array]:
    """What was found in the chunks of one item."""
    for _ in range(0, len(item.rows), CHUNK_SIZE):
        yield next(found)


def residual_covariances(problem: Problem, solution: SolverResult, weights: Sequence[Array]) -> list[Array]:
    """Covariances (m, k, k) of each item's whitened residuals in a fit of good readings.

    A sample that takes part lies nearer to the fit than its sigma, by what it draws the fit to itself; one
    that counts for nothing lies farther, by how little the others know there.
    """
    # The loop's last triangle is of a step before, where other directions are unseen, which the wide priors
    # of frames and instruments make far of: its covariance would not go with these rows.
    root = posterior_sqrt_covariance(
        linearize_and_factor(problem, solution.x, small_angle=False), problem.weights
    )[0]
    found = problem.map_chunks(partial(_prediction_covariance, problem.linearize(solution.x), root))
    out = []
    for item, weight in zip(problem.data, weights, strict=True):
        parts = [np.empty((0, item.residual_dim, item.residual_dim)), *_parts(found, item)]
        w = weight[:, None, None]
        out.append(np.eye(item.residual_dim) + (1 - 2 * w) * np.concatenate(parts) / w)
    return out


def _prediction_covariance(tangent: Linearization, root: Array, chunk: Chunk) -> Array:
    """What is not known of a chunk's whitened readings: covariances (m, k, k)."""
    known = np.tensordot(root, tangent.rows(chunk)[:-1], (0, 0))
    return np.einsum("rim,rjm->mij", known, known)
