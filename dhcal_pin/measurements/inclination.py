"""Inclination: the direction of gravity in a sensor on a link.

Let g be the unit vector upwards in the measuring frame, R the rotation of the link and S that of the sensor
in the link. The sensor sees the upward direction

    h = Sᵀ·Rᵀ·g,     S = exp(s),     ±g = exp([t_x, t_y, 0])·z,

with the five instrument parameters s (`inclinometer.rx, .ry, .rz`) and t (`up.x, .y`; with the minus sign, if
the z axis of the measuring frame points down, `down.x, .y`). An accelerometer at rest measures the upward
direction a. With the rotation Ry(pitch)·Rx(roll) of a sensor that was level,

    roll = atan2(a_y, a_z),     pitch = atan2(-a_x, √(a_y² + a_z²)).

The residuals are the components of the angle θ from the measured direction a to h, along the unit vectors
e_1, e_2 in which a moves with roll and pitch:

    r_i = -f·(e_i·h),                            f = θ/sin θ,
    dr_i = -f·(e_i·dh) - f'·(e_i·h)·(a·dh),      f' = (f·cos θ - 1)/sin²θ.

With the rotation ω of the link, dh = Sᵀ·Rᵀ·(g × ω).

Gauge: g is a direction in the measuring frame, such as that of a tracker, which need not be level.
Inclinations alone determine g in the base only: base and g can turn together. The tilt of the base is then
that of g, or that of the base if g is known (`up.x` = `up.y` = 0).
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
from ..exceptions import InvalidArgumentError, SampleError
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from .base import ANGLE_SIGMA, InstrumentParameter, Measurement, Noise
from .columns import Column, angle_columns, common_text, stack_columns, stack_sigmas, text_column
from .groups import Group
from .validation import validated_array, validated_joint_positions, validated_sigma

# Prior standard deviation [rad] of the rotation of the sensor and of the direction of gravity: any.
DIRECTION_PRIOR = 1.0
# Smallest sine by which an angle is divided, and smallest angle [rad] for which f' is not a series.
_MIN_SINE, _SMALL_ANGLE = 1e-12, 0.03
# The direction of gravity counts from -z if its angle to z has a smaller cosine.
_MIN_COSINE = -0.7
# Steps from each start of the search for the directions of sensor and gravity.
_N_STEPS = 20
# Multiple of the smallest misfit up to which an earlier start is taken.
_MAX_MISFIT_RATIO = 2.0
# Largest excess by rounding of an angle over its range [rad], and of a misfit.
_ROUNDING = 1e-9
# Rows and velocity components of the terms: both angles by all three angular velocities.
_TERMS = (np.repeat([0, 1], 3), np.tile([3, 4, 5], 2))
_ANGLES, _ACCELERATIONS = ("roll", "pitch"), ("ax", "ay", "az")


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Inclination(Measurement):
    """Roll and pitch of a sensor on a link, by an inclinometer or an accelerometer at rest.

    The rotation of the sensor in the link and the direction of gravity are estimated. Lengths, rotations
    about gravity, and joints and links behind the sensor are not observable.

    Attributes:
        angles: Roll and pitch, (m, 2) [rad].
        sigma: Standard deviations of the direction along roll and pitch, (m, 2) [rad].
        link: Name of the link that carries the sensor; empty for the tip of the chain.
        body: Number of the body that carries the link; 0 before the measurement has been mounted on a robot.
        link_rotation: Rotation of the link in the frame of the body, (3, 3).
        points_down: Whether the parameters of gravity are those of the downward direction.
    """

    angles: Array
    sigma: Array
    link: str
    body: int
    link_rotation: Array
    points_down: bool

    kind = "inclination"
    residual_groups: ClassVar = {"inclination": Group(slice(0, 2), "rad", "inclination error")}
    COLUMNS = (
        *angle_columns("angles", *_ANGLES),
        *(Column(name, "acceleration", "acceleration") for name in _ACCELERATIONS),
        *text_column("link", "link", is_common=True),
    )
    required_columns = (frozenset(_ANGLES), frozenset(_ACCELERATIONS))
    sample_fields = (*Measurement.sample_fields, "angles", "sigma")
    symmetry_axis = "gravity"
    simulated_instrument = "a sensor on the tip; gravity is along the z axis of the base"

    def __init__(
        self, q: ArrayLike, angles: ArrayLike, sigma: ArrayLike | None = None, link: str = ""
    ) -> None:
        """Check and store measured angles.

        Args:
            q: Joint positions, (m, n) [rad or m].
            angles: Roll and pitch, (m, 2) [rad].
            sigma: Standard deviations of the direction along roll and pitch, one number or (m, 2) [rad];
                estimated with the fit if None.
            link: Link that carries the sensor; empty for the tip of the chain.

        Raises:
            SampleError: Roll is beyond ±π, or pitch beyond ±π/2.
        """
        q = validated_joint_positions(q, "Inclination")
        angles = validated_array(angles, (len(q), 2), "Inclination: angles", "pair of angles")
        for name, values, limit in zip(_ANGLES, angles.T, (180, 90), strict=True):
            beyond = np.flatnonzero(np.abs(values) > np.deg2rad(limit) + _ROUNDING)
            if beyond.size:
                raise SampleError(
                    int(beyond[0]),
                    f"{name} is {np.rad2deg(values[beyond[0]]):.6g} deg; expected -{limit} to {limit} deg",
                )
        self._initialize(
            q=q,
            angles=angles,
            sigma=validated_sigma(ANGLE_SIGMA if sigma is None else sigma, (len(q), 2), "Inclination: sigma"),
            has_stated_sigma=sigma is not None,
            link=link,
            body=0,
            link_rotation=np.eye(3),
            points_down=False,
            instrument_parameters=_parameters(link, np.eye(3), np.array([0.0, 0.0, 1.0]))[1],
        )

    @classmethod
    def from_acceleration(
        cls, q: ArrayLike, acceleration: ArrayLike, sigma: ArrayLike | None = None, link: str = ""
    ) -> Self:
        """Return the inclinations of an accelerometer at rest.

        Args:
            q: Joint positions, (m, n) [rad or m].
            acceleration: Accelerations along x, y and z of the sensor, upwards at rest, (m, 3), in any unit.
            sigma: Standard deviations of the accelerations, one number or (m, 3), in the same unit; estimated
                with the fit if None.
            link: Link that carries the sensor; empty for the tip of the chain.

        Returns:
            Inclinations with the standard deviations of the directions.

        Raises:
            SampleError: An acceleration is zero.
        """
        q = validated_joint_positions(q, "Inclination")
        where = "Inclination: acceleration"
        a = validated_array(acceleration, (len(q), 3), where, "vector of accelerations")
        size = np.linalg.norm(a, axis=1)
        if not size.all():
            raise SampleError(int(np.argmin(size)), "the acceleration is zero; expected that of gravity")
        angles = np.stack([np.arctan2(a[:, 1], a[:, 2]), np.arctan2(-a[:, 0], np.hypot(a[:, 1], a[:, 2]))], 1)
        if sigma is None:
            return cls(q, angles, None, link)
        along = _axes(angles)[:2] * validated_sigma(sigma, (len(q), 3), "Inclination: sigma").T
        return cls(q, angles, (np.linalg.norm(along, axis=1) / size).T, link)

    @classmethod
    def _arguments(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        columns = [column for column in cls.present_columns(values) if column.is_numeric]
        names = [column.name for column in columns]
        if len(names) > 3 or set(names) not in cls.required_columns:
            raise InvalidArgumentError(
                f"columns {', '.join(names)}: expected either roll and pitch, or ax, ay and az"
            )
        return {
            columns[0].argument: stack_columns(values, names),
            "sigma": stack_sigmas(values, columns),
            "link": common_text(values["link"], "link") if "link" in values else "",
        }

    @classmethod
    def from_columns(cls, q: Any, values: Mapping[str, Any], rig: Any = None) -> Self:
        """Return the measurements of a file with angles or with accelerations."""
        arguments = cls._arguments(values)
        return (cls.from_acceleration if "acceleration" in arguments else cls)(q[0], **arguments)

    def description(self) -> list[str]:
        """Return what `repr` says besides the number of samples."""
        return [self._sigma_text((self.sigma, 180 / np.pi, "deg"))]

    @property
    def residual_dim(self) -> int:
        """Number of residuals per sample: two angles."""
        return 2

    @property
    def observed_body(self) -> int | None:
        """Number of the body that carries the sensor."""
        return self.body

    def mounted(self, chain: Chain) -> Self:
        """Return a copy that knows the body of a robot that carries the sensor."""
        body, pose = chain.link_in_body(self.link or chain.tip)
        return self.replace(body=body, link_rotation=pose[:3, :3])

    def matched_to(self, known: Mapping[str, float]) -> Self:
        """Return a copy whose direction of gravity counts from the same axis as that of a calibration."""
        if "down.x" not in known or self.points_down:
            return self
        points_down, parameters = _parameters(self.link, np.eye(3), np.array([0.0, 0.0, -1.0]))
        return self.replace(points_down=points_down, instrument_parameters=parameters)

    # ------------------------------------------------------------------------------------------- model
    @cached_property
    def _axes(self) -> Array:
        """Unit vectors e_1, e_2 and the measured direction a in the sensor, (3, 3, m)."""
        return _axes(self.angles)

    def _to_link(self, frames: FrameBatch) -> Array:
        """Return the rotations Rᵀ from the measuring frame to the link, (3, 3, m)."""
        if not self.body:
            raise InvalidArgumentError("Inclination: the link is not known; expected `mounted(chain)` before")
        return np.einsum("ji,jkm->ikm", self.link_rotation, frames.bodies[self.body, :3])

    def _model(self, frames: FrameBatch, u: Array) -> tuple[Array, Array, Array, Array]:
        """Return h (3, m), Sᵀ·Rᵀ (3, 3, m), g (3,) and its derivative by t (3, 2)."""
        tilt, axis = se3.exp3([u[3], u[4], 0.0]), np.array([0.0, 0.0, -1.0 if self.points_down else 1.0])
        to_sensor = np.einsum("ji,jkm->ikm", se3.exp3(u[:3]), self._to_link(frames))
        by_tilt = -tilt @ se3.skew(axis) @ _right_jacobian(np.array([u[3], u[4], 0.0]))[:, :2]
        up = tilt @ axis
        return np.einsum("ikm,k->im", to_sensor, up), to_sensor, up, by_tilt

    def _angle_factors(self, h: Array) -> tuple[Array, Array, Array]:
        """Return e_1·h and e_2·h (2, m), f (m,) and f' (m,)."""
        across, cosine = np.einsum("rim,im->rm", self._axes[:2], h), np.einsum("im,im->m", self._axes[2], h)
        sine = np.maximum(np.hypot(*across), _MIN_SINE)
        angle = np.arctan2(sine, cosine)
        factor, square = angle / sine, angle**2
        with np.errstate(over="ignore"):
            slope = (factor * cosine - 1) / sine**2
        series = -1 / 3 - square * (2 / 15 + 2 / 63 * square)
        return across, factor, np.where(angle < _SMALL_ANGLE, series, slope)

    def _derivative(self, h: Array) -> Array:
        """Return the derivative (2, 3, m) of the whitened model by h."""
        across, factor, slope = self._angle_factors(h)
        derivative = factor * self._axes[:2] + (slope * across)[:, None] * self._axes[2]
        return derivative / self.sigma.T[:, None]

    def residual(self, frames: FrameBatch, u: Array) -> Array:
        """Return the whitened angles (2, m) from the measured to the modelled direction."""
        across, factor, _ = self._angle_factors(self._model(frames, u)[0])
        return -factor * across / self.sigma.T

    def observation_matrix(self, frames: FrameBatch, u: Array, residual: Array) -> ObservationMatrix:
        """Return the derivatives by the angular velocities of the link."""
        h, to_sensor, up, _ = self._model(frames, u)
        by_rotation = np.einsum("ijm,jk->ikm", to_sensor, se3.skew(up))
        terms = np.einsum("rim,ikm->rkm", self._derivative(h), by_rotation)
        return ObservationMatrix(*_TERMS, terms.reshape(6, -1), self.body)

    def instrument_jacobian(self, frames: FrameBatch, u: Array) -> Array:
        """Return the derivatives (5, 2, m) of the whitened model by sensor and gravity."""
        h, to_sensor, _, by_tilt = self._model(frames, u)
        by_sensor = se3.skew(h.T) @ _right_jacobian(u[:3])
        by_gravity = np.einsum("ijm,jt->mit", to_sensor, by_tilt)
        return np.einsum("rim,mit->trm", self._derivative(h), np.concatenate([by_sensor, by_gravity], 2))

    def errors(self, frames: FrameBatch, u: Array) -> dict[str, Array]:
        """Return the angles "inclination" (m, 2) [rad]."""
        return {"inclination": self.residual(frames, u).T * self.sigma}

    def initialized(self, chain: Chain) -> Self:
        """Return a copy whose sensor and gravity have the directions that fit best.

        For a given g the best S, and for a given S the best g, have a closed form (Wahba 1965). Both
        alternate from several starts: the z axis of the base, and the singular vectors of all products.

        References:
            G. Wahba, A Least Squares Estimate of Satellite Attitude, SIAM Review 7, 1965.
        """
        item = self.mounted(chain)
        # Σ (Rᵀ)_jk·a_l: the agreement of all samples is Σ_jkl M_jkl·g_k·S_jl.
        to_link = item._to_link(chain.forward_kinematics(item.conditions()))
        products = np.einsum("jkm,lm->jkl", to_link, item._axes[2])
        singular = np.linalg.svd(products.swapaxes(0, 1).reshape(3, 9))[0].T
        up = np.concatenate([chain.base[None, :3, 2], singular, -singular])

        def best_sensors(up: Array) -> Array:
            return se3.nearest_rotation(np.einsum("jkl,nk->njl", products, up))

        for _ in range(_N_STEPS):
            up = np.einsum("jkl,njl->nk", products, best_sensors(up))
            up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), _MIN_SINE)
        sensors = best_sensors(up)
        # The first start, the base, unless another one fits clearly better.
        misfit = len(item.rows) - np.einsum("jkl,nk,njl->n", products, up, sensors)
        best = int(np.argmax(misfit <= _MAX_MISFIT_RATIO * misfit.min() + _ROUNDING))
        points_down, parameters = _parameters(self.link, sensors[best], up[best])
        return item.replace(points_down=points_down, instrument_parameters=parameters)

    def _columns_and_sigmas(self) -> tuple[dict[str, Any], dict[str, Any]]:
        values = dict(zip(_ANGLES, self.angles.T, strict=True))
        link = {"link": [self.link] * len(self.rows)} if self.link else {}
        return values | link, {f"sigma_{name}": s for name, s in zip(values, self.sigma.T, strict=True)}

    @classmethod
    def _simulate(cls, chain: Chain, conditions: Conditions, noise: Noise, rng: np.random.Generator) -> Self:
        """Return inclinations of a sensor that is turned on the tip, with normal noise of the direction."""
        q = conditions.q
        item = cls(q, np.zeros((len(q), 2)), noise.rotation or None).mounted(chain)
        to_link = item._to_link(chain.forward_kinematics(conditions))
        # Gravity is along the z axis of the base.
        up = np.einsum("ji,jkm,k->mi", se3.exp3([0.3, -0.2, 0.4]), to_link, chain.base[:3, 2])
        up += noise.rotation * rng.standard_normal(up.shape)
        return item.replace(angles=cls.from_acceleration(q, up).angles)


