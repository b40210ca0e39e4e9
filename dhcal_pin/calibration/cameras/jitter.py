"""Size of the displacement that all corners of one image share.

The scatter of the corners within an image, after the displacement of the tool that explains the image best,
shows the noise of the corners. What the images still differ by is an error of the arm in each configuration.
It is modelled as a random displacement [v, ω] of the tool, v ~ N(0, a²) and ω ~ N(0, b²) in each axis; see
`measurements.camera`. The play of a low-cost arm displaces the tool by its n revolute joints, too, with the
motions J of the tool and c² the variance of each joint: d = [v, ω] + J·δ, δ ~ N(0, c²). The standard
deviations a, b and c follow by expectation and maximization (Dempster, Laird and Rubin 1977). With the
whitened derivative A_i of image i by [v, ω, δ], its residuals r_i and D = diag(a², ..., b², ..., c², ...):

    C_i = (D⁻¹ + A_iᵀ·A_i)⁻¹,    m_i = C_i·A_iᵀ·r_i,    a² ← mean of m_v² + C_vv,

and so on for b² and c². The covariance of the displacement d is diag(a², a², a², b², b², b²) + c²·J·Jᵀ.

Whether the images show a displacement at all is said by the ratio of the likelihoods with it and without it.

Reference: A. Dempster, N. Laird and D. Rubin, Maximum Likelihood from Incomplete Data via the EM Algorithm,
J. Royal Statistical Society B 39, 1977.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..._frozen import frozen
from ..._kernels.types import FrameBatch
from ..._typing import Array
from ...estimation.parameters import LOW_COST
from ...estimation.problem import Problem
from ...measurements.base import Measurement, label_stops
from ...measurements.camera import CameraCorners
from ...robot.chain import Chain

# First standard deviations of the displacement [m], [rad] and of the joints [rad], and smallest ones.
FIRST_STD = (1e-3, 1e-3, 1e-3)
MIN_STD = 1e-7
# Part of the trace of a matrix that rounding can remove from its diagonal.
_ROUNDING = 1e-14
# Iterations, and relative change that ends them.
_N_ITERATIONS, _RTOL = 200, 1e-3
# Smallest noise of a detected corner, relative to the placeholder of 1 px.
MIN_NOISE = 0.1
# Largest whitened residual: boards behind a camera have image coordinates without limit.
MAX_RESIDUAL = 1e5
# Logarithm of the ratio of the likelihoods from which images show a displacement.
MIN_LOG_LIKELIHOOD_RATIO = 5.5


@frozen
class Jitter:
    """Noise of corners and displacement of images."""

    noise: float  # Standard deviation of an image coordinate, relative to the stated or placeholder one
    position: float  # Standard deviation of the displacement of the tool along each axis [m]
    rotation: float  # Standard deviation of its rotation about each axis [rad]
    # Standard deviation of the displacement of each revolute joint of a low-cost arm [rad].
    joints: float = 0.0
    # Logarithm of the likelihood with the displacement over that without it, where noise explains all.
    log_likelihood_ratio: float = 0.0

    @property
    def is_significant(self) -> bool:
        """Whether the images show a displacement: an error of the arm that the model lacks."""
        return self.log_likelihood_ratio > MIN_LOG_LIKELIHOOD_RATIO


def estimate_jitter(
    problem: Problem,
    x: Array,
    data: Sequence[Measurement],
    weights: Sequence[Array],
    n_determined: float,
) -> Jitter:
    """Estimate the noise of corners and the displacement of images from the residuals of a fit."""
    chain = problem.chain(x)
    images: list[tuple[Array, Array]] = []
    is_stated = True
    for item, weight in zip(data, weights, strict=True):
        if not isinstance(item, CameraCorners) or not (weight > 0.5).any():
            continue
        inliers = item.take(weight > 0.5)
        plain = inliers.with_jitter(np.zeros_like(inliers.jitter))
        frames = chain.forward_kinematics(plain.conditions())
        u = problem.instrument_values_of(plain, x)
        residual = plain.residual(frames, u)
        derivative = plain.displacement_derivative(frames, u) / plain.sigma[:, :, None]
        derivative = np.concatenate([derivative, derivative @ _joint_motions(chain, frames)], 2)
        label = label_stops(plain)
        is_stated = is_stated and item.has_stated_sigma
        for number in range(label.max() + 1):
            samples = label == number
            if np.abs(residual[:, samples]).max() < MAX_RESIDUAL:
                of_image = derivative[samples].reshape(-1, derivative.shape[2])
                images.append((residual.T[samples].ravel(), of_image))
    if not images:
        return Jitter(1.0, *FIRST_STD)
    noise = 1.0 if is_stated else _scatter(images)
    scaled = [(r / noise, a / noise) for r, a in images]
    jitter = _maximize_likelihood(scaled, noise, n_determined)
    # Without a displacement the noise is that of all residuals.
    n_rows = sum(len(r) for r, _ in scaled)
    squares = sum(float(r @ r) for r, _ in scaled)
    ratio = _log_likelihood(scaled, jitter)
    if not is_stated:
        variance = squares / max(n_rows - n_determined, 1.0)
        ratio += 0.5 * (n_rows - n_determined) * (np.log(variance) + 1) - 0.5 * squares
    return replace(jitter, log_likelihood_ratio=float(ratio))


def _joint_motions(chain: Chain, frames: FrameBatch) -> Array:
    """Return the motions of the tool by the joints of a low-cost arm that have play, (m, 6, n)."""
    has_play = ~chain.is_prismatic & (LOW_COST in chain.parameters)
    return chain.joint_jacobian(frames)[has_play].transpose(2, 1, 0)


def _groups(n_components: int) -> Array:
    """Return the number of the standard deviation of each component: 6 of the tool, then the joints."""
    return np.repeat([0, 1, 2], [3, 3, n_components - 6])


def _log_likelihood(images: Sequence[tuple[Array, Array]], jitter: Jitter) -> float:
    """Return the logarithm of the likelihood of a displacement over that of none with the same noise."""
    out, std = 0.0, np.array([jitter.position, jitter.rotation, jitter.joints])
    for residual, derivative in images:
        # I + A·Aᵀ in the singular vectors of A, which may be large and singular for images of another arm.
        u, s, _ = np.linalg.svd(derivative * std[_groups(derivative.shape[1])], full_matrices=False)
        explained = (u.T @ residual) ** 2 * s**2 / (1 + s**2)
        out += 0.5 * float(np.sum(explained - np.log1p(s**2)))
    return out


def _scatter(images: Sequence[tuple[Array, Array]]) -> float:
    """Return the standard deviation of whitened residuals that no displacement explains."""
    squares = freedom = 0.0
    for residual, derivative in images:
        basis = np.linalg.svd(derivative, full_matrices=False)[0]
        squares += float(residual @ residual - np.sum((basis.T @ residual) ** 2))
        freedom += max(len(residual) - basis.shape[1], 0)
    return max(float(np.sqrt(squares / freedom)), MIN_NOISE) if freedom else 1.0


def _maximize_likelihood(images: Sequence[tuple[Array, Array]], noise: float, n_determined: float) -> Jitter:
    """Return the standard deviations of the displacement of greatest likelihood."""
    std = np.array(FIRST_STD)
    # The fit has absorbed a part of the displacements: that of the parameters among six per image.
    n_displacements = 6 * len(images)
    share = max(1 - n_determined / n_displacements, 0.2)
    information = np.array([a.T @ a for _, a in images])
    projected = np.array([a.T @ r for r, a in images])
    groups = _groups(information.shape[1])
    counts = np.fmax(np.bincount(groups, minlength=3), 1)
    for _ in range(_N_ITERATIONS):
        # (I + B)⁻¹ in units of the standard deviations; B may be large and singular for another arm.
        scale = np.outer(std[groups], std[groups])
        scaled = scale * information
        one = 1 + _ROUNDING * np.trace(scaled, axis1=1, axis2=2)
        covariance = scale * np.linalg.inv(scaled + one[:, None, None] * np.eye(len(groups)))
        mean = (covariance @ projected[:, :, None])[:, :, 0]
        squares = np.mean(mean**2 / share + np.diagonal(covariance, axis1=1, axis2=2), 0)
        updated = np.fmax(np.sqrt(np.bincount(groups, squares, 3) / counts), MIN_STD)
        change = np.abs(np.log(updated / std)).max()
        std = updated
        if change < _RTOL:
            break
    return Jitter(noise, *std.tolist())


def with_jitter(
    problem: Problem, x: Array, data: Sequence[Measurement], jitter: Jitter
) -> tuple[Measurement, ...]:
    """Give image coordinates the noise and the jitter that were estimated."""

    def covariance(chain: Chain, frames: FrameBatch) -> Array:
        motions = _joint_motions(chain, frames)
        of_tool = np.diag([jitter.position**2] * 3 + [jitter.rotation**2] * 3)
        return of_tool + jitter.joints**2 * motions @ motions.swapaxes(1, 2)

    return with_displacements(problem, x, data, jitter.noise, covariance)


def with_displacements(
    problem: Problem,
    x: Array,
    data: Sequence[Measurement],
    noise: float,
    covariance: Callable[[Chain, FrameBatch], Array],
    largest: float = 1.0,
) -> tuple[Measurement, ...]:
    """Give image coordinates a noise and the displacements of the tool of a covariance, (m, 6, 6)."""
    chain = problem.chain(x)
    out: list[Measurement] = []
    for item in data:
        if isinstance(item, CameraCorners):
            frames = chain.forward_kinematics(item.conditions())
            derivative = item.displacement_derivative(frames, problem.instrument_values_of(item, x))
            root = np.linalg.cholesky(covariance(chain, frames))
            item = item.with_scaled_sigma({"pixels": noise}).with_jitter(derivative @ root, largest)
        out.append(item)
    return tuple(out)
