"""Bias of least-squares estimates from contacts, whose joint values contain the noise.

A measured position has its noise in the measured value, and the joint values q are known. A contact has no
measured value: the arm stops where the tool misses the object by the noise e, so that q depends on e. The
logarithm of the likelihood of the observed q then contains the volume of the misses per unit of q,

    L(x) = -½·Σ |e_i(q_i, x)|² + V(x),    V(x) = ½·Σ log det(A_i·A_iᵀ + I),

with the whitened misses e_i and their derivatives A_i = ∂e_i/∂q_i. The unit matrix limits V near singular
configurations, where the noise turns joints by large angles. Least squares leaves V out. To first order, its
estimate differs from that of greatest likelihood by

    b = -C·∂V/∂x,    C the covariance of the estimate.

The size of the robot is part of this bias: all misses of a smaller robot are smaller. Where misses are
divided by the size s (`scale_gauge`), V has -k·log s for each sample with k misses. What remains is small
beside the standard deviations if the contacts determine the errors of the arm well, and can be some times as
large if they do not.

Reference: W. A. Fuller, Measurement Error Models, Wiley 1987 (estimates from inputs with noise).

Shapes: p unknowns, m samples, k misses per sample, n joints.
"""

from __future__ import annotations

import numpy as np

from ..._kernels import apply_observation_matrix
from ..._typing import Array
from ...measurements.base import Measurement
from ..problem import Problem

# Largest number of samples of a measurement that the volume is computed from.
_MAX_SAMPLES = 300
# Step of the derivative of the volume [m, rad or unit of the parameter].
_STEP = 1e-4


def contact_bias(problem: Problem, x: Array, root: Array) -> Array:
    """Estimate the bias (p,) of a solution x (p,) from a square root (p, r) of its covariance."""
    contacts = [item for item in problem.data if item.is_contact and len(item.rows)]
    slopes = np.zeros(len(x))
    if not contacts:
        return slopes
    drawn = [item.take(np.s_[:: -(-len(item.rows) // _MAX_SAMPLES)]) for item in contacts]
    shares = [len(item.rows) / len(part.rows) for item, part in zip(contacts, drawn, strict=True)]
    n_robot, names = len(problem.errors.parameters), [parameter.name for parameter in problem.parameters]
    for i, step in enumerate(_STEP * np.eye(len(x))):
        for share, part in zip(shares, drawn, strict=True):
            # A touched object only concerns the contacts with it.
            if i < n_robot or names[i] in {parameter.name for parameter in part.instrument_parameters}:
                up, down = (log_volume(problem, x + side, part) for side in (step, -step))
                slopes[i] += share * (up - down) / (2 * _STEP)
    return -root @ (root.T @ slopes)


def log_volume(problem: Problem, x: Array, item: Measurement) -> float:
    """Compute the logarithm of the volume of the whitened misses per unit of the joint values."""
    chain, u = problem.chain(x), problem.instrument_values_of(item, x)
    frames = chain.forward_kinematics(item.conditions())
    observation = item.observation_matrix(frames, u, item.residual(frames, u))
    m = len(item.rows)
    by_joint = np.empty((chain.n_joints, item.residual_dim, m))
    apply_observation_matrix(chain.joint_jacobian(frames, observation.body), observation, by_joint)
    a = by_joint.transpose(2, 1, 0)
    log_det = np.linalg.slogdet(a @ a.transpose(0, 2, 1) + np.eye(item.residual_dim))[1]
    volume = 0.5 * float(np.sum(log_det))
    if problem.scale_gauge and not item.has_length_scale:
        volume -= item.residual_dim * m * float(np.log(problem.scale_gauge.size(chain)))
    return volume
