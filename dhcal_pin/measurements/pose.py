"""Poses of the tool, absolute or relative to another configuration.

Both kinds measure a rigid motion and have six residuals per sample: three of the position or translation, and
three of a rotation vector. Rotation errors use the logarithm of SO(3) and its exact derivative:

    log(E·exp(-ω)) = φ - Jr⁻¹(φ)·ω + O(ω²),     φ = log(E),  Jr: right Jacobian of SO(3).

With E = R_measured·R_modelᵀ, φ is in axes of the measuring frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._kernels import log_rotations, right_jacobian_inverse_batch
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from .base import ANGLE_SIGMA, LENGTH_SIGMA, Measurement, Noise
from .columns import angle_columns, displacement_range, length_columns, stack_columns, stack_sigmas
from .groups import ORIENTATION, POSITION
from .validation import validated_array, validated_joint_positions, validated_poses, validated_sigma

# Rows and velocity components of the terms of a pose: each coordinate of the position by its own velocity,
# each component of the rotation vector by all three angular velocities.
_POSE_TERMS = (
    np.array([0, 1, 2, *np.repeat([3, 4, 5], 3)]),
    np.array([0, 1, 2, *np.tile([3, 4, 5], 3)]),
)
# The same for a relative pose: the translation by v_a, ω_a and v_b, the rotation by ω_a and ω_b.
_RELATIVE_TERMS = (
    np.concatenate([np.repeat([0, 1, 2], 9), np.repeat([3, 4, 5], 6)]),
    np.concatenate([np.tile(np.arange(9), 3), np.tile([3, 4, 5, 9, 10, 11], 3)]),
)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class PoseMeasurement(Measurement):
    """Base of the kinds that measure a rigid motion."""

    poses: Array  #: Measured homogeneous matrices, (m, 4, 4)
    sigma: Array  #: Standard deviations of the position, (m, 3) [m]
    rotation_sigma: Array  #: Standard deviations of the rotation vector, (m, 3) [rad]
    #: Notation of the Euler angles or rotation vector that each rotation was read from, (m,), see
    #: `euler_angles`; empty texts for rotations that were read from neither.
    notations: Array
    angles: Array  #: These angles or components, (m, 3) [rad]; NaN if they are not known

    residual_groups: ClassVar = {"position": POSITION, "orientation": ORIENTATION}
    sample_fields = (
        *Measurement.sample_fields,
        *("poses", "sigma", "rotation_sigma", "notations", "angles"),
    )

    def __init__(
        self, q: Array, poses: ArrayLike, sigma: ArrayLike | None, rotation_sigma: ArrayLike | None
    ) -> None:
        """Check and set the common attributes."""
        kind, m, is_stated = type(self).__name__, len(q), sigma is not None
        if is_stated != (rotation_sigma is not None):
            raise InvalidArgumentError(
                f"{kind}: only one of sigma and rotation_sigma is given; expected both or neither"
            )
        self._initialize(
            q=q,
            poses=validated_poses(poses, m, kind),
            sigma=validated_sigma(sigma if is_stated else LENGTH_SIGMA, (m, 3), f"{kind}: sigma"),
            rotation_sigma=validated_sigma(
                rotation_sigma if is_stated else ANGLE_SIGMA, (m, 3), f"{kind}: rotation_sigma"
            ),
            notations=np.full(m, "", object),
            angles=np.full((m, 3), np.nan),
            has_stated_sigma=is_stated,
        )

    def with_euler_angles(self, notation: str, angles: Array) -> Self:
        """Return the same rotations with the Euler angles or rotation vectors that they were read from.

        Args:
            notation: Axes such as "zyx", with "fixed-" before axes that do not rotate, or "rpy"; "rotvec" for
                rotation vectors; empty if the rotations were read from neither.
            angles: Angles in the order of the axes, or components, (m, 3) [rad].

        Returns:
            Copy that knows the angles. Poses stay as they are.
        """
        return self.replace(notations=np.full(len(angles), notation, object), angles=angles)

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [self._sigma_text((self.sigma, 1e3, "mm"), (self.rotation_sigma, 180 / np.pi, "deg"))]

    @classmethod
    def _arguments(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        shift, turn = cls.COLUMNS[:3], cls.COLUMNS[3:]
        rotations = se3.exp3(stack_columns(values, [column.name for column in turn]))
        return {
            "poses": se3.transform(rotations, stack_columns(values, [column.name for column in shift])),
            "sigma": stack_sigmas(values, shift),
            "rotation_sigma": stack_sigmas(values, turn),
        }

    def _columns_and_sigmas(self) -> tuple[dict[str, Any], dict[str, Any]]:
        numbers = np.concatenate([self.poses[:, :3, 3], se3.log3(self.poses[:, :3, :3])], 1)
        sigmas = np.concatenate([self.sigma, self.rotation_sigma], 1)
        return (
            {column.name: numbers[:, i] for i, column in enumerate(self.COLUMNS)},
            {column.sigma_name: sigmas[:, i] for i, column in enumerate(self.COLUMNS)},
        )

    @cached_property
    def _weights(self) -> Array:
        """1 / sigma of position and rotation, (6, m), contiguous along the samples."""
        return 1 / np.ascontiguousarray(np.concatenate([self.sigma, self.rotation_sigma], 1).T)

    @cached_property
    def _measured(self) -> Array:
        """First three rows of the poses, (3, 4, m), contiguous along the samples."""
        return np.ascontiguousarray(self.poses[:, :3].transpose(1, 2, 0))

    @property
    def residual_dim(self) -> int:
        """Number of residuals per sample: three of the position, three of the rotation."""
        return 6

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return an empty array (0, 6, m): poses have no instrument parameters."""
        return np.empty((0, 6, len(self.rows)))

    def with_scaled_sigma(self, scales: Mapping[str, float]) -> Self:
        """Return a copy with multiplied standard deviations of "position" and "orientation"."""
        return self.replace(
            sigma=self.sigma * scales["position"],
            rotation_sigma=self.rotation_sigma * scales["orientation"],
        )

    def with_weights(self, weights: Array) -> Self:
        """Return a copy with standard deviations divided by the square roots of the weights (m,)."""
        factor = 1 / np.sqrt(weights)[:, None]
        return self.replace(sigma=self.sigma * factor, rotation_sigma=self.rotation_sigma * factor)


