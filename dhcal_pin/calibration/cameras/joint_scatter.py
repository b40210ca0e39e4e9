"""Scatter of the joints that images do not exclude.

Eccentricity, elasticity and backlash turn each joint by a small angle that a model of the links lacks. In few
images the errors of the links imitate most of it, and what remains is no larger than noise. Images that do
not show a displacement (`jitter`) are then no evidence that there is none. With independent corners, the true
errors of 40 % of the simulated arms from 10 to 20 images were more than 1.5 times the stated ones.

The scatter δ ~ N(0, c²) of every joint [rad or m] displaces all corners of an image by A·J·δ, with the
whitened derivative A by the displacement of the tool and the motions J of the tool by the joints. The
restricted likelihood of c (Patterson and Thompson 1971) does not count what the unknowns explain. With the
R factor of the rows V^(-1/2)·[J r] of all images and of the priors, V = I + c²·A·J·Jᵀ·Aᵀ, and their cost C,

    log L(c) = -½·log det V - log det R - ½·C

With a uniform prior of c, the estimates have the RMS scatter of L(c), and their uncertainty the quantile
`CONFIDENCE` of it. Both fall with the number of images. Errors of the joints are smooth, and near
configurations share them: in the uncertainty, a scatter that the images show (log L(c) - log L(0) above the
limit of `jitter`) has a variance T times as large, with the temperature T of an open gate.

Reference: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal,
Biometrika 58, 1971.
"""

from __future__ import annotations

import numpy as np

from ..._frozen import frozen
from ..._kernels.types import FrameBatch
from ..._typing import Array
from ...estimation.problem import Problem
from ...estimation.qr import TriangularSystem, merge_r_factors
from ...measurements.camera import CameraCorners
from ...robot.chain import Chain
from ..reweighting import Fit
from .jitter import MIN_LOG_LIKELIHOOD_RATIO, MIN_STD, with_displacements

# Probability that the scatter is smaller than the largest one.
CONFIDENCE = 0.9
# Scatter for which the displacements of images are computed, and smallest and largest one [rad or m].
_UNIT, _SMALLEST, _LARGEST, _N_SCATTERS = 1e-3, 1e-6, 1e-2, 120


@frozen
class JointScatter:
    """Scatter of the joints by its restricted likelihood."""

    expected: float  # RMS scatter [rad or m]
    largest: float  # Scatter that the images do not exclude [rad or m]
    log_likelihood_ratio: float  # Logarithm of the largest likelihood over that without scatter


def fit_with_joint_scatter(fit: Fit, noise: float, temperature: float, max_iterations: int) -> Fit:
    """Fit again with the expected scatter of the joints and the noise of corners."""
    unit = _scattered(fit, noise, _UNIT)
    scatter = estimate_scatter(unit.problem, unit.solution.x)
    largest = scatter.largest / scatter.expected
    if scatter.log_likelihood_ratio > MIN_LOG_LIKELIHOOD_RATIO:
        largest *= np.sqrt(temperature)
    return _scattered(fit, noise, scatter.expected, largest).solved(max_iterations)


def _scattered(fit: Fit, noise: float, scatter: float, largest: float = 1.0) -> Fit:
    """Return a fit whose images have the noise of the corners and a scatter of the joints."""

    def covariance(chain: Chain, frames: FrameBatch) -> Array:
        motions = chain.joint_jacobian(frames).transpose(2, 1, 0)
        return scatter**2 * motions @ motions.swapaxes(1, 2) + MIN_STD**2 * np.eye(6)

    data = with_displacements(fit.problem, fit.solution.x, fit.data, noise, covariance, largest)
    return fit.with_sigmas(data)


def estimate_scatter(problem: Problem, x: Array) -> JointScatter:
    """Estimate the scatter of the joints from a problem whose images have the scatter `_UNIT`."""
    linearization = problem.linearize(x)
    displaced, sizes, others = [np.empty((0, len(x) + 1))], [np.empty(0)], []
    for chunk in problem.chunks:
        rows = linearization.rows(chunk)
        if isinstance(chunk.data, CameraCorners):
            for along, size in chunk.data.take_displacements(rows):
                displaced.append((along * np.sqrt(1 + size**2)).T)
                sizes.append(size)
        others.append(rows.reshape(len(rows), -1).T)
    other_rows, displaced_rows = merge_r_factors(others), np.concatenate(displaced)
    in_units = np.concatenate(sizes) / _UNIT
    scatters = np.append(0.0, np.geomspace(_SMALLEST, _LARGEST, _N_SCATTERS))
    rank, log_likelihoods = None, []
    for scatter in scatters:
        std = np.sqrt(1 + (scatter * in_units) ** 2)
        system = TriangularSystem(merge_r_factors([other_rows, displaced_rows / std[:, None]]))
        system = system.with_priors(problem.prior_weights, x)
        rank = rank or system.rank
        log_determinant = np.sum(np.log(std)) + np.sum(np.log(system.singular_values[:rank]))
        log_likelihoods.append(-log_determinant - system.min_cost / 2)
    best = max(log_likelihoods)
    density = np.exp(np.array(log_likelihoods) - best)
    shares = (density[1:] + density[:-1]) * np.diff(scatters)
    squares = (scatters[1:] ** 2 + scatters[:-1] ** 2) / 2
    cumulated = np.append(0.0, np.cumsum(shares))
    largest = float(np.interp(CONFIDENCE * cumulated[-1], cumulated, scatters))
    expected = float(np.sqrt(np.average(squares, weights=shares)))
    return JointScatter(expected, largest, float(best - log_likelihoods[0]))
