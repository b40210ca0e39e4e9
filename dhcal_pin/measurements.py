"""Kinds of measurement: what an instrument reads of the tool, and how that changes with the tool.

A kind holds joint values q (m, n) and its readings in SI. Given a sweep of frames it returns whitened
residuals, measured minus modelled over sigma, as (k, m); and it turns tool velocities (p, 6, m) into
the whitened rows' derivative (p, k, m). Components come first, so that (p, k·m) seen from LAPACK is a
Fortran matrix. The residual's derivative is minus that of the model, so a step solves rows·Δx = residual.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import numpy as np

from . import se3
from .chain import Chain, Sweep
from .errors import DhcalError
from .se3 import Array

# Without a sigma a millimetre weighs as much as a milliradian.
POSITION_SIGMA, ROTATION_SIGMA = 1e-3, 1e-3


class Measurement(Protocol):
    """What the solver asks of a kind."""

    kind: ClassVar[str]
    groups: ClassVar[dict[str, slice]]

    @property
    def q(self) -> Array:
        """Joint values (m, n), rad or m."""
        ...

    @property
    def rows(self) -> Array:
        """Row numbers (m,), the first reading of a file being 1."""
        ...

    @property
    def stated(self) -> bool:
        """Whether the sigmas are the instrument's own, not a placeholder to be estimated."""
        ...

    def positions(self) -> Array:
        """Measured positions (m, 3) of the tool point, or (0, 3) where the kind has none."""
        ...

    def rotations(self) -> Array:
        """Measured rotations (m, 3, 3) of the tool, or (0, 3, 3) where the kind has none."""
        ...

    def scaled(self, scales: Mapping[str, float]) -> Self:
        """The same readings with each group's sigmas multiplied."""
        ...

    def residual(self, sweep: Sweep) -> Array:
        """Whitened residuals (k, m); `groups` names its rows."""
        ...

    def whiten(self, sweep: Sweep, velocities: Array) -> Array:
        """Derivatives (p, k, m) of the whitened model from tool velocities (p, 6, m)."""
        ...

    def small_angle(self, sweep: Sweep, velocities: Array) -> tuple[Array, Array]:
        """The paper's rows: residual (k, m) by (35) and (36), derivative (p, k, m) by its R."""
        ...

    def errors(self, sweep: Sweep) -> dict[str, Array]:
        """Errors (m, 3) in m under "position" and in rad under "orientation", unweighted."""
        ...

    def take(self, index: Array | slice) -> Self:
        """The samples of an index or mask."""
        ...

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Self:
        """Readings of a chain with normal noise."""
        ...


@dataclass(frozen=True)
class Noise:
    """Standard deviations an axis: `position` in m, `rotation` in rad."""

    position: float = 0.0
    rotation: float = 0.0


def _sigma(value: Array, m: int, what: str) -> Array:
    value = np.asarray(value, float)
    try:
        value = np.array(np.broadcast_to(value, (m, 3)))
    except ValueError:
        raise DhcalError(f"{what} has shape {value.shape}; give one number or ({m}, 3)") from None
    if not (np.isfinite(value).all() and (value > 0).all()):
        raise DhcalError(f"{what} must be positive and finite")
    return value


def _finite(value: Array, shape: tuple[int | None, ...], what: str) -> Array:
    value = np.asarray(value, float)
    if value.ndim != len(shape) or any(
        w is not None and w != g for w, g in zip(shape, value.shape, strict=True)
    ):
        raise DhcalError(f"{what} has shape {value.shape}, needs {shape}".replace("None", "m"))
    if not np.isfinite(value).all():
        raise DhcalError(f"{what}: every value must be finite")
    return value


@dataclass(frozen=True, eq=False)
class Position:
    """Positions of the tool point in the measuring frame: laser tracker, CMM, trilaterated wires.

    Attributes:
        q: (m, n) joint values, rad or m.
        position: (m, 3) m.
        sigma: (m, 3) standard deviations, m.
        rows: (m,) row numbers, the first reading being 1.
        stated: whether sigma is the instrument's own.
    """

    q: Array
    position: Array
    sigma: Array
    rows: Array
    stated: bool

    kind: ClassVar = "position"
    groups: ClassVar = {"position": slice(0, 3)}

    @classmethod
    def of(cls, q: Array, position: Array, sigma: Array | float | None = None) -> Position:
        """Checked positions (m, 3) in m at joint values (m, n).

        sigma is one number or (m, 3); without it, it is estimated with the fit.
        """
        q = _finite(q, (None, None), "q")
        m = len(q)
        position = _finite(position, (m, 3), "position")
        stated = sigma is not None
        sigma = _sigma(np.asarray(sigma if stated else POSITION_SIGMA), m, "sigma")
        return cls(q, position, sigma, np.arange(1, m + 1), stated)

    def positions(self) -> Array:
        """As measured, (m, 3)."""
        return self.position

    def rotations(self) -> Array:
        """None, (0, 3, 3)."""
        return np.empty((0, 3, 3))

    def residual(self, sweep: Sweep) -> Array:
        """(3, m): x, y, z over sigma."""
        return (self.position.T - sweep.tool[3]) / self.sigma.T

    def whiten(self, sweep: Sweep, velocities: Array) -> Array:
        """(p, 3, m)."""
        return velocities[:, :3] / self.sigma.T

    def small_angle(self, sweep: Sweep, velocities: Array) -> tuple[Array, Array]:
        """The same rows: a position is linear already."""
        return self.residual(sweep), self.whiten(sweep, velocities)

    def errors(self, sweep: Sweep) -> dict[str, Array]:
        """{"position": (m, 3)} in m."""
        return {"position": self.position - sweep.tool[3].T}

    def take(self, index: Array | slice) -> Position:
        """The samples of an index or mask."""
        return replace(
            self,
            q=self.q[index],
            position=self.position[index],
            sigma=self.sigma[index],
            rows=self.rows[index],
        )

    def scaled(self, scales: Mapping[str, float]) -> Position:
        """The same readings with sigmas multiplied."""
        return replace(self, sigma=self.sigma * scales["position"])

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Position:
        """Positions (m, 3) of a chain's tool with normal noise an axis."""
        q = chain.checked(q)
        position = chain.sweep(q).tool[3].T + noise.position * rng.standard_normal((len(q), 3))
        return cls.of(q, position, noise.position or None)