def _half_vee(rotation_error: Array) -> Array:
    """Return half the vee of E - Eᵀ, (3, m): the paper's (36), the rotation vector to second order."""
    difference = 0.5 * (rotation_error - np.swapaxes(rotation_error, 0, 1))
    return np.stack([difference[2, 1], difference[0, 2], difference[1, 0]])


class Pose(PoseMeasurement):
    """Poses of the tool in the measuring frame.

    The residuals are the position error and log(R_measured·R_modelᵀ), both in axes of the measuring frame.
    """

    kind = "pose"
    shows_changes = True
    COLUMNS = length_columns("poses", "x", "y", "z") + angle_columns("poses", "rx", "ry", "rz")

    def __init__(
        self,
        q: ArrayLike,
        poses: ArrayLike,
        sigma: ArrayLike | None = None,
        rotation_sigma: ArrayLike | None = None,
    ) -> None:
        """Check and store measured poses.

        Args:
            q: Joint positions, (m, n) [rad or m].
            poses: Measured poses as homogeneous matrices, (m, 4, 4).
            sigma: Standard deviations of the position, one number or (m, 3) [m].
            rotation_sigma: Standard deviations of the rotation vector, one number or (m, 3) [rad]. Without
                both, the standard deviations are estimated with the fit.
        """
        super().__init__(validated_joint_positions(q, "Pose"), poses, sigma, rotation_sigma)

    def positions(self) -> Array:
        """Return the measured positions (m, 3) [m]."""
        return self.poses[:, :3, 3]

    def rotations(self) -> Array:
        """Return the measured rotations (m, 3, 3)."""
        return self.poses[:, :3, :3]

    def _rotation_error(self, frames: FrameBatch) -> Array:
        """Return R_measured·R_modelᵀ, (3, 3, m)."""
        return np.einsum("ikm,kjm->ijm", self._measured[:, :3], frames.tool[:3])

    def _position_error(self, frames: FrameBatch) -> Array:
        """Return the measured minus the modelled position, (3, m)."""
        return self._measured[:, 3] - frames.tool[3]

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (6, m): x, y, z, then the rotation vector."""
        rotation = log_rotations(self._rotation_error(frames))
        return np.concatenate([self._position_error(frames), rotation]) * self._weights

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the weights of the position and weights·Jr⁻¹(φ) of the rotation vector φ."""
        weights = self._weights
        rotation = right_jacobian_inverse_batch(residual[3:] / weights[3:])
        rotation *= weights[3:, None]
        return ObservationMatrix(*_POSE_TERMS, np.concatenate([weights[:3], rotation.reshape(9, -1)]))

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """Return residuals with the paper's (36) in axes of the measuring frame, and the weights."""
        residual = np.concatenate([self._position_error(frames), _half_vee(self._rotation_error(frames))])
        return residual * self._weights, ObservationMatrix(np.arange(6), np.arange(6), self._weights)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return the errors "position" (m, 3) [m] and "orientation", rotation vectors (m, 3) [rad]."""
        return {
            "position": self.poses[:, :3, 3] - frames.tool[3].T,
            "orientation": log_rotations(self._rotation_error(frames)).T,
        }

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Pose:
        """Return poses of the chain's tool with normal noise on each axis."""
        q = conditions.q
        poses = chain.poses(conditions)
        poses[:, :3, 3] += noise.position * rng.standard_normal((len(q), 3))
        poses[:, :3, :3] = se3.exp3(noise.rotation * rng.standard_normal((len(q), 3))) @ poses[:, :3, :3]
        is_noisy = noise.position > 0 and noise.rotation > 0
        return cls(q, poses, *((noise.position, noise.rotation) if is_noisy else ()))


