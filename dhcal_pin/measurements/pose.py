"""Instruments that read the tool's place and rotation: poses, and what pose readings have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._kernels import log_rotations, right_jacobian_inverse_batch
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..exceptions import DhcalError
from ..robot.chain import Chain
from .base import (
    ANGLE_SIGMA,
    LENGTH_SIGMA,
    InstrumentParameter,
    Noise,
    columns_together,
    length_columns,
    stack_columns,
    validated_array,
    validated_sigma,
)

_AXES = ("x", "y", "z")


_ROTVEC = ("rx", "ry", "rz")


_SIGMAS = tuple(f"sigma_{name}" for name in _AXES)


_ROTVEC_SIGMAS = tuple(f"sigma_{name}" for name in _ROTVEC)


# Rows and components of a mixture: the position's by its own, the rotation's each by all three.
_EXACT = (
    np.array([0, 1, 2, *np.repeat([3, 4, 5], 3)]),
    np.array([0, 1, 2, *np.tile([3, 4, 5], 3)]),
)


@dataclass(frozen=True, eq=False)
class PoseReading:
    """A reading of a rigid motion, with sigmas of its position and of its rotation.

    Attributes:
        q: (m, n) joint values, rad or m.
        poses: (m, 4, 4).
        sigma: (m, 3) of the position, m.
        rotation_sigma: (m, 3) of the rotation vector, rad.
        rows: (m,) row numbers.
        has_stated_sigma: whether the sigmas are the instrument's own.
    """

    q: Array
    poses: Array
    sigma: Array
    rotation_sigma: Array
    rows: Array
    has_stated_sigma: bool

    residual_groups: ClassVar[Mapping[str, slice]] = {"position": slice(0, 3), "orientation": slice(3, 6)}
    # Names of the position's and of the rotation vector's columns.
    value_columns: ClassVar[tuple[tuple[str, ...], tuple[str, ...]]]
    is_contact: ClassVar[bool] = False
    has_length_scale: ClassVar[bool] = True
    # Fields with an entry a sample.
    sample_fields: ClassVar[tuple[str, ...]] = ("q", "poses", "sigma", "rotation_sigma", "rows")

    @cached_property
    def _weights(self) -> Array:
        """One over both sigmas, (6, m), the samples last in memory."""
        return 1 / np.ascontiguousarray(np.concatenate([self.sigma, self.rotation_sigma], 1).T)

    @cached_property
    def _measured(self) -> Array:
        """Rows and columns of the poses (3, 4, m), the samples last in memory."""
        return np.ascontiguousarray(self.poses[:, :3].transpose(1, 2, 0))

    @property
    def residual_dim(self) -> int:
        """Three of the position, three of the rotation."""
        return 6

    @property
    def instrument_parameters(self) -> tuple[InstrumentParameter, ...]:
        """None."""
        return ()

    def configurations(self) -> Array:
        """As they are, (m, n)."""
        return self.q

    def initialized(self, chain: Chain) -> Self:
        """Nothing to start."""
        return self

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Nothing, (0, 6, m)."""
        return np.empty((0, 6, len(self.rows)))

    def positions(self) -> Array:
        """None, (0, 3)."""
        return np.empty((0, 3))

    def rotations(self) -> Array:
        """None, (0, 3, 3)."""
        return np.empty((0, 3, 3))

    def with_scaled_sigma(self, scales: Mapping[str, float]) -> Self:
        """The same readings with sigmas multiplied."""
        return replace(
            self,
            sigma=self.sigma * scales["position"],
            rotation_sigma=self.rotation_sigma * scales["orientation"],
        )

    def with_weights(self, weights: Array) -> Self:
        """The same readings with each sample counting for a weight (m,), by wider sigmas."""
        wider = 1 / np.sqrt(weights)[:, None]
        return replace(self, sigma=self.sigma * wider, rotation_sigma=self.rotation_sigma * wider)

    def take(self, index: Array | slice) -> Self:
        """The samples of an index or mask."""
        return replace(self, **{name: getattr(self, name)[index] for name in self.sample_fields})

    def to_columns(self) -> dict[str, Any]:
        """Position, rotation vector, and sigmas where these are the instrument's own."""
        shift, turn = self.value_columns
        rotvec = se3.log3(self.poses[:, :3, :3])
        out = {name: self.poses[:, i, 3] for i, name in enumerate(shift)}
        out |= {name: rotvec[:, i] for i, name in enumerate(turn)}
        if self.has_stated_sigma:
            out |= {f"sigma_{name}": self.sigma[:, i] for i, name in enumerate(shift)}
            out |= {f"sigma_{name}": self.rotation_sigma[:, i] for i, name in enumerate(turn)}
        return out