@dataclass(frozen=True, eq=False)
class Pose:
    """Poses of the tool in the measuring frame: position as above, rotation as rotation vectors.

    The rotation residual is log3(R_measured·R_modelᵀ) in axes of the measuring frame, differentiated
    exactly.

    Attributes:
        q: (m, n) joint values, rad or m.
        poses: (m, 4, 4).
        sigma: (m, 3) of the position, m.
        rotation_sigma: (m, 3) about the measuring frame's axes, rad.
        rows: (m,) row numbers, the first reading being 1.
        stated: whether the sigmas are the instrument's own.
    """

    q: Array
    poses: Array
    sigma: Array
    rotation_sigma: Array
    rows: Array
    stated: bool

    kind: ClassVar = "pose"
    groups: ClassVar = {"position": slice(0, 3), "orientation": slice(3, 6)}

    @classmethod
    def of(
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
        q = _finite(q, (None, None), "q")
        poses = _finite(poses, (len(q), 4, 4), "poses")
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
            _sigma(np.asarray(sigma if stated else POSITION_SIGMA), m, "sigma"),
            _sigma(np.asarray(rotation_sigma if stated else ROTATION_SIGMA), m, "rotation_sigma"),
            np.arange(1, m + 1),
            stated,
        )

    def positions(self) -> Array:
        """As measured, (m, 3)."""
        return self.poses[:, :3, 3]

    def rotations(self) -> Array:
        """As measured, (m, 3, 3)."""
        return self.poses[:, :3, :3]

    def _turn(self, sweep: Sweep) -> Array:
        """R_measured·R_modelᵀ (m, 3, 3)."""
        return np.einsum("mik,kjm->mij", self.poses[:, :3, :3], sweep.tool[:3])

    def _position(self, sweep: Sweep) -> Array:
        return (self.poses[:, :3, 3].T - sweep.tool[3]) / self.sigma.T

    def residual(self, sweep: Sweep) -> Array:
        """(6, m): x, y, z, then the rotation vector, over sigma."""
        return np.concatenate([self._position(sweep), se3.log3(self._turn(sweep)).T / self.rotation_sigma.T])

    def whiten(self, sweep: Sweep, velocities: Array) -> Array:
        """(p, 6, m); log3(E·exp(-ω)) = φ - Jr⁻¹(φ)·ω."""
        out = np.empty_like(velocities)
        np.divide(velocities[:, :3], self.sigma.T, out=out[:, :3])
        mix = se3.right_jacobian_inverse(se3.log3(self._turn(sweep))) / self.rotation_sigma[:, :, None]
        mix = np.ascontiguousarray(mix.transpose(1, 2, 0))
        for i in range(3):
            row = mix[i, 0] * velocities[:, 3]
            row += mix[i, 1] * velocities[:, 4]
            row += mix[i, 2] * velocities[:, 5]
            out[:, 3 + i] = row
        return out

    def small_angle(self, sweep: Sweep, velocities: Array) -> tuple[Array, Array]:
        """Half the vee of E - Eᵀ, E = R_measured·R_modelᵀ, is (36) seen in the measuring frame."""
        turn = self._turn(sweep)
        difference = 0.5 * (turn - np.swapaxes(turn, 1, 2))
        sine = np.stack([difference[:, 2, 1], difference[:, 0, 2], difference[:, 1, 0]])
        residual = np.concatenate([self._position(sweep), sine / self.rotation_sigma.T])
        return residual, velocities / np.concatenate([self.sigma.T, self.rotation_sigma.T])

    def errors(self, sweep: Sweep) -> dict[str, Array]:
        """{"position": (m, 3) in m, "orientation": (m, 3) rotation vectors in rad}."""
        return {
            "position": self.poses[:, :3, 3] - sweep.tool[3].T,
            "orientation": se3.log3(self._turn(sweep)),
        }

    def take(self, index: Array | slice) -> Pose:
        """The samples of an index or mask."""
        return replace(
            self,
            q=self.q[index],
            poses=self.poses[index],
            sigma=self.sigma[index],
            rotation_sigma=self.rotation_sigma[index],
            rows=self.rows[index],
        )

    def scaled(self, scales: Mapping[str, float]) -> Pose:
        """The same readings with sigmas multiplied."""
        return replace(
            self,
            sigma=self.sigma * scales["position"],
            rotation_sigma=self.rotation_sigma * scales["orientation"],
        )

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Pose:
        """Poses (m, 4, 4) of a chain's tool with normal noise an axis."""
        q = chain.checked(q)
        poses = chain.poses(q)
        poses[:, :3, 3] += noise.position * rng.standard_normal((len(q), 3))
        poses[:, :3, :3] = se3.exp3(noise.rotation * rng.standard_normal((len(q), 3))) @ poses[:, :3, :3]
        known = noise.position > 0 and noise.rotation > 0
        return cls.of(q, poses, noise.position if known else None, noise.rotation if known else None)


KINDS: dict[str, type[Position] | type[Pose]] = {"position": Position, "pose": Pose}
