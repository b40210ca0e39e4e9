"""Base and tool poses that the measurements leave free, and predictions that do not depend on them.

Images of a board by one camera do not show where the robot stands: if robot and camera move together, no
image changes. The pose of the camera, or of a board that stands still, takes the place of that of the base,
and one on the tip that of the tool. Only priors limit such directions, and a prediction of the tool in the
frame of the base would state the priors, not what was measured.

With the null space N of the measurements, the undetermined errors displace the tool at joint positions q by
J(q)·N. Those that are nothing but another pose of base or tool are the gauge directions G:

    J(q)·G·c = twist of the base + twist of the tool, constant in the frames of base and tool, for all q

A square root S of the covariance is replaced by the S-transformation of Baarda (1973),

    S' = S - G·(AᵀA)⁻¹·AᵀB,    A, B: displacements by G and by S at the measured configurations,

the covariance of errors relative to the base and tool poses that fit the measured configurations best. It
does not depend on the priors of the gauge directions, as G' = 0. Angles count as lengths at the RMS distance
of the measured tool points from their mean.

Reference: W. Baarda, S-transformations and criterion matrices, Netherlands Geodetic Commission, 1973.

Shapes: m configurations, d undetermined directions, g gauge directions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from .uncertainty import UNBOUNDED_TOL, Uncertainty

# Configurations at which the effects of undetermined directions are compared with those of base and tool.
N_COMPARED = 60
# Smaller effects than this fraction of the largest one are none.
NO_EFFECT_RTOL = 1e-5
# Largest sine of the angle between an effect and those of base and tool poses that is the same effect.
SAME_EFFECT_TOL = 1e-3
# Unit of the poses of base and tool beside errors of the arm [m and rad], about the size of the latter.
FRAME_UNIT = 1e-3
# Largest number of measured configurations that base and tool are fitted to.
MAX_FITTED = 500
# Smallest distance at which angles count as lengths [m].
MIN_LEVER = 0.1


def separate_frames(uncertainty: Uncertainty, undetermined: Array, q: Array) -> Uncertainty:
    """Separate what base and tool poses, which the measurements leave free, contribute to the uncertainty."""
    columns = np.concatenate([uncertainty.sqrt_covariance, uncertainty.unbounded_directions], 1)
    if not (undetermined.size and len(q) and np.isfinite(columns).all()):
        return uncertainty
    q = q[:: -(-len(q) // MAX_FITTED)]
    lever = max(se3.rms_radius(uncertainty.chain.poses(q)[:, :3, 3]), MIN_LEVER)
    gauge = _gauge_directions(uncertainty, undetermined, lever)
    if not gauge.shape[1]:
        return uncertainty
    effects, all_effects = (_effects(uncertainty, part, q, lever) for part in (gauge, columns))
    return replace(uncertainty, frame_part=gauge @ np.linalg.lstsq(effects, all_effects, rcond=None)[0])


def best_frames_std(uncertainty: Uncertainty, q: Array) -> float:
    """Predict the RMS position error at q with the base and the tool that fit best [m]; NaN without any q."""
    if not len(q):
        return np.nan
    chain, count = uncertainty.chain, uncertainty.sqrt_covariance.shape[1]
    columns = np.concatenate([uncertainty.sqrt_covariance, uncertainty.unbounded_directions], 1)
    twists = uncertainty.tool_twists(chain.forward_kinematics(q), columns)
    displacements = twists[:, :3].reshape(3 * len(q), -1)
    frames = position_frame_effects(chain, q).reshape(3 * len(q), 9)
    displacements -= frames @ np.linalg.lstsq(frames, displacements, rcond=NO_EFFECT_RTOL)[0]
    mean_squares = np.sum(displacements**2, 0) / len(q)
    is_unbounded = bool(np.any(mean_squares[count:] > UNBOUNDED_TOL))
    return np.inf if is_unbounded else float(np.sqrt(np.sum(mean_squares[:count])))


def tool_gauge_covariance(priors: Uncertainty) -> Array:
    """Compute the covariance (6, 6) of the tool pose that errors of the arm can imitate everywhere."""
    # The columns of `priors` are the errors of the arm, each by one standard deviation. Images do not show
    # the pose: a camera or a board on the tool that moves against the tool has the same effect.
    chain, n_errors = priors.chain, priors.sqrt_covariance.shape[1]
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (N_COMPARED + n_errors, chain.n_joints))
    lever = max(se3.rms_radius(chain.poses(q)[:, :3, 3]), MIN_LEVER)
    by_error = _effects(priors, priors.sqrt_covariance, q, lever)
    effects = np.concatenate([by_error, FRAME_UNIT * frame_effects(chain, q, lever)], 1)
    _, s, combinations = np.linalg.svd(effects, full_matrices=False)
    without_effect = combinations[s <= NO_EFFECT_RTOL * s[0]].T
    errors, tool = without_effect[:n_errors], FRAME_UNIT * without_effect[-6:]
    return tool @ np.linalg.pinv(errors.T @ errors, NO_EFFECT_RTOL, hermitian=True) @ tool.T


def _gauge_directions(uncertainty: Uncertainty, undetermined: Array, lever: float) -> Array:
    """Return the undetermined directions that are only another pose of base or tool, (6(k+1)+e, g)."""
    chain = uncertainty.chain
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (N_COMPARED, chain.n_joints))
    effects = _effects(uncertainty, undetermined, q, lever)
    smallest = float(np.linalg.norm(undetermined, 2)) * lever
    return undetermined @ frame_combinations(effects, frame_effects(chain, q, lever), smallest)


def frame_combinations(effects: Array, frames: Array, smallest: float) -> Array:
    """Return orthonormal combinations (d, g) of effects (k, d) that are effects of base and tool (k, c)."""
    left, s, right = np.linalg.svd(effects, full_matrices=False)
    has_effect = s > NO_EFFECT_RTOL * max(s[0], smallest)
    frames, frame_s, _ = np.linalg.svd(frames, full_matrices=False)
    frames = frames[:, frame_s > NO_EFFECT_RTOL * frame_s[0]]
    # Principal angles between both spaces of effects.
    outside = left[:, has_effect] - frames @ (frames.T @ left[:, has_effect])
    _, sines, combinations = np.linalg.svd(outside, full_matrices=False)
    return (right[has_effect].T / s[has_effect]) @ combinations[sines < SAME_EFFECT_TOL].T


def _effects(uncertainty: Uncertainty, directions: Array, q: Array, lever: float) -> Array:
    """Return the displacements of the tool by directions (6(k+1)+e, c) at q, (6m, c) [m]."""
    twists = uncertainty.tool_twists(uncertainty.chain.forward_kinematics(q), directions)
    twists[:, 3:] *= lever
    return twists.reshape(-1, directions.shape[1])


def frame_effects(chain: Chain, q: Array | Conditions, lever: float) -> Array:
    """Return the displacements of the tool by twists of base and tool at q, (6m, 12) [m]."""
    poses = chain.poses(q)
    out = np.zeros((len(poses), 6, 12))
    out[:, :3, :3] = out[:, 3:, 3:6] = np.eye(3)
    # v = ω × p
    out[:, :3, 3:6] = -se3.skew(poses[:, :3, 3])
    out[:, :3, 6:9] = out[:, 3:, 9:] = poses[:, :3, :3]
    out[:, 3:] *= lever
    return out.reshape(-1, 12)


def position_frame_effects(chain: Chain, q: Array) -> Array:
    """Return the displacements of the tool point by twists of the base and motions of the tool, (m, 3, 9)."""
    return frame_effects(chain, q, 1.0).reshape(len(q), 6, 12)[:, :3, :9]
