"""Noise of corners that are displaced independently of each other: in the image, and at the board.

An error of detection displaces a corner in the image by about as many pixels wherever the board is. An error
of the arm displaces it at the board by about as many millimetres, and these are the more pixels the nearer
the board is. With the standard deviations σ in the image and a along each axis at the board, and the
derivative b (3,) of an image coordinate by a displacement of the corner, the variance of that coordinate is

    v = φ·((1 - t)·s² + t·c·|b|²),    σ² = φ·(1 - t)·s²,    a² = φ·t·c,

with the placeholder s of σ and c = mean of s² / mean of |b|². The share t is that of greatest likelihood of
the residuals r of a fit,

    log p(r|t, φ) = -½·Σ log v - ½·Σ r²/v,

and φ follows from it for each t, as the residuals have the variance φ on average. Standard deviations σ that
are stated are kept: then φ = 1/(1 - t).

The displacement that the corners of an image share is another model of the same error, see `jitter`.
"""

from __future__ import annotations

import numpy as np

from ..._typing import Array
from ...estimation.priors import effective_parameters
from ...estimation.problem import Problem
from ...estimation.robust import ZERO_WEIGHT
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners
from ..reweighting import Fit

# Rounds of noise and solution.
_N_ROUNDS = 2
# Largest share of the displacement at the board beside the noise in the image.
_MAX_SHARE = 0.9999


def fit_with_corner_noise(fit: Fit, max_iterations: int) -> Fit:
    """Estimate how far corners are displaced in the image and at the board, and fit again."""
    for _ in range(_N_ROUNDS):
        fit = fit.solved_with(_with_corner_noise(fit), max_iterations)
    return fit


def _with_corner_noise(fit: Fit) -> tuple[Measurement, ...]:
    """Return the measurements with the standard deviations of greatest likelihood."""
    slopes, good = {}, []
    is_stated = True
    for number, (item, weights) in enumerate(zip(fit.data, fit.weights, strict=True)):
        if isinstance(item, CameraCorners):
            errors, slopes[number] = _errors_and_slopes(item, fit.problem, fit.solution.x)
            rows = np.stack([errors**2, item.sigma**2, slopes[number]])
            good.append(rows[:, weights > ZERO_WEIGHT].reshape(3, -1))
            is_stated = is_stated and item.has_stated_sigma
    squares, in_image, at_board = np.concatenate(good, 1)
    n_determined = effective_parameters(fit.problem, fit.solution)
    factor, variance = estimate_corner_variances(squares, in_image, at_board, n_determined, is_stated)
    return tuple(
        item.replace(sigma=np.sqrt(factor * item.sigma**2 + variance * slopes[number]))
        if isinstance(item, CameraCorners)
        else item
        for number, item in enumerate(fit.data)
    )


def _errors_and_slopes(item: CameraCorners, problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return errors [px] and squared derivatives [px²/m²] of image coordinates, (m, 2) each."""
    chain = problem.chain(x)
    frames, u = chain.forward_kinematics(item.conditions()), problem.instrument_values_of(item, x)
    return item.errors(frames, u)["pixels"], np.sum(item.corner_derivative(frames, u) ** 2, 2)


def estimate_corner_variances(
    squares: Array, in_image: Array, at_board: Array, n_determined: float, is_stated: bool
) -> tuple[float, float]:
    """Estimate a factor to the variances s² of corners, and the variance per axis at the board [m²]."""
    from scipy.optimize import minimize_scalar  # lazy import: slow, and few calibrations need it

    # The squared residuals, the stated or placeholder variances s² [px²] and the squared derivatives |b|²
    # [px²/m²] have shape (k,).
    ratio = float(in_image.mean() / at_board.mean())
    freedom = max(1 - n_determined / len(squares), 0.2)

    def scale(share: float, variance: Array) -> float:
        return 1 / (1 - share) if is_stated else float(np.mean(squares / variance)) / freedom

    def cost(share: float) -> float:
        variance = (1 - share) * in_image + share * ratio * at_board
        variance = scale(share, variance) * variance
        return float(np.sum(np.log(variance)) + np.sum(squares / variance) / freedom)

    bounds = (0.0, _MAX_SHARE)
    found = minimize_scalar(cost, bounds=bounds, method="bounded").x
    share = min((float(found), *bounds), key=cost)
    factor = scale(share, (1 - share) * in_image + share * ratio * at_board)
    return factor * (1 - share), factor * share * ratio
