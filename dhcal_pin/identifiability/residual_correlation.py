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
    z    = (Q - E[Q])/√Var[Q],

and one step from λ = 0 to the maximum of the likelihood is λ = 2·(Q - E[Q])/Var[Q]. For many samples V = I is
used: this lowers z, as the fit takes up a part of what neighbours share.

Shapes: m samples, k residuals per sample, r columns of S, n joints.

References:
    C. R. Rao, Large sample tests of statistical hypotheses concerning several parameters, Proc. Cambridge
    Phil. Soc. 44, 1948.
    L. Kish, Survey Sampling, Wiley 1965, section 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..estimation.problem import Chunk, Problem

# Distances l over which model errors are looked for [rad].
LENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0)
# z of white residuals stays below; the largest of seven lengths exceeds it once in four thousand fits.
MAX_WHITE_Z = 4.0
# Smallest number (Σ k_ij)²/Σ k_ij² of pairs at a length; z of fewer is far from normal.
MIN_PAIRS = 30
# Largest number of configurations of each measurement whose distances are computed.
MAX_CONFIGURATIONS = 2000
# Largest number of products with which the effect of the fit on Q is computed.
MAX_PRODUCTS = 3e8
# Squared distance below which two configurations are the same.
SAME_CONFIGURATION = 1e-10
# Correlation of the residuals of configurations that are far apart, what is added to it for near ones,
# and the distance [rad] over which this falls.
FAR_CORRELATION, NEAR_CORRELATION, CORRELATION_LENGTH = 0.015, 0.15, 0.5


@dataclass(frozen=True)
class ResidualCorrelation:
    """Correlation of the residuals of a fit between configurations.

    Attributes:
        z: Largest score of the lengths, standard normal for independent residuals.
        share: Share λ of the variance of the residuals that neighbours share, 0 to 1.
    """

    z: float
    share: float

    @property
    def is_significant(self) -> bool:
        """Whether the residuals contradict independence."""
        return self.z > MAX_WHITE_Z


def find_residual_correlation(
    problem: Problem, x: Array, root: Array, noise: float, weights: Sequence[Array]
) -> ResidualCorrelation:
    """Test whether the residuals of neighbouring configurations are correlated.

    Args:
        problem: Problem at temperature 1 with any measurements; kinds with two configurations per row are
            left out.
        x: Its solution, (p,).
        root: Square root of the covariance of x for rows divided by `noise`, (p, r).
        noise: Standard deviation of the whitened residuals.
        weights: Robust weight of each sample, (m,) for each measurement; rejected samples are left out.

    Returns:
        The correlation; 0 without samples to compare.
    """
    linearization, chain = problem.linearize(x), problem.errors.at(x[: len(problem.errors.parameters)])
    excess, variance = np.zeros(len(LENGTHS)), np.zeros(len(LENGTHS))
    quadratic = np.zeros((len(LENGTHS), root.shape[1], root.shape[1]))
    for item, w in zip(problem.data, weights, strict=True):
        chosen = np.flatnonzero(w > 0.5)
        if item.configurations_per_row != 1 or len(chosen) < 2:
            continue
        part = item.take(chosen[:: -(-len(chosen) // MAX_CONFIGURATIONS)])
        if len(part.rows) ** 2 * part.residual_dim * root.shape[1] <= MAX_PRODUCTS:
            rows = linearization.rows(Chunk(part, problem.errors.chain)) / noise
            effect, residual = np.tensordot(root, rows[:-1], (0, 0)), rows[-1]
        else:
            values = problem.instrument_values_of(part, x)
            residual = part.residual(chain.forward_kinematics(part.configurations()), values) / noise
            effect = np.empty((0, *residual.shape))
        distances = _squared_distances(_points(part.q, problem.errors.chain.is_prismatic))
        for i, length in enumerate(LENGTHS):
            kernel = np.exp(-0.5 * distances / length**2)
            # Samples of the same configuration may also share noise of the instrument.
            kernel[distances < SAME_CONFIGURATION] = 0.0
            if np.sum(kernel) ** 2 <= MIN_PAIRS * np.sum(kernel**2):
                continue
            product = effect @ kernel
            excess[i] += np.sum(residual @ kernel * residual)
            variance[i] += 2 * (len(residual) * np.sum(kernel**2) - 2 * np.sum(product**2))
            if len(effect):
                quadratic[i] += product.reshape(len(effect), -1) @ effect.reshape(len(effect), -1).T
    excess += np.trace(quadratic, axis1=1, axis2=2)
    variance += 2 * np.sum(quadratic * np.swapaxes(quadratic, 1, 2), (1, 2))
    is_known = variance > 0
    if not is_known.any():
        return ResidualCorrelation(0.0, 0.0)
    z = np.where(is_known, excess / np.sqrt(np.where(is_known, variance, 1.0)), -np.inf)
    best = int(np.argmax(z))
    return ResidualCorrelation(float(z[best]), float(np.clip(2 * excess[best] / variance[best], 0.0, 1.0)))


def design_effect(q: Array, is_prismatic: Array) -> float:
    """Compute by how much the correlation of residuals enlarges the variance of a mean (Kish 1965).

    Args:
        q: Different configurations, (m, n) [rad or m].
        is_prismatic: Whether each joint is prismatic, (n,).

    Returns:
        Number of configurations over the number of independent ones with the same information, at least 1.
    """
    n_configurations = len(q)
    q = q[:: -(-n_configurations // MAX_CONFIGURATIONS)] if n_configurations else q
    if len(q) < 2:
        return 1.0
    near = np.exp(-0.5 * _squared_distances(_points(q, is_prismatic)) / CORRELATION_LENGTH**2)
    mean = (np.sum(near) - np.trace(near)) / (len(q) * (len(q) - 1))
    return 1 + (n_configurations - 1) * (FAR_CORRELATION + NEAR_CORRELATION * float(mean))


def _points(q: Array, is_prismatic: Array) -> Array:
    """Return points whose distances are those of configurations (m, n)."""
    turning, sliding = q[:, ~is_prismatic], q[:, is_prismatic]
    std = sliding.std(0)
    return np.hstack([np.cos(turning), np.sin(turning), sliding[:, std > 0] / std[std > 0]])


def _squared_distances(points: Array) -> Array:
    """Return the squared distances (m, m) of points (m, n)."""
    squares = np.sum(points**2, 1)
    out = points @ (-2 * points.T)
    out += squares
    out += squares[:, None]
    return out
