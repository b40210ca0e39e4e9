"""Inclination: the direction of gravity in a sensor on the tool.

Let g be the unit vector upwards in the measuring frame, R the rotation of the tool and S that of the sensor
in the tool frame. The sensor sees

    h = Sᵀ·Rᵀ·g,     R = [tool], S = exp(s), g = exp([t_x, t_y, 0])·z,

with the five instrument parameters s (`inclinometer.rx, .ry, .rz`) and t (`gravity.x, .y`). Roll and pitch
are the rotations of the sensor about its x axis, then about its y axis, that explain the direction:

    h = (-cos(roll)·sin(pitch), sin(roll), cos(roll)·cos(pitch)).

With unit vectors e_1, e_2 along the changes of h by roll and pitch at the measured values, the residuals are
the angles -e_i·h, zero for the measured direction. With the rotation ω of the tool, dh = Sᵀ·Rᵀ·(g × ω).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from .._kernels.types import FrameBatch, ObservationMatrix
from .._typing import Array
from ..robot.chain import Chain
from .base import ANGLE_SIGMA, InstrumentParameter, Measurement, Noise, format_sigma
from .columns import angle_columns
from .groups import Group
from .validation import validated_array, validated_joint_positions, validated_sigma

# Prior standard deviations [rad]: of the rotation of the sensor from its initial value, and of the direction
# of gravity from the z axis of the base.
SENSOR_PRIOR, TILT_PRIOR = 1.0, 0.1
_UP = np.array([0.0, 0.0, 1.0])
# Rows and velocity components of the terms: both angles by all three angular velocities.
_TERMS = (np.repeat([0, 1], 3), np.tile([3, 4, 5], 2))


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Inclination(Measurement):
    """Roll and pitch of a sensor on the tool.

    The rotation of the sensor on the tool and the direction of gravity are estimated. Rotations about gravity
    and lengths are not observable.

    Attributes:
        angles: Roll and pitch, (m, 2) [rad].
        sigma: Standard deviations of the direction about x and y of the sensor, (m, 2) [rad].
    """

    angles: Array
    sigma: Array

    kind = "inclination"
    residual_groups: ClassVar = {"inclination": Group(slice(0, 2), "rad", "inclination error")}
    COLUMNS = angle_columns("angles", "roll", "pitch")
    sample_fields = (*Measurement.sample_fields, "angles", "sigma")
    has_length_scale = False

    def __init__(self, q: ArrayLike, angles: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Check and store measured angles.

        Args:
            q: Joint positions, (m, n) [rad or m].
            angles: Roll and pitch, (m, 2) [rad].
            sigma: Standard deviations, one number or (m, 2) [rad]; estimated with the fit if None.
        """
        q = validated_joint_positions(q, "Inclination")
        self._initialize(
            q=q,
            rows=np.arange(1, len(q) + 1),
            source="",
            angles=validated_array(angles, (len(q), 2), "Inclination: angles", "pair of angles"),
            sigma=validated_sigma(ANGLE_SIGMA if sigma is None else sigma, (len(q), 2), "Inclination: sigma"),
            has_stated_sigma=sigma is not None,
            instrument_parameters=_parameters(np.zeros(3), np.zeros(2)),
        )

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [
            format_sigma((self.sigma, 180 / np.pi, "deg")) if self.has_stated_sigma else "sigma not stated"
        ]

    @property
    def residual_dim(self) -> int:
        """Number of residuals per sample: two angles."""
        return 2

    @cached_property
    def _weighted_axes(self) -> Array:
        """Unit vectors e_1, e_2 divided by their standard deviations, (2, 3, m)."""
        (sin_r, sin_p), (cos_r, cos_p) = np.sin(self.angles.T), np.cos(self.angles.T)
        zero = np.zeros_like(sin_r)
        axes = np.array([[sin_r * sin_p, cos_r, -sin_r * cos_p], [-cos_p, zero, -sin_p]])
        return axes / self.sigma.T[:, None]

    def _directions(self) -> Array:
        """Return the measured directions of gravity in the sensor, upwards, (m, 3)."""
        (sin_r, sin_p), (cos_r, cos_p) = np.sin(self.angles.T), np.cos(self.angles.T)
        return np.stack([-cos_r * sin_p, sin_r, cos_r * cos_p], -1)

    @staticmethod
    def _model(frames: FrameBatch, u: Array) -> tuple[Array, Array, Array, Array]:
        """Return h (3, m), Sᵀ·Rᵀ (3, 3, m), g (3,) and the rotation of gravity (3, 3)."""
        rotation, tilt = se3.exp3(u[:3]), se3.exp3(np.append(u[3:], 0.0))
        to_sensor = np.einsum("ji,jkm->ikm", rotation, frames.tool[:3])
        up = tilt @ _UP
        return np.einsum("ikm,k->im", to_sensor, up), to_sensor, up, tilt

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened angles (2, m) between the measured and the modelled direction."""
        return -np.einsum("rim,im->rm", self._weighted_axes, self._model(frames, u)[0])

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the derivatives by the angular velocities of the tool."""
        _, to_sensor, up, _ = self._model(frames, u)
        by_rotation = np.einsum("ijm,jk->ikm", to_sensor, se3.skew(up))
        terms = np.einsum("rim,ikm->rkm", self._weighted_axes, by_rotation)
        return ObservationMatrix(*_TERMS, terms.reshape(6, -1))

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivatives (5, 2, m) of the whitened model by the sensor and the gravity."""
        h, to_sensor, _, tilt = self._model(frames, u)
        by_sensor = se3.skew(h.T) @ _right_jacobian(u[:3])
        by_tilt = -tilt @ se3.skew(_UP) @ _right_jacobian(np.append(u[3:], 0.0))[:, :2]
        by_gravity = np.einsum("ijm,js->mis", to_sensor, by_tilt)
        return np.einsum("rim,mis->srm", self._weighted_axes, np.concatenate([by_sensor, by_gravity], 2))

    def small_angle(self, frames: FrameBatch, u: Array) -> tuple[Array, ObservationMatrix]:
        """Return the exact residuals and observation matrix."""
        residual = self.residual(frames, u)
        return residual, self.observation_matrix(frames, u, residual)

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return the angles "inclination" (m, 2) [rad]."""
        return {"inclination": self.residual(frames, u).T * self.sigma}

    def initialized(self, chain: Chain) -> Self:
        """Return a copy that starts with gravity along the base and the sensor that fits best (Wahba)."""
        up = chain.base[:3, 2]
        seen = chain.poses(self.q)[:, :3, :3].swapaxes(1, 2) @ up
        sensor = se3.nearest_rotation(seen.T @ self._directions()) if len(seen) else np.eye(3)
        angle, across = np.arccos(np.clip(up[2], -1, 1)), np.hypot(*up[:2])
        tilt = np.array([-up[1], up[0]]) * (angle / across if across else 0.0)
        return self.replace(instrument_parameters=_parameters(se3.log3(sensor), tilt))

    def with_scaled_sigma(self, scales: Mapping[str, float]) -> Self:
        """Return a copy with multiplied standard deviations of "inclination"."""
        return self.replace(sigma=self.sigma * scales["inclination"])

    def with_weights(self, weights: Array) -> Self:
        """Return a copy with standard deviations divided by the square roots of the weights (m,)."""
        return self.replace(sigma=self.sigma / np.sqrt(weights)[:, None])

    def _columns_and_sigmas(self) -> tuple[dict[str, Any], dict[str, Any]]:
        names = [column.name for column in self.COLUMNS]
        return (
            dict(zip(names, self.angles.T, strict=True)),
            {f"sigma_{name}": sigma for name, sigma in zip(names, self.sigma.T, strict=True)},
        )

    @classmethod
    def simulate(cls, chain: Chain, q: Array, noise: Noise, rng: np.random.Generator) -> Inclination:
        """Return inclinations of a sensor that is turned on the tool, with normal noise of the direction."""
        q = chain.validated_q(q)
        sensor = se3.exp3([0.3, -0.2, 0.4])
        up = chain.base[:3, 2]
        direction = (chain.poses(q)[:, :3, :3] @ sensor).swapaxes(1, 2) @ up
        direction = direction + noise.rotation * rng.standard_normal(direction.shape)
        x, y, z = direction.T / np.linalg.norm(direction, axis=1)
        angles = np.stack([np.arcsin(np.clip(y, -1, 1)), np.arctan2(-x, z)], -1)
        return cls(q, angles, noise.rotation or None)


def _right_jacobian(rotvec: Array) -> Array:
    """Return the right Jacobian of SO(3) at a rotation vector, (3, 3)."""
    return np.linalg.inv(se3.right_jacobian_inverse(rotvec))


def _parameters(sensor: Array, tilt: Array) -> tuple[InstrumentParameter, ...]:
    """Return the parameters of a sensor and of gravity."""
    return (
        *(
            InstrumentParameter(f"inclinometer.r{axis}", "rad", float(value), SENSOR_PRIOR)
            for axis, value in zip("xyz", sensor, strict=True)
        ),
        *(
            InstrumentParameter(f"gravity.{axis}", "rad", float(value), TILT_PRIOR)
            for axis, value in zip("xy", tilt, strict=True)
        ),
    )