def _axes(angles: Array) -> Array:
    """Return the unit vectors along roll and pitch and the direction of roll and pitch (m, 2), (3, 3, m)."""
    (sin_r, sin_p), (cos_r, cos_p) = np.sin(angles.T), np.cos(angles.T)
    along_roll = [np.zeros_like(sin_r), cos_r, -sin_r]
    return np.array(
        [along_roll, [-cos_p, -sin_r * sin_p, -cos_r * sin_p], [-sin_p, sin_r * cos_p, cos_r * cos_p]]
    )


def _right_jacobian(rotvec: Array) -> Array:
    """Return the right Jacobian of SO(3) at a rotation vector, (3, 3)."""
    return np.linalg.inv(se3.right_jacobian_inverse(rotvec))


def _parameters(link: str, sensor: Array, up: Array) -> tuple[bool, tuple[InstrumentParameter, ...]]:
    """Return whether gravity counts from -z, and the parameters of sensor (3, 3) and direction up (3,)."""
    points_down = bool(up[2] < _MIN_COSINE)
    x, y, z = -up if points_down else up
    # The smallest rotation that turns z onto the direction.
    angle, across = np.arctan2(np.hypot(x, y), z), np.hypot(x, y)
    tilt = np.array([-y, x]) * (angle / across if across else 1.0)
    prefix = f"inclinometer_{link}" if link else "inclinometer"
    names = [f"{prefix}.r{axis}" for axis in "xyz"]
    names += [f"{'down' if points_down else 'up'}.{axis}" for axis in "xy"]
    values = np.concatenate([se3.log3(sensor), tilt]).tolist()
    pairs = zip(names, values, strict=True)
    return points_down, tuple(
        InstrumentParameter(name, "rad", value, DIRECTION_PRIOR) for name, value in pairs
    )