def pose_columns(shift: Sequence[str], turn: Sequence[str]) -> dict[str, str]:
    """Columns of a pose reading: lengths, angles, and the sigmas of both."""
    return length_columns(*shift) | dict.fromkeys([*turn, *(f"sigma_{name}" for name in turn)], "angle")


def poses_from_columns(values: Mapping[str, Any], shift: Sequence[str], turn: Sequence[str]) -> Array:
    """Poses (m, 4, 4) of a file's position and rotation vector columns."""
    return se3.transform(se3.exp3(stack_columns(values, turn)), stack_columns(values, shift))


@dataclass(frozen=True, eq=False)
class Pose(PoseReading):
    """Poses of the tool in the measuring frame: position as above, rotation as rotation vectors.

    The rotation residual is log3(R_measured·R_modelᵀ) in axes of the measuring frame, differentiated
    exactly.
    """

    kind: ClassVar[str] = "pose"
    value_columns: ClassVar[tuple[tuple[str, ...], tuple[str, ...]]] = (_AXES, _ROTVEC)
    columns: ClassVar[Mapping[str, str]] = pose_columns(_AXES, _ROTVEC)
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together(*_AXES, *_ROTVEC),)
    configurations_per_row: ClassVar[int] = 1

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> Pose:
        """x, y, z, the rotation vector rx, ry, rz, and the sigmas of both or neither."""
        poses = poses_from_columns(values, _AXES, _ROTVEC)
        return cls.from_arrays(
            q[0], poses, stack_columns(values, _SIGMAS), stack_columns(values, _ROTVEC_SIGMAS)
        )

    @classmethod
    def from_arrays(
        cls,
        q: Array,
        poses: Array,
        sigma: Array | float | None = None,
        rotation_sigma: Array | float | None = None,
    ) -> Pose:
        """Checked poses (m, 4, 4) at joint values (m, n).

        Sigmas are one number or (m, 3), m and rad, both or neither; without them they are estimated
        with the fit.
        """
        q = validated_array(q, (None, None), "q")
        poses = validated_array(poses, (len(q), 4, 4), "poses")
        rotation = poses[:, :3, :3]
        off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
        bad = np.flatnonzero((off > 1e-6) | (np.linalg.det(rotation) < 0))
        if bad.size:
            raise DhcalError(
                f"poses: number {bad[0] + 1} is not a rotation (RRᵀ differs from I by {off[bad[0]]:.2g})"
            )
        if (sigma is None) != (rotation_sigma is None):
            raise DhcalError("poses need the sigmas of position and of rotation, or neither")
        m, stated = len(q), sigma is not None
        return cls(
            q,
            poses,
            validated_sigma(sigma if stated else LENGTH_SIGMA, (m, 3), "sigma"),
            validated_sigma(rotation_sigma if stated else ANGLE_SIGMA, (m, 3), "rotation_sigma"),
            np.arange(1, m + 1),
            stated,
        )

    def positions(self) -> Array:
        """As measured, (m, 3)."""
        return self.poses[:, :3, 3]

    def rotations(self) -> Array:
        """As measured, (m, 3, 3)."""
        return self.poses[:, :3, :3]

    def _rotation_error(self, frames: FrameBatch) -> Array:
        """R_measured·R_modelᵀ (3, 3, m)."""
        return np.einsum("ikm,kjm->ijm", self._measured[:, :3], frames.tool[:3])

    def _rotvec(self, frames: FrameBatch) -> Array:
        """The turn's rotation vector (3, m)."""
        return log_rotations(self._rotation_error(frames))

    def _position(self, frames: FrameBatch) -> Array:
        return self._measured[:, 3] - frames.tool[3]

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """(6, m): x, y, z, then the rotation vector, over sigma."""
        return np.concatenate([self._position(frames), self._rotvec(frames)]) * self._weights

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """log3(E·exp(-ω)) = φ - Jr⁻¹(φ)·ω."""
        weights = self._weights
        turning = right_jacobian_inverse_batch(residual[3:] / weights[3:])
        turning *= weights[3:, None]
        return ObservationMatrix(*_EXACT, np.concatenate([weights[:3], turning.reshape(9, -1)]))

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """Half the vee of E - Eᵀ, E = R_measured·R_modelᵀ, is (36) seen in the measuring frame."""
        turn = self._rotation_error(frames)
        difference = 0.5 * (turn - np.swapaxes(turn, 0, 1))
        sine = np.stack([difference[2, 1], difference[0, 2], difference[1, 0]])
        residual = np.concatenate([self._position(frames), sine]) * self._weights
        return residual, ObservationMatrix(np.arange(6), np.arange(6), self._weights)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """{"position": (m, 3) in m, "orientation": (m, 3) rotation vectors in rad}."""
        return {
            "position": self.poses[:, :3, 3] - frames.tool[3].T,
            "orientation": self._rotvec(frames).T,
        }

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Pose:
        """Poses of a chain's tool with normal noise an axis."""
        q = chain.validated_q(q)
        poses = chain.poses(q)
        poses[:, :3, 3] += noise.position * rng.standard_normal((len(q), 3))
        poses[:, :3, :3] = se3.exp3(noise.rotation * rng.standard_normal((len(q), 3))) @ poses[:, :3, :3]
        known = noise.position > 0 and noise.rotation > 0
        return cls.from_arrays(q, poses, noise.position if known else None, noise.rotation if known else None)


