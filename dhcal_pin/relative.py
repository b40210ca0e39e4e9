"""Relative poses of the tool between two configurations: odometry of a camera or a tracker on the arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from . import se3
from .chain import Chain, Sweep
from .measurements import ANGLE_SIGMA, LENGTH_SIGMA, Noise, checked, checked_sigma, gathered, need
from .poses import PoseReading, pose_columns, poses_of
from .se3 import Array

_SHIFT, _TURN = ("dx", "dy", "dz"), ("drx", "dry", "drz")
_SHIFT_SIGMA, _TURN_SIGMA = (tuple(f"sigma_{name}" for name in names) for names in (_SHIFT, _TURN))


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
        poses = sweep.poses()
        return poses[: len(self.rows)], poses[len(self.rows) :]

    def _gap(self, sweep: Sweep) -> tuple[Array, Array]:
        """Translation error (m, 3) in frame a, and E = R_modelᵀ·R_measured (m, 3, 3) in frame b."""
        first, second = self._ends(sweep)
        model = se3.inverse(first) @ second
        return (self.poses - model)[:, :3, 3], np.swapaxes(model[:, :3, :3], 1, 2) @ self.poses[:, :3, :3]

    def residual(self, sweep: Sweep, u: Array) -> Array:
        """(6, m)."""
        shift, turn = self._gap(sweep)
        return np.concatenate([shift.T / self.sigma.T, se3.log3(turn).T / self.rotation_sigma.T])

    def _rates(self, sweep: Sweep, velocities: Array) -> tuple[Array, Array]:
        """d(translation in a) (p, m, 3) and body rates of the model's rotation in frame b (p, m, 3)."""
        first, second = self._ends(sweep)
        m = len(self.rows)
        va, wa, vb, wb = (
            velocities[:, rows, part].transpose(0, 2, 1)
            for part in (slice(0, m), slice(m, 2 * m))
            for rows in (slice(0, 3), slice(3, 6))
        )
        arm = second[:, :3, 3] - first[:, :3, 3]
        shift = np.einsum("mji,pmj->pmi", first[:, :3, :3], vb - va - np.cross(wa, arm[None]))
        return shift, np.einsum("mji,pmj->pmi", second[:, :3, :3], wb - wa)

    def whiten(self, sweep: Sweep, velocities: Array, u: Array) -> Array:
        """(p, 6, m); log3(exp(-ω)·E) = φ - Jl⁻¹(φ)·ω."""
        shift, rate = self._rates(sweep, velocities)
        left = np.swapaxes(se3.right_jacobian_inverse(se3.log3(self._gap(sweep)[1])), 1, 2)
        turned = np.einsum("mij,pmj->pmi", left, rate)
        return np.concatenate([shift / self.sigma, turned / self.rotation_sigma], -1).transpose(0, 2, 1)

    def small_angle(self, sweep: Sweep, velocities: Array, u: Array) -> tuple[Array, Array]:
        """The rotation as half the vee of E - Eᵀ, and its derivative as the rate itself."""
        gap, turn = self._gap(sweep)
        half = 0.5 * (turn - np.swapaxes(turn, 1, 2))
        sine = np.stack([half[:, 2, 1], half[:, 0, 2], half[:, 1, 0]])
        shift, rate = self._rates(sweep, velocities)
        rows = np.concatenate([shift / self.sigma, rate / self.rotation_sigma], -1).transpose(0, 2, 1)
        return np.concatenate([gap.T / self.sigma.T, sine / self.rotation_sigma.T]), rows

    def errors(self, sweep: Sweep, u: Array) -> dict[str, Array]:
        """{"position": (m, 3) in m, "orientation": (m, 3) in rad}."""
        shift, turn = self._gap(sweep)
        return {"position": shift, "orientation": se3.log3(turn)}

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
