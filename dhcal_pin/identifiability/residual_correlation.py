"""Correlation of residuals between configurations: errors of the model, which neighbours share.

Noise of an instrument is independent from sample to sample. What a model lacks is not: its error is nearly
the same in neighbouring configurations. The residuals of a sample are the sum of both,

    r_i = ε_i + δ(q_i),    cov(δ(q_i), δ(q_j)) = λ·k_ij·I,    k_ij = exp(-d_ij²/2l²),

in standard deviations of the residuals. The distance d_ij of two configurations is that of the points
(cos q, sin q) of revolute joints, and of prismatic joints in standard deviations of the joint.

Whether λ > 0 is decided by the score test, the most powerful one for small λ (Rao 1948). A fit with the
covariance S·Sᵀ of its unknowns leaves independent residuals with the covariance V = I - G·Gᵀ, where the rows
of G = J·S are those of the samples. With K the matrix of k_ij with a zero diagonal, for each component of the
residuals,

    Q    = rᵀ·K·r,    E[Q] = tr(K·V) = -tr(Gᵀ·K·G),    Var[Q] = 2·tr(K·V·K·V),
    z    = (Q - E[Q])/√Var[Q].

A z far below 0 also contradicts independent noise: a fit with many unknowns takes up more of errors that
neighbours share than of noise, and leaves less than nothing of them. For many samples V = I is used: this
lowers z, so that only a z far above 0 counts.

Shapes: m samples, k residuals per sample, r columns of S, n joints.

References:
    C. R. Rao, Large sample tests of statistical hypotheses concerning several parameters, Proc. Cambridge
    Phil. Soc. 44, 1948.
    L. Kish, Survey Sampling, Wiley 1965, section 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._kernels.work_arrays import work_array
from .._typing import Array
from ..estimation.problem import Chunk, Problem
from ..estimation.qr import TriangularSystem
from ..measurements.base import residual_of

# Distances l over which model errors are looked for, each half the one before [rad].
LENGTHS = tuple(2.0**-i for i in range(-1, 6))
# |z| of white residuals stays below; the largest of seven lengths exceeds it once in a thousand fits at most.
MAX_WHITE_Z = 4.5
# Smallest number (Σ k_ij)²/Σ k_ij² of pairs at a length; z of fewer is far from normal.
MIN_PAIRS = 30
# Largest number of configurations of each measurement whose distances are computed.
MAX_CONFIGURATIONS = 2000
# Largest number of products with which the effect of the fit on Q is computed. It is this many times larger
# for a fit with as many unknowns as residuals, whose effect is large.
MAX_PRODUCTS, MORE_PRODUCTS = 1e8, 10.0
# Number of configurations whose distances from all others are in memory at a time.
BLOCK_SIZE = 128
# Squared distance below which two configurations are the same.
SAME_CONFIGURATION = 1e-10
# Correlation of the residuals of configurations that are far apart, what is added to it for near ones,
# and the distance [rad] over which this falls.
FAR_CORRELATION, NEAR_CORRELATION, CORRELATION_LENGTH = 0.015, 0.15, 0.5


def find_residual_correlation(
    problem: Problem, x: Array, system: TriangularSystem, noise: float, weights: Sequence[Array]
) -> float:
    """Return z of the length at which it is farthest from 0, by the rows divided by the noise."""
    linearization, chain = problem.linearize(x), problem.chain(x)
    excess, variance, is_exact = np.zeros(len(LENGTHS)), np.zeros(len(LENGTHS)), True
    quadratic = np.zeros((len(LENGTHS), 1, 1))
    for item, w in zip(problem.data, weights, strict=True):
        chosen = np.flatnonzero(w > 0.5)
        if item.configurations_per_row != 1 or len(chosen) < 2:
            continue
        part = item.take(chosen[:: -(-len(chosen) // MAX_CONFIGURATIONS)])
        n_residuals, n_columns = len(part.rows) * part.residual_dim, len(x)
        effort = MAX_PRODUCTS * max(1.0, MORE_PRODUCTS * n_columns / n_residuals)
        if len(part.rows) * n_residuals * n_columns <= effort:
            root = system.sqrt_covariance(problem.weights)[0]
            rows = linearization.rows(Chunk(part, problem.errors.chain)) / noise
            effect, residual = np.tensordot(root, rows[:-1], (0, 0)), rows[-1]
        else:
            residual = residual_of(part, chain, linearization.instruments) / noise
            effect, is_exact = np.empty((0, *residual.shape)), False
        scores = _score_terms(_points(part.q, problem.errors.chain.is_prismatic), residual, effect)
        excess += scores.excess
        variance += scores.variance
        if len(effect):
            quadratic = quadratic + scores.quadratic
    excess += np.trace(quadratic, axis1=1, axis2=2)
    variance += 2 * np.sum(quadratic * np.swapaxes(quadratic, 1, 2), (1, 2))
    is_known = variance > 0
    z = np.where(is_known, excess / np.sqrt(np.where(is_known, variance, 1.0)), 0.0)
    if not is_exact:
        z = np.maximum(z, 0.0)
    return float(z[np.argmax(np.abs(z))])


class _ScoreTerms(NamedTuple):
    """Terms of the score of one measurement at each length: rᵀ·K·r, 2·tr(K·K) - 4·tr(GᵀKKG), and GᵀKG."""

    excess: Array
    variance: Array
    quadratic: Array


def _score_terms(points: Array, residual: Array, effect: Array) -> _ScoreTerms:
    """Compute the terms (l,), (l,), (l, r, r) of the score at each length; 0 where too few pairs are near."""
    n_columns, n_components, m = effect.shape
    excess, variance, sums, squares = np.zeros((4, len(LENGTHS)))
    quadratic = np.zeros((len(LENGTHS), n_columns, n_columns))
    for start in range(0, m, BLOCK_SIZE):
        block = np.s_[start : start + BLOCK_SIZE]
        # The kernel is symmetric: pairs of different blocks are computed once and counted twice. The effect
        # needs whole rows.
        first = 0 if n_columns else start
        shape = len(points[block]), m - first
        counts = np.full(shape, 1.0 if n_columns else 2.0)
        counts[:, :BLOCK_SIZE] = 1.0
        products = residual[:, block].T @ residual[:, first:] * counts
        kernel = _squared_distances(points[block], points[first:], work_array("kernel", *shape))
        is_same = kernel < SAME_CONFIGURATION
        kernel *= -0.5 / LENGTHS[0] ** 2
        np.exp(kernel, kernel)
        # Samples of the same configuration may also share noise of the instrument.
        kernel[is_same] = 0.0
        for i in range(len(LENGTHS)):
            sums[i] += np.vdot(kernel, counts)
            excess[i] += np.vdot(kernel, products)
            if n_columns:
                product = effect @ kernel.T
                variance[i] -= 4 * np.vdot(product, product)
                quadratic[i] += np.tensordot(product, effect[..., block], ((1, 2), (1, 2)))
            kernel *= kernel
            square = np.vdot(kernel, counts)
            squares[i] += square
            variance[i] += 2 * n_components * square
            # Half the length is the fourth power.
            kernel *= kernel
    has_pairs = sums**2 > MIN_PAIRS * squares
    return _ScoreTerms(excess * has_pairs, variance * has_pairs, quadratic * has_pairs[:, None, None])


def design_effect(q: Array, is_prismatic: Array) -> float:
    """Compute by how much the correlation of residuals enlarges the variance of a mean (Kish 1965)."""
    n_configurations = len(q)
    q = q[:: -(-n_configurations // MAX_CONFIGURATIONS)] if n_configurations else q
    if len(q) < 2:
        return 1.0
    points = _points(q, is_prismatic)
    near = np.exp(-0.5 * _squared_distances(points, points) / CORRELATION_LENGTH**2)
    mean = (np.sum(near) - np.trace(near)) / (len(q) * (len(q) - 1))
    return 1 + (n_configurations - 1) * (FAR_CORRELATION + NEAR_CORRELATION * float(mean))


def _points(q: Array, is_prismatic: Array) -> Array:
    """Return points whose distances are those of configurations (m, n)."""
    turning, sliding = q[:, ~is_prismatic], q[:, is_prismatic]
    std = sliding.std(0)
    return np.hstack([np.cos(turning), np.sin(turning), sliding[:, std > 0] / std[std > 0]])


def _squared_distances(points: Array, others: Array, out: Array | None = None) -> Array:
    """Return the squared distances (b, m) of points (b, d) from others (m, d)."""
    squares: Array = np.matmul(points, -2 * others.T, out)
    squares += np.sum(others**2, 1)
    squares += np.sum(points**2, 1)[:, None]
    return squares
