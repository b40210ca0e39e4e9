"""Size of a correction: how far it moves the joint axes and the tool, compared with manufacturing errors.

Single parameters do not show the size of a correction. The DH parameters of nearly parallel axes can change
by metres without an effect, since a translation along an axis changes nothing. The correction is therefore
judged by what it moves, at configurations over the joint range: the distance of each nominal joint origin
from the calibrated axis, the angle between nominal and calibrated axis, and the distance of the tool. Both
robots stand on the same base and carry the calibrated tool, so that only errors of the robot count.

The same displacements of robots with random errors, drawn from the default priors, are the expected ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from .._frozen import frozen
from .._kernels.types import FrameBatch
from .._typing import Array
from ..estimation.error_model import ErrorModel
from ..robot.chain import Chain
from ..robot.sampling import joint_range, random_configurations

# Number of configurations over the joint range, and of robots with random errors.
_N_CONFIGURATIONS, _N_ROBOTS = 32, 24
# Smallest expected displacement, relative to the largest of all frames: base and tool follow the errors of
# the whole robot, and so do the axes near them.
_MIN_RELATIVE = 0.5


@frozen
class CorrectionSize:
    """Largest displacement by a correction."""

    frame: str  #: "tool", or the name of a joint whose axis moves.
    displacement: float  #: RMS over the configurations [m], or [rad] if `is_angle`.
    expected: float  #: The same for robots with errors drawn from the default priors.
    is_angle: bool  #: Whether the direction of the axis changes most, rather than its place.

    @property
    def ratio(self) -> float:
        """Displacement relative to the expected one."""
        return self.displacement / self.expected if self.expected else 0.0


def measure_correction(errors: ErrorModel, calibrated: Chain) -> CorrectionSize:
    """Measure the displacement of joint axes and tool by a correction."""
    rng = np.random.default_rng(0)
    nominal = errors.chain.with_base_and_tool(np.eye(4), calibrated.tool)
    q = rng.uniform(*joint_range(nominal), (_N_CONFIGURATIONS, nominal.n_joints))
    state = nominal.joint_state(q)
    frames = nominal.forward_kinematics(state)

    def displacements(chain: Chain) -> Array:
        return _displacements(frames, chain.forward_kinematics(state), nominal.prismatic)

    moved = displacements(calibrated.with_base_and_tool(nominal.base, nominal.tool))
    std = np.where(errors.is_of_arm, errors.priors, 0.0)
    model = replace(errors, chain=nominal)
    draws = [displacements(model.at(std * rng.standard_normal(len(std)))) for _ in range(_N_ROBOTS)]
    expected = np.sqrt(np.mean(np.square(draws), 0))
    expected = np.fmax(expected, _MIN_RELATIVE * expected.max(1, keepdims=True))
    ratio = np.divide(moved, expected, out=np.zeros_like(moved), where=expected > 0)
    kind, frame = np.unravel_index(np.argmax(ratio), moved.shape)
    names = (*nominal.moving_joints, "tool")
    return CorrectionSize(
        names[frame], float(moved[kind, frame]), float(expected[kind, frame]), bool(kind == 1)
    )


def _displacements(frames_a: FrameBatch, frames_b: FrameBatch, prismatic: Array) -> Array:
    """Return RMS distance [m] and angle [rad] between each axis, then the tool, of two robots, (2, k+1)."""
    # Directions and points of the axes, (k, 3, m).
    (axis_a, point_a), (axis_b, point_b) = (
        (frames.bodies[1:, 2], frames.bodies[1:, 3]) for frames in (frames_a, frames_b)
    )
    cosine = np.clip(np.sum(axis_a * axis_b, 1), -1, 1)
    offset = point_a - point_b
    distance = np.linalg.norm(offset - axis_b * np.sum(offset * axis_b, 1, keepdims=True), axis=1)
    # The place of a prismatic axis has no effect; only its direction has.
    distance[np.asarray(prismatic)] = 0.0
    tool = np.linalg.norm(frames_a.tool[3] - frames_b.tool[3], axis=0)
    squares = [
        np.concatenate([distance**2, tool[None] ** 2]),
        np.concatenate([np.arccos(cosine) ** 2, np.zeros_like(tool)[None]]),
    ]
    return np.sqrt(np.mean(squares, 2))


def workspace_radius(chain: Chain) -> float:
    """Compute the RMS distance of the tool from its mean position over the joint range."""
    return se3.rms_radius(chain.poses(random_configurations(chain, _N_CONFIGURATIONS))[:, :3, 3])
