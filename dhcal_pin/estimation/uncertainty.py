"""How well a calibrated arm is known, apart from the fit that told: predictions anywhere, also of a file.

Whatever was identified, all that an error does to the tool is to move the bodies of the path, or to change a
coefficient of the transmission. So the errors' covariance is kept as one of such motions, which needs neither
the parameter set nor the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .. import se3
from .._kernels.types import FrameBatch
from .._typing import Array
from ..robot.chain import Chain, link_frame, twists_in_bodies
from .error_model import ErrorModel
from .qr import RANK_RTOL

# A parameter, or a metre and a radian of the tool, with more than this share of itself unseen is unknown.
UNBOUNDED_TOL = 1e-6


# Configurations at which the motions of two sets of errors are compared.
N_MATCHING_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class Prediction:
    """Tool poses of a calibrated arm, and how well they are known.

    Attributes:
        poses: (m, 4, 4) in the measuring frame.
        covariance: (m, 6, 6) of the tool point's displacement [v, ω], m and rad, in axes of the
            measuring frame; infinite on the diagonal where neither data nor a prior tell.
    """

    poses: Array
    covariance: Array

    @property
    def position_std(self) -> Array:
        """Root of the position's total variance (m,), m: the RMS distance to expect."""
        return np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))

    @property
    def orientation_std(self) -> Array:
        """Root of the rotation vector's total variance (m,), rad: the RMS angle to expect."""
        return np.sqrt(np.trace(self.covariance[:, 3:, 3:], axis1=1, axis2=2))


class Predictor(Protocol):
    """What knows a calibrated arm and how well it is known: a `Result`, or what a file has kept of it."""

    @property
    def chain(self) -> Chain:
        """The calibrated arm."""
        ...

    def predict(self, q: Array) -> Prediction:
        """Its tool poses at joint values q (m, n), rad or m, and how well they are known."""
        ...


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """A calibrated arm and the covariance of its errors.

    Attributes:
        chain: calibrated.
        entries: (e,) of the transmission's flat coefficients that are uncertain.
        sqrt_covariance: (6(k+1)+e, r) root of the covariance: of twists [v, ω] of the bodies' frames, the base link's
            in the measuring frame and the others' in their own link's, then of the entries.
        unbounded_directions: (6(k+1)+e, h) of the directions that neither data nor a prior tell.
    """

    chain: Chain
    entries: Array
    sqrt_covariance: Array
    unbounded_directions: Array

    @classmethod
    def from_errors(
        cls, errors: ErrorModel, x: Array, chain: Chain, sqrt_covariance: Array, unbounded_directions: Array
    ) -> Uncertainty:
        """The uncertainty of identified errors.

        Args:
            errors: the unknowns.
            x: (p,) their values.
            chain: the calibrated arm.
            sqrt_covariance: (p, r) of the unknowns' covariance.
            unbounded_directions: (p, h) of the directions of them that nothing tells.
        """
        _, bodies, twists = errors.derivative(x)
        count = len(chain.moving_joints) + 1
        entries = bodies[bodies >= count] - count
        plain = len(bodies) - len(entries)
        # From the bodies' frames, whose z are the joints' axes, to the links' own and the measuring frame.
        into = se3.adjoint(np.concatenate([chain.base[None], chain.axis_frames[1:]]))
        motions = np.zeros((count, 6, len(bodies)))
        motions[bodies[:plain], :, np.arange(plain)] = np.einsum(
            "pij,pj->pi", into[bodies[:plain]], twists[:plain]
        )
        rows = np.concatenate([motions.reshape(6 * count, -1), np.eye(len(bodies))[plain:]])
        return cls(chain, entries, rows @ sqrt_covariance, rows @ unbounded_directions)

    def of_parameters(self, errors: ErrorModel, scale: Array) -> tuple[Array, Array]:
        """Root (p, r) of the covariance of this arm's p further errors, and what of them is hidden (p, h).

        They are told by what they do to the tool; what several of them do alike is shared out by their scale,
        and what none of them does goes to those that come nearest.

        Args:
            errors: unknowns of the calibrated arm.
            scale: (p,) units to count them in, such as their priors' sigmas.
        """
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (N_MATCHING_SAMPLES, self.chain.n_joints))
        chain, bodies, twists = errors.derivative(np.zeros(len(scale)))
        moved = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists) * scale[:, None, None]
        inverse = np.linalg.pinv(moved.reshape(len(scale), -1).T, rcond=RANK_RTOL)
        carried = self._tool_jacobian(self.chain.forward_kinematics(q)).reshape(len(self.sqrt_covariance), -1)
        told = inverse @ carried.T
        return told @ self.sqrt_covariance, told @ self.unbounded_directions

    def _tool_jacobian(self, frames: FrameBatch) -> Array:
        """Of the tool (6(k+1)+e, 6, m) by each of the motions and entries, as `Chain.tool_velocities`."""
        chain, count = self.chain, len(self.chain.moving_joints) + 1
        carry = np.tile(np.eye(4), (count, 1, 1))
        carry[0] = se3.inverse(chain.base)
        stations = np.repeat([link_frame(j) for j in range(count)], 6)
        bodies, twists = twists_in_bodies(chain, stations, np.tile(np.eye(6), (count, 1)), carry.repeat(6, 0))
        return chain.tool_jacobian(
            frames,
            np.concatenate([bodies, count + self.entries]),
            np.pad(twists, ((0, len(self.entries)), (0, 0))),
        )

    def predict(self, q: Array) -> Prediction:
        """The calibrated tool poses at joint values q (m, n), rad or m, and how well they are known.

        The covariance is that of the identified errors carried to the tool to first order; noise of a
        future measurement is not in it.
        """
        frames = self.chain.forward_kinematics(q)
        velocities = self._tool_jacobian(frames)
        carried, lost = (
            np.einsum("pim,pr->mir", velocities, part)
            for part in (self.sqrt_covariance, self.unbounded_directions)
        )
        covariance = carried @ np.swapaxes(carried, 1, 2)
        rows, axes = np.nonzero(np.sum(lost**2, -1) > UNBOUNDED_TOL)
        covariance[rows, axes, axes] = np.inf
        return Prediction(frames.poses(), covariance)
