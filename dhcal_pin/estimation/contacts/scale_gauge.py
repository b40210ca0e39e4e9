"""Undetermined scale and orientation (gauge freedom) of measurements without a length.

Contact measurements state that the tool touches the same unknown point, plane or sphere several times. Their
residuals e (misses [m]) determine neither the size of the robot nor its orientation in the measuring frame:
these are gauge freedoms (Triggs et al. 2000, section 9). Plain least squares would nevertheless use them,
because all misses shrink with the size s of the modelled robot: the estimate would be too small by some
tenths of a percent, or would collapse where the standard deviations are estimated, too.

The residuals are therefore made invariant: they are divided by the size, and counted along axes that rotate
with the robot,

    e' = Rᵀ·e / s

with the size s and the mean rotation R relative to the nominal robot. For an error x_i that makes the robot
grow at the rate a_i and rotate at the rate w_i, the derivative of the whitened model is, at R = 1,

    J'_i = (J_i + (a_i/s)·e + w_i × e) / s.

The rows are [J | e] with J = -∂e/∂x.

Size and orientation then have no effect on the cost, and remain to other measurements or to the priors.

- Size: RMS distance of the tool from its mean position over c configurations, s = ρ/ρ_nominal.
- Growth: a = Σ v·d / (c·ρ·ρ_nominal), with the tool velocity v per unit of the error and the distance d from
  the mean position.
- Rotation: w = K⁺·Σ d×v, the mean angular velocity, with the inertia K = Σ (|d|²·1 - d·dᵀ).

References:
    B. Triggs, P. McLauchlan, R. Hartley and A. Fitzgibbon, Bundle Adjustment - A Modern Synthesis, 2000.
"""

from __future__ import annotations

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array
from ...robot.chain import Chain
from ...robot.conditions import SampleState

# Number of configurations at which size and rotation are evaluated.
_N_SAMPLES = 100
# Smallest moment of inertia relative to the largest one.
_MIN_INERTIA = 1e-15
# The tool does not move if its distances from the mean are this part of those from the base, or less.
_MIN_RADIUS = 1e-12


@frozen(eq=False)
class ScaleGauge:
    """Size of a robot and its rates of growth and rotation."""

    state: SampleState  # Joint state at c configurations
    nominal: float  # RMS distance of the nominal tool from its mean position [m]; 0 if it does not move

    @classmethod
    def from_configurations(cls, chain: Chain, q: Array) -> ScaleGauge:
        """Choose configurations by drawing each joint from the measured ones."""
        rng = np.random.default_rng(0)
        state = chain.joint_state(np.stack([rng.choice(column, _N_SAMPLES) for column in q.T], 1))
        tool = chain.forward_kinematics(state).tool[3]
        radius = _rms_radius(_centered(tool))
        return cls(state, radius if radius > _MIN_RADIUS * _rms_radius(tool) else 0.0)

    def size(self, chain: Chain) -> float:
        """Compute the size of a chain."""
        if not self.nominal:
            return 1.0
        return _rms_radius(_centered(chain.forward_kinematics(self.state).tool[3])) / self.nominal

    def size_and_rates(self, chain: Chain, bodies: Array, twists: Array) -> tuple[float, Array]:
        """Compute the size, and growth and angular velocity in the measuring frame per unit error, (e, 4)."""
        rates = np.zeros((len(bodies), 4))
        if not self.nominal:
            return 1.0, rates
        frames = chain.forward_kinematics(self.state)
        offsets = _centered(frames.tool[3])
        radius, velocities = _rms_radius(offsets), chain.tool_jacobian(frames, bodies, twists)[:, :3]
        rates[:, 0] = np.tensordot(velocities, offsets) / (_N_SAMPLES * radius * self.nominal)
        inertia = np.vdot(offsets, offsets) * np.eye(3) - offsets @ offsets.T
        product = offsets @ velocities.swapaxes(1, 2)
        turned = (product - product.swapaxes(1, 2))[:, [1, 2, 0], [2, 0, 1]]
        values, axes = np.linalg.eigh(inertia)
        # Points on a line do not show the rotation about it.
        is_shown = values > _MIN_INERTIA * values[-1]
        rates[:, 1:] = (turned @ axes[:, is_shown] / values[is_shown]) @ axes[:, is_shown].T
        return radius / self.nominal, rates


def _centered(points: Array) -> Array:
    """Return the offsets of points (3, c) from their mean."""
    return points - points.mean(1, keepdims=True)


def _rms_radius(offsets: Array) -> float:
    """Return the RMS length of offsets (3, c)."""
    return float(np.sqrt(np.vdot(offsets, offsets) / _N_SAMPLES))


def normalize_by_scale(block: Array, size: float, rates: Array, are_vectors: bool) -> None:
    """Make whitened rows of lengths invariant to the size and the orientation of the robot."""
    block /= size
    residual = block[-1]
    block[: len(rates)] += (rates[:, 0] / size)[:, None, None] * residual
    if are_vectors:
        block[: len(rates)] += se3.skew(rates[:, 1:]) @ residual
