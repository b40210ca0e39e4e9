"""Relative poses of the tool between two configurations: odometry of a camera or a tracker on the arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from . import se3
from .chain import Chain
from .kinematics import Mixture, Sweep
from .loops import log_rotations, right_jacobian_inverses
from .measurements import ANGLE_SIGMA, LENGTH_SIGMA, Noise, checked, checked_sigma, gathered, need
from .poses import PoseReading, pose_columns, poses_of
from .se3 import Array

_SHIFT, _TURN = ("dx", "dy", "dz"), ("drx", "dry", "drz")
_SHIFT_SIGMA, _TURN_SIGMA = (tuple(f"sigma_{name}" for name in names) for names in (_SHIFT, _TURN))

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
    reads: ClassVar[tuple[tuple[str, ...], tuple[str, ...]]] = (_SHIFT, _TURN)
    per_row: ClassVar[tuple[str, ...]] = (*PoseReading.per_row, "q_to")
    columns: ClassVar[Mapping[str, str]] = pose_columns(_SHIFT, _TURN)
    needs: ClassVar[tuple[frozenset[str], ...]] = (need(*_SHIFT, *_TURN),)
    ends: ClassVar[int] = 2

    @classmethod
    def from_columns(cls, q: Sequence[Array], values: Mapping[str, Any]) -> RelativePose:
        """dx, dy, dz and the rotation vector drx, dry, drz from JOINT to to:JOINT, and sigmas."""
        poses = poses_of(values, _SHIFT, _TURN)
        return cls.of(q[0], q[1], poses, gathered(values, _SHIFT_SIGMA), gathered(values, _TURN_SIGMA))

    @classmethod
    def of(
        cls,
        q: ArrayLike,
        q_to: ArrayLike,
        poses: ArrayLike,
        sigma: ArrayLike | None = None,
        rotation_sigma: ArrayLike | None = None,
    ) -> RelativePose:
        """Checked relative poses (m, 4, 4) between configurations (m, n) and (m, n)."""
        q = checked(q, (None, None), "q")
        m, stated = len(q), sigma is not None
        return cls(
            q,
            checked(poses, (m, 4, 4), "poses"),
            checked_sigma(LENGTH_SIGMA if sigma is None else sigma, (m, 3), "sigma"),
            checked_sigma(
                ANGLE_SIGMA if rotation_sigma is None else rotation_sigma, (m, 3), "rotation_sigma"
            ),
            np.arange(1, m + 1),
            stated,
            checked(q_to, q.shape, "q_to"),
        )

    def configurations(self) -> Array:
        """First configurations, then second ones, (2m, n)."""
        return np.concatenate([self.q, self.q_to])

    def _ends(self, sweep: Sweep) -> tuple[Array, Array]:
        """The tool's columns x, y, z, p at a and at b, (4, 3, m) each."""
        m = len(self.rows)
        return sweep.tool[..., :m], sweep.tool[..., m:]

    def _gap(self, sweep: Sweep) -> tuple[Array, Array]:
        """Translation error (3, m) in frame a, and E = R_modelᵀ·R_measured (3, 3, m) in frame b."""
        first, second = self._ends(sweep)
        measured = self._measured
        # R_bᵀ·R_a·R_measured: the rows are those of the model's rotation from a to b.
        between = np.einsum("ikm,jkm->ijm", second[:3], first[:3])
        turn = np.einsum("ijm,jkm->ikm", between, measured[:, :3])
        return measured[:, 3] - np.einsum("ikm,km->im", first[:3], second[3] - first[3]), turn

    def residual(self, sweep: Sweep, u: Array) -> Array:
        """(6, m)."""
        shift, turn = self._gap(sweep)
        return np.concatenate([shift, log_rotations(turn)]) * self._weights

    def _mixture(self, sweep: Sweep, turning: Array) -> Mixture:
        """Rates of the translation in a, and of the model's rotation from a to b turned by (3, 3, m)."""
        first, second = self._ends(sweep)
        arm = second[3] - first[3]
        # Of the translation by v_a, ω_a and v_b: R_aᵀ·(v_b - v_a - ω_a × arm).
        shift = first[:3] * self._weights[:3, None]
        levers = np.cross(shift, arm[None], axis=1)
        turn = np.einsum("ikm,kjm->ijm", turning, second[:3]) * self._weights[3:, None]
        linear = np.concatenate([-shift, levers, shift], 1)
        angular = np.concatenate([-turn, turn], 1)
        return Mixture(*_TERMS, np.concatenate([linear.reshape(27, -1), angular.reshape(18, -1)]))

    def mixture(self, sweep: Sweep, u: Array, residual: Array) -> Mixture:
        """log3(exp(-ω)·E) = φ - Jl⁻¹(φ)·ω, Jl⁻¹ being the transpose of Jr⁻¹."""
        right = right_jacobian_inverses(residual[3:] / self._weights[3:])
        return self._mixture(sweep, right.swapaxes(0, 1))

    def small_angle(self, sweep: Sweep, u: Array) -> tuple[Array, Mixture]:
        """The rotation as half the vee of E - Eᵀ, and its derivative as the rate itself."""
        gap, turn = self._gap(sweep)
        half = 0.5 * (turn - np.swapaxes(turn, 0, 1))
        sine = np.stack([half[2, 1], half[0, 2], half[1, 0]])
        still = np.broadcast_to(np.eye(3)[..., None], turn.shape)
        return np.concatenate([gap, sine]) * self._weights, self._mixture(sweep, still)

    def errors(self, sweep: Sweep, u: Array) -> dict[str, Array]:
        """{"position": (m, 3) in m, "orientation": (m, 3) in rad}."""
        shift, turn = self._gap(sweep)
        return {"position": shift.T, "orientation": log_rotations(turn).T}

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> RelativePose:
        """Relative poses from each configuration to the next, the last to the first."""
        q = chain.checked(q)
        other = np.roll(np.arange(len(q)), -1)
        pose = chain.poses(q)
        relative = se3.inverse(pose) @ pose[other]
        relative[:, :3, 3] += noise.position * rng.standard_normal((len(q), 3))
        relative[:, :3, :3] = relative[:, :3, :3] @ se3.exp3(
            noise.rotation * rng.standard_normal((len(q), 3))
        )
        known = noise.position > 0 and noise.rotation > 0
        return cls.of(
            q, q[other], relative, noise.position if known else None, noise.rotation if known else None
        )