_TRANSLATION, _ROTATION = ("dx", "dy", "dz"), ("drx", "dry", "drz")


_TRANSLATION_SIGMA, _ROTATION_SIGMA = (
    tuple(f"sigma_{name}" for name in names) for names in (_TRANSLATION, _ROTATION)
)


# Rows and components of a mixture: the translation by v_a, ω_a and v_b, the rotation by ω_a and ω_b.
_TERMS = (
    np.concatenate([np.repeat([0, 1, 2], 9), np.repeat([3, 4, 5], 6)]),
    np.concatenate([np.tile(np.arange(9), 3), np.tile([3, 4, 5, 9, 10, 11], 3)]),
)


@dataclass(frozen=True, eq=False)
class RelativePose(PoseReading):
    """T_ab (m, 4, 4), the tool's pose in configuration b seen from configuration a.

    Residuals are the translation in frame a, and log3(R_measuredᵀ·R_model) with its sign turned, in frame b.
    Sees nothing of the base: six directions stay unseen.

    Attributes:
        q_to: (m, n) joint values at b; `q` are those at a.
    """

    q_to: Array = field(default_factory=lambda: np.empty((0, 0)))

    kind: ClassVar[str] = "relative"
    value_columns: ClassVar[tuple[tuple[str, ...], tuple[str, ...]]] = (_TRANSLATION, _ROTATION)
    sample_fields: ClassVar[tuple[str, ...]] = (*PoseReading.sample_fields, "q_to")
    columns: ClassVar[Mapping[str, str]] = pose_columns(_TRANSLATION, _ROTATION)
    required_columns: ClassVar[tuple[frozenset[str], ...]] = (columns_together(*_TRANSLATION, *_ROTATION),)
    configurations_per_row: ClassVar[int] = 2

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> RelativePose:
        """dx, dy, dz and the rotation vector drx, dry, drz from JOINT to to:JOINT, and sigmas."""
        poses = poses_from_columns(values, _TRANSLATION, _ROTATION)
        return cls.from_arrays(
            q[0],
            q[1],
            poses,
            stack_columns(values, _TRANSLATION_SIGMA),
            stack_columns(values, _ROTATION_SIGMA),
        )

    @classmethod
    def from_arrays(
        cls,
        q: ArrayLike,
        q_to: ArrayLike,
        poses: ArrayLike,
        sigma: ArrayLike | None = None,
        rotation_sigma: ArrayLike | None = None,
    ) -> RelativePose:
        """Checked relative poses (m, 4, 4) between configurations (m, n) and (m, n)."""
        q = validated_array(q, (None, None), "q")
        m, stated = len(q), sigma is not None
        return cls(
            q,
            validated_array(poses, (m, 4, 4), "poses"),
            validated_sigma(LENGTH_SIGMA if sigma is None else sigma, (m, 3), "sigma"),
            validated_sigma(
                ANGLE_SIGMA if rotation_sigma is None else rotation_sigma, (m, 3), "rotation_sigma"
            ),
            np.arange(1, m + 1),
            stated,
            validated_array(q_to, q.shape, "q_to"),
        )

    def configurations(self) -> Array:
        """First configurations, then second ones, (2m, n)."""
        return np.concatenate([self.q, self.q_to])

    def _frames_at_both(self, frames: FrameBatch) -> tuple[Array, Array]:
        """The tool's columns x, y, z, p at a and at b, (4, 3, m) each."""
        m = len(self.rows)
        return frames.tool[..., :m], frames.tool[..., m:]

    def _error(self, frames: FrameBatch) -> tuple[Array, Array]:
        """Translation error (3, m) in frame a, and E = R_modelᵀ·R_measured (3, 3, m) in frame b."""
        first, second = self._frames_at_both(frames)
        measured = self._measured
        # R_bᵀ·R_a·R_measured: the rows are those of the model's rotation from a to b.
        between = np.einsum("ikm,jkm->ijm", second[:3], first[:3])
        turn = np.einsum("ijm,jkm->ikm", between, measured[:, :3])
        return measured[:, 3] - np.einsum("ikm,km->im", first[:3], second[3] - first[3]), turn

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """(6, m)."""
        shift, turn = self._error(frames)
        return np.concatenate([shift, log_rotations(turn)]) * self._weights

    def _observation_matrix(self, frames: FrameBatch, turning: Array) -> ObservationMatrix:
        """Rates of the translation in a, and of the model's rotation from a to b turned by (3, 3, m)."""
        first, second = self._frames_at_both(frames)
        arm = second[3] - first[3]
        # Of the translation by v_a, ω_a and v_b: R_aᵀ·(v_b - v_a - ω_a × arm).
        shift = first[:3] * self._weights[:3, None]
        levers = np.cross(shift, arm[None], axis=1)
        turn = np.einsum("ikm,kjm->ijm", turning, second[:3]) * self._weights[3:, None]
        linear = np.concatenate([-shift, levers, shift], 1)
        angular = np.concatenate([-turn, turn], 1)
        return ObservationMatrix(*_TERMS, np.concatenate([linear.reshape(27, -1), angular.reshape(18, -1)]))

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """log3(exp(-ω)·E) = φ - Jl⁻¹(φ)·ω, Jl⁻¹ being the transpose of Jr⁻¹."""
        right = right_jacobian_inverse_batch(residual[3:] / self._weights[3:])
        return self._observation_matrix(frames, right.swapaxes(0, 1))

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """The rotation as half the vee of E - Eᵀ, and its derivative as the rate itself."""
        gap, turn = self._error(frames)
        half = 0.5 * (turn - np.swapaxes(turn, 0, 1))
        sine = np.stack([half[2, 1], half[0, 2], half[1, 0]])
        still = np.broadcast_to(np.eye(3)[..., None], turn.shape)
        return np.concatenate([gap, sine]) * self._weights, self._observation_matrix(frames, still)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """{"position": (m, 3) in m, "orientation": (m, 3) in rad}."""
        shift, turn = self._error(frames)
        return {"position": shift.T, "orientation": log_rotations(turn).T}

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> RelativePose:
        """Relative poses from each configuration to the next, the last to the first."""
        q = chain.validated_q(q)
        other = np.roll(np.arange(len(q)), -1)
        pose = chain.poses(q)
        relative = se3.inverse(pose) @ pose[other]
        relative[:, :3, 3] += noise.position * rng.standard_normal((len(q), 3))
        relative[:, :3, :3] = relative[:, :3, :3] @ se3.exp3(
            noise.rotation * rng.standard_normal((len(q), 3))
        )
        known = noise.position > 0 and noise.rotation > 0
        return cls.from_arrays(
            q, q[other], relative, noise.position if known else None, noise.rotation if known else None
        )
