"""Poses that images show one by one, with the covariance of each.

An image shows the direction to a board far better than its distance, and the errors of position and rotation
depend on each other. With the covariance Σ of the errors e of a pose, position and rotation vector, and
Σ⁻¹ = Rᵀ·R, the residuals are R·e.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ... import se3
from ..._kernels import log_rotations, right_jacobian_inverse_batch
from ..._kernels.types import FrameBatch, ObservationMatrix
from ..._typing import Array
from ..base import ANGLE_SIGMA, LENGTH_SIGMA
from ..pose import Pose

_TERMS = np.repeat(np.arange(6), 6), np.tile(np.arange(6), 6)
# Standard deviations of the error of an arm along and about each axis [m], [rad].
ARM_STD = 5e-4, 5e-4


def pose_covariances(poses: Array, information: Array) -> Array:
    """Return the covariances (m, 6, 6) of position and rotation vector, errors of the arm included."""
    # The twists [v, ω] are about the origin of the measuring frame.
    by_twist = np.tile(np.eye(6), (len(poses), 1, 1))
    by_twist[:, :3, 3:] = -se3.skew(poses[:, :3, 3])
    covariances = by_twist @ np.linalg.pinv(information, hermitian=True) @ by_twist.swapaxes(1, 2)
    return covariances + np.diag(np.repeat(ARM_STD, 3) ** 2)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class ImagePose(Pose):
    """Poses with covariances."""

    roots: Array  # Upper triangular factors R, (m, 6, 6) [1/m and 1/rad]

    sample_fields = (*Pose.sample_fields, "roots")

    @classmethod
    def of(cls, q: Array, poses: Array, information: Array) -> Self:
        """Return poses (m, 4, 4) [m] with the information (m, 6, 6) of images about twists of them."""
        covariances = pose_covariances(poses, information)
        roots = np.linalg.cholesky(np.linalg.inv(covariances)).swapaxes(1, 2)
        new = object.__new__(cls)
        new.__dict__.update(vars(Pose(q, poses)) | {"roots": roots})
        return new

    def _scaled_roots(self) -> Array:
        """Return the factors with the scales of the noise of position and rotation, (6, 6, m)."""
        scales = self._weights * np.repeat([LENGTH_SIGMA, ANGLE_SIGMA], 3)[:, None]
        return scales[:, None] * self.roots.transpose(1, 2, 0)

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (6, m)."""
        rotation = log_rotations(self._rotation_error(frames))
        errors = np.concatenate([self._position_error(frames), rotation])
        return np.einsum("ijm,jm->im", self._scaled_roots(), errors)

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the derivatives of all residuals by all velocities of the tool."""
        by_rotation = right_jacobian_inverse_batch(log_rotations(self._rotation_error(frames)))
        roots = self._scaled_roots()
        values = np.concatenate([roots[:, :3], np.einsum("ijm,jkm->ikm", roots[:, 3:], by_rotation)], 1)
        return ObservationMatrix(*_TERMS, values.reshape(36, -1))