@dataclass(frozen=True, eq=False, init=False, repr=False)
class RelativePose(PoseMeasurement):
    """Poses T_ab of the tool in configuration b relative to the tool in configuration a.

    The residuals are the translation error in axes of frame a and -log(R_measuredᵀ·R_model) in axes of frame
    b. Relative poses do not depend on the base: its six parameters are not observable.

    Attributes:
        q_to: Joint positions of configuration b, (m, n) [rad or m]; `q` are those of configuration a.
    """

    q_to: Array

    kind = "relative"
    COLUMNS = length_columns("poses", "dx", "dy", "dz", plausible_range=displacement_range) + angle_columns(
        "poses", "drx", "dry", "drz"
    )
    sample_fields = (*PoseMeasurement.sample_fields, "q_to")
    configurations_per_row = 2

    def __init__(
        self,
        q: ArrayLike,
        q_to: ArrayLike,
        poses: ArrayLike,
        sigma: ArrayLike | None = None,
        rotation_sigma: ArrayLike | None = None,
    ) -> None:
        """Check and store measured relative poses.

        Args:
            q: Joint positions of configuration a, (m, n) [rad or m].
            q_to: Joint positions of configuration b, (m, n) [rad or m].
            poses: Measured poses T_ab as homogeneous matrices, (m, 4, 4).
            sigma: Standard deviations of the translation, one number or (m, 3) [m].
            rotation_sigma: Standard deviations of the rotation vector, one number or (m, 3) [rad]. Without
                both, the standard deviations are estimated with the fit.
        """
        q = validated_joint_positions(q, "RelativePose")
        q_to = validated_array(q_to, q.shape, "RelativePose: q_to", "row of joint positions")
        super().__init__(q, poses, sigma, rotation_sigma)
        self.__dict__.update(q_to=q_to)

    def configurations(self) -> Array:
        """Return the joint positions (2m, n): configurations a, then configurations b."""
        return np.concatenate([self.q, self.q_to])

    def resample(self, q: Array) -> Self:
        """Return the same measurement at other joint positions (2m, n), configurations a, then b."""
        first, second = np.split(q, 2)
        return self.replace(q=first, q_to=second)

    def _tool_frames(self, frames: FrameBatch) -> tuple[Array, Array]:
        """Return the columns x, y, z, p of the tool frame at a and at b, (4, 3, m) each."""
        m = len(self.rows)
        return frames.tool[..., :m], frames.tool[..., m:]

    def _errors(self, frames: FrameBatch) -> tuple[Array, Array]:
        """Return the translation error (3, m) in frame a, and E = R_modelᵀ·R_measured (3, 3, m) in b."""
        first, second = self._tool_frames(frames)
        measured = self._measured
        # R_modelᵀ = R_bᵀ·R_a
        model_transposed = np.einsum("ikm,jkm->ijm", second[:3], first[:3])
        rotation = np.einsum("ijm,jkm->ikm", model_transposed, measured[:, :3])
        return measured[:, 3] - np.einsum("ikm,km->im", first[:3], second[3] - first[3]), rotation

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened residuals (6, m): the translation, then the rotation vector."""
        translation, rotation = self._errors(frames)
        return np.concatenate([translation, log_rotations(rotation)]) * self._weights

    def _observation_matrix(self, frames: FrameBatch, rotation_derivative: Array) -> ObservationMatrix:
        """Return the terms of the translation and of the rotation vector."""
        first, second = self._tool_frames(frames)
        # The translation changes by R_aᵀ·(v_b - v_a - ω_a × d), d being p_b - p_a.
        translation = first[:3] * self._weights[:3, None]
        lever = np.cross(translation, (second[3] - first[3])[None], axis=1)
        # The rotation vector changes by D·R_bᵀ·(ω_b - ω_a), D being `rotation_derivative` (3, 3, m).
        rotation = np.einsum("ikm,kjm->ijm", rotation_derivative, second[:3]) * self._weights[3:, None]
        linear = np.concatenate([-translation, lever, translation], 1)
        angular = np.concatenate([-rotation, rotation], 1)
        coefficients = np.concatenate([linear.reshape(27, -1), angular.reshape(18, -1)])
        return ObservationMatrix(*_RELATIVE_TERMS, coefficients)

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the terms with D = Jl⁻¹(φ), the transpose of Jr⁻¹(φ), as log(exp(-ω)·E) = φ - Jl⁻¹(φ)·ω."""
        right = right_jacobian_inverse_batch(residual[3:] / self._weights[3:])
        return self._observation_matrix(frames, right.swapaxes(0, 1))

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """Return residuals with half the vee of E - Eᵀ, and the terms with D = I."""
        translation, rotation = self._errors(frames)
        residual = np.concatenate([translation, _half_vee(rotation)]) * self._weights
        identity = np.broadcast_to(np.eye(3)[..., None], rotation.shape)
        return residual, self._observation_matrix(frames, identity)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return the errors "position" (m, 3) [m] and "orientation", rotation vectors (m, 3) [rad]."""
        translation, rotation = self._errors(frames)
        return {"position": translation.T, "orientation": log_rotations(rotation).T}

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return relative poses from each configuration to the next one, and from the last to the first."""
        q = conditions.q
        following = np.roll(np.arange(len(q)), -1)
        poses = chain.poses(q)
        relative = se3.inverse(poses) @ poses[following]
        relative[:, :3, 3] += noise.position * rng.standard_normal((len(q), 3))
        turn = se3.exp3(noise.rotation * rng.standard_normal((len(q), 3)))
        relative[:, :3, :3] = relative[:, :3, :3] @ turn
        is_noisy = noise.position > 0 and noise.rotation > 0
        return cls(q, q[following], relative, *((noise.position, noise.rotation) if is_noisy else ()))
