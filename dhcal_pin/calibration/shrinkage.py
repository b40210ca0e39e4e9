"""Shrinkage: how much of a correction to apply when there are few measurements.

With fewer equations than parameters many robots fit the measurements equally well. The solution x̂ is the
most likely one under the priors, but the widths of the priors are only roughly known, and the correction
may leave the robot worse than nominal. As in James-Stein estimation and in shrinkage of regression
predictors (Copas), the correction c·x̂ with a factor 0 <= c <= 1 is then safer than x̂. Here c is the
largest factor whose probability of harm is at most 0.2 %.

Harm. At N configurations over the joint range, x̂ moves the tool by d = J·x̂ and the true errors x move it by
e = J·x, with base and tool following as the measurements require. The correction c·d leaves a larger error
than no correction, |e - c·d|² > |e|², if and only if

    c·|d|² > 2·a,    a = dᵀ·e.

Distribution of a. The whitened measurements, after elimination of base, tool and instrument parameters, are
y = A·x + ε with ε ~ N(0, I). Group g of the errors has the prior x_g ~ N(0, w_g²·P_g) with an unknown width
w_g. For given widths w everything is normal:

    S(w)    = I + Σ_g w_g²·A_g·P_g·A_gᵀ              covariance of y
    k(w)    =     Σ_g w_g²·A_g·P_g·J_gᵀ·d            covariance of y and a
    log p(y|w) = -½·log|S| - ½·yᵀ·S⁻¹·y + const      evidence (MacKay 1992)
    E[a|y,w]   = kᵀ·S⁻¹·y
    Var[a|y,w] = Σ_g w_g²·dᵀ·J_g·P_g·J_gᵀ·d - kᵀ·S⁻¹·k

Average over the widths. ln w_g ~ N(0, 1.5²) on a grid of powers of 2 from 1/16 to 16 gives the posterior
p(w|y) ∝ p(y|w)·p(w) and

    P(harm | c) = Σ_w p(w|y)·Φ((½·c·|d|² - E[a|y,w]) / sqrt(Var[a|y,w])).

Shapes: p unknowns, i errors of the robot's links and joints, o other unknowns, r whitened rows, f groups,
w combinations of widths.

References:
    W. James and C. Stein, Estimation with Quadratic Loss, Proc. 4th Berkeley Symposium, 1961.
    J. B. Copas, Regression, Prediction and Shrinkage, J. Royal Statistical Society B 45, 1983.
    D. J. C. MacKay, Bayesian Interpolation, Neural Computation 4, 1992.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from .._typing import Array
from ..estimation.priors import PriorGroups
from ..estimation.problem import Problem
from ..estimation.qr import RANK_RTOL, TriangularSystem, singular_value_decomposition
from ..estimation.solver import SolverResult

# Largest accepted probability that the calibrated robot is worse than the nominal one.
MAX_HARM_PROBABILITY = 0.002
# Widths of the priors as multiples of the default ones.
PRIOR_WIDTHS = 2.0 ** np.arange(-4, 5)
# Standard deviation of the logarithm of the widths.
LOG_WIDTH_STD = 1.5
# Number of configurations at which the tool is compared.
N_CONFIGURATIONS = 32
# Smallest noise, relative to the largest effect that an error of the widest prior has on a measurement.
NOISE_FLOOR = 1e-6
# Steps in which the factor is searched.
N_FACTORS = 101


def compute_shrinkage_factor(problem: Problem, solution: SolverResult, groups: PriorGroups) -> float:
    """Compute the largest factor of a solution that is hardly worse than the nominal robot."""
    errors, x = problem.errors, solution.x
    n_rows = sum(len(item.rows) * item.residual_dim for item in problem.data)
    if n_rows > len(x) or n_rows > solution.system.rank or not groups:
        return 1.0
    robot = np.flatnonzero(errors.is_of_arm)
    if not x[robot].any():
        return 1.0
    others = np.setdiff1d(np.arange(len(x)), robot)
    dependence, rows, measured = _eliminate(solution.system, x, robot, others)
    displacement = _displacements(problem, x, robot, dependence)
    change = displacement @ x[robot]
    # Stated priors and those of joint errors keep their widths; they form the last group, of width 1.
    std, members_of = 1 / problem.weights[robot], []
    for group in groups:
        if errors.parameters[group.members[0]].coefficient_index is None:
            members_of.append(np.isin(robot, group.members))
            std[members_of[-1]] = 1 / group.expected_weight
    widths = np.array([[*row, 1.0] for row in itertools.product(PRIOR_WIDTHS, repeat=len(members_of))])
    members_of.append(~np.any([np.zeros(len(robot), bool), *members_of], 0))
    rows, effect = rows * std, displacement.T @ change * std
    noise = max(1.0, NOISE_FLOOR * float(np.abs(rows).max()) * PRIOR_WIDTHS.max())
    rows, measured = rows / noise, measured / noise
    parts = [(rows[:, group], effect[group]) for group in members_of]
    log_evidence, mean, effect_std = _evidence(parts, measured, widths)
    log_posterior = log_evidence - 0.5 * np.sum((np.log(widths) / LOG_WIDTH_STD) ** 2, 1)
    posterior = np.exp(log_posterior - log_posterior.max())
    return _largest_safe_factor(mean, effect_std, posterior / posterior.sum(), float(change @ change))


def _eliminate(system: TriangularSystem, x: Array, robot: Array, others: Array) -> tuple[Array, Array, Array]:
    """Eliminate the other unknowns from the rows of the system."""
    measured = system.z + system.r @ x
    u, s, vt = singular_value_decomposition(system.r[:, others])
    k = int(np.sum(s > RANK_RTOL * s.max(initial=0.0)))
    u, s, vt, rows = u[:, :k], s[:k], vt[:k], system.r[:, robot]
    return -vt.T @ ((u.T @ rows) / s[:, None]), rows - u @ (u.T @ rows), measured - u @ (u.T @ measured)


def _displacements(problem: Problem, x: Array, robot: Array, dependence: Array) -> Array:
    """Compute the tool displacement per robot error, (3·N, i), at N configurations over the joint range."""
    from ..robot.sampling import random_configurations  # lazy import: slow, and few calibrations need it

    errors, n_parameters = problem.errors, len(problem.errors.parameters)
    chain, bodies, twists = errors.derivative(x[:n_parameters])
    q = random_configurations(chain, N_CONFIGURATIONS)
    jacobian = np.zeros((3 * N_CONFIGURATIONS, len(x)))
    jacobian[:, :n_parameters] = (
        chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)[:, :3].reshape(n_parameters, -1).T
    )
    return jacobian[:, robot] + np.delete(jacobian, robot, 1) @ dependence


def _evidence(
    parts: Sequence[tuple[Array, Array]], measured: Array, widths: Array
) -> tuple[Array, Array, Array]:
    """Compute log evidence, mean and standard deviation of a, (w,) each, for widths (w, f) of groups."""
    # Covariance of y, of y and a, and variance of a by each group at width 1.
    covariances = np.stack([rows @ rows.T for rows, _ in parts])
    cross_covariances = np.stack([rows @ effect for rows, effect in parts])
    effect_variances = np.array([np.sum(effect**2) for _, effect in parts])
    squares = widths**2
    covariance = np.tensordot(squares, covariances, 1) + np.eye(len(measured))
    root = np.linalg.cholesky(covariance)
    repeated = np.broadcast_to(measured, (len(widths), len(measured)))
    right = np.stack([repeated, squares @ cross_covariances], 2)
    y, cross = np.moveaxis(np.linalg.solve(root, right), 2, 0)
    log_evidence = -np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1) - 0.5 * np.sum(y**2, 1)
    variance = squares @ effect_variances - np.sum(cross**2, 1)
    std = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    return log_evidence, np.sum(y * cross, 1), std


def _largest_safe_factor(mean: Array, std: Array, posterior: Array, squared_change: float) -> float:
    """Find the largest factor whose probability of harm is accepted; 0 if there is none."""
    from scipy.special import ndtr  # lazy import: slow, and few calibrations need it

    factors = np.linspace(1, 0, N_FACTORS)
    probability = ndtr((0.5 * factors[:, None] * squared_change - mean) / std) @ posterior
    safe = np.flatnonzero(probability <= MAX_HARM_PROBABILITY)
    return float(factors[safe[0]]) if safe.size else 0.0
