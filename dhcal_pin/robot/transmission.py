"""Joint transmission errors: from commanded to actual joint positions.

The actual position of independent joint i at commanded positions q is

    q_i + Σ_j A_ij·q_j + Σ_k (S_ki·sin(k·q_i) + C_ki·cos(k·q_i)) + c_i·τ_i(q)

with the gain A_ii, the coupling A_ij of joint i to joint j, the harmonics S_ki and C_ki of order k = 1 … K,
the compliance c_i, and the generalised gravity torque τ. All coefficients are entries of one vector:

    A row by row (n·n), then S_k (n) and C_k (n) of each order k, then c (n)

The vector has room for all orders up to `MAX_CURVE_ORDER`. Only the orders that are in use are evaluated.

The functions q, sin q, cos q, sin 2q, cos 2q, …, τ are the *terms*. The derivative of the tool pose by a
coefficient is the twist of the joint's own motion, scaled by one term. The harmonics of a joint therefore
share one Jacobian column.

Shapes: t terms, n independent joints, k moving joints (k > n only with mimic joints), m samples, c
coefficients, e selected coefficients. Arrays of joint positions are (n, m) in this module.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from .._typing import Array
from .error_families import MAX_CURVE_ORDER

# Maximum number of cached torque arrays, one per array of joint positions. A full cache is emptied.
MAX_CACHED_TORQUES = 256


@dataclass(frozen=True)
class Payload:
    """Point mass at the tip link, in addition to the masses of the URDF.

    Attributes:
        mass: Mass [kg].
        centre: Centre of gravity in the tip frame [m].
    """

    mass: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class GravityLoads:
    """Gravity torques on the independent joints of a chain.

    Attributes:
        model: Pinocchio model of the whole robot.
        moving_joints: Names of the k moving joints of the chain.
        mimic_matrix: Matrix (k, n) from independent to moving joint positions.
        mimic_offset: Constant part of the moving joint positions, shape (k,) [rad or m].
    """

    model: pin.Model
    moving_joints: tuple[str, ...]
    mimic_matrix: Array
    mimic_offset: Array
    _cache: dict[bytes, Array] = field(default_factory=dict, repr=False)

    def configurations(self, q: Array) -> Array:
        """Return Pinocchio configurations; joints that are not on the chain stay at neutral."""
        out = np.tile(pin.neutral(self.model), (q.shape[1], 1))
        for name, value in zip(
            self.moving_joints, self.mimic_matrix @ q + self.mimic_offset[:, None], strict=True
        ):
            joint = self.model.joints[self.model.getJointId(name)]
            if joint.nq == 2:
                out[:, joint.idx_q], out[:, joint.idx_q + 1] = np.cos(value), np.sin(value)
            else:
                out[:, joint.idx_q] = value
        return out

    def torques(self, q: Array) -> Array:
        """Compute the generalised gravity torques; the z axis of the root link points up."""
        key = np.ascontiguousarray(q).tobytes()
        if key not in self._cache:
            data = self.model.createData()
            columns = [self.model.joints[self.model.getJointId(name)].idx_v for name in self.moving_joints]
            torques = np.empty((q.shape[1], len(columns)))
            for row, configuration in zip(torques, self.configurations(q), strict=True):
                row[:] = pin.computeGeneralizedGravity(self.model, data, configuration)[columns]
            if len(self._cache) >= MAX_CACHED_TORQUES:
                self._cache.clear()
            self._cache[key] = self.mimic_matrix.T @ torques.T
        return self._cache[key]


@dataclass(frozen=True, eq=False)
class Transmission:
    """Transmission errors of a chain's independent joints.

    Attributes:
        coefficients: All coefficients of the formula in the module docstring, shape (c,).
        loads: Gravity torques on the joints.
        min_order: Order up to which the harmonics are evaluated even if their coefficients are zero, so that
            the derivatives by them are available.
    """

    coefficients: Array
    loads: GravityLoads
    min_order: int = 0

    @classmethod
    def zero(cls, loads: GravityLoads) -> Transmission:
        """Create a transmission without errors: all coefficients are zero."""
        return cls(np.zeros(n_coefficients(loads.mimic_matrix.shape[1])), loads)

    @property
    def linear(self) -> Array:
        """Change of each joint per unit of every joint's position, shape (n, n), as a view."""
        return self._parts[0]

    @property
    def harmonics(self) -> Array:
        """Coefficients of sine and cosine of each order, shape (K, 2, n) [rad], as a view."""
        return self._parts[1]

    @property
    def compliance(self) -> Array:
        """Change of each joint per unit of its gravity torque, shape (n,) [rad/Nm], as a view."""
        return self._parts[2]

    @property
    def has_compliance(self) -> bool:
        """Whether gravity torques change the joint positions."""
        return bool(self.compliance.any())

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array]:
        """Views of the coefficients: linear, harmonics and compliance."""
        return split_coefficients(self.coefficients, self.loads.mimic_matrix.shape[1])

    @cached_property
    def order(self) -> int:
        """Highest order of the harmonics that are evaluated; 0 for none."""
        used = np.flatnonzero(self.harmonics.any((1, 2)))
        return max(self.min_order, int(used[-1]) + 1 if used.size else 0)

    def terms(self, q: Array) -> Array:
        """Evaluate the terms q, sin q, cos q, sin 2q, cos 2q, … and τ."""
        out = np.empty((2 * self.order + 2, *q.shape))
        out[0], out[-1] = q, self.loads.torques(q)
        fill_harmonics(q, out[1:-1].reshape(self.order, 2, *q.shape))
        return out

    def errors(self, terms: Array) -> Array:
        """Compute the differences between actual and commanded joint positions."""
        n = len(self.linear)
        joints, weights = np.arange(n), np.zeros((len(terms), n, n))
        weights[0], weights[-1, joints, joints] = self.linear, self.compliance
        weights[1:-1, joints, joints] = self.harmonics[: self.order].reshape(-1, n)
        return np.tensordot(weights, terms, ((0, 2), (0, 1)))

    def locate(self, entries: Array) -> tuple[Array, Array, Array]:
        """Find the joint that each of some coefficients moves, and its term."""
        n = len(self.linear)
        rows, sources = np.divmod(entries, n)
        is_linear, is_compliance = rows < n, rows == len(self.coefficients) // n - 1
        terms = np.where(is_linear, 0, np.where(is_compliance, 2 * self.order + 1, rows - n + 1))
        return np.where(is_linear, rows, sources), terms, sources

    def evaluating(self, entries: Array) -> Transmission:
        """Return a transmission that evaluates the terms of some coefficients."""
        order = int(harmonic_orders(entries, len(self.linear)).max(initial=0))
        return self if order <= self.order else replace(self, min_order=order)

    def with_coefficients_added(self, entries: Array, changes: Array) -> Transmission:
        """Return a copy with increments added to some coefficients."""
        coefficients = self.coefficients.copy()
        coefficients[entries] += changes
        return replace(self.evaluating(entries), coefficients=coefficients)


def n_coefficients(n: int) -> int:
    """Return the number of transmission coefficients."""
    return n * (n + 2 * MAX_CURVE_ORDER + 1)


def split_coefficients(coefficients: Array, n: int) -> tuple[Array, Array, Array]:
    """Split a vector of coefficients, or of their indices, into its parts.

    Args:
        coefficients: One value per coefficient, shape (c,).
        n: Number of independent joints.

    Returns:
        Views of the linear part, shape (n, n), with gains on the diagonal and couplings beside it; of the
        harmonics, shape (K, 2, n), sine before cosine; and of the compliance, shape (n,).
    """
    rows = coefficients.reshape(-1, n)
    return rows[:n], rows[n:-1].reshape(MAX_CURVE_ORDER, 2, n), rows[-1]


def harmonic_orders(entries: Array, n: int) -> Array:
    """Return the orders of some coefficients."""
    orders = (entries // n - n) // 2 + 1
    return np.where((entries >= n * n) & (orders <= MAX_CURVE_ORDER), orders, 0)


def fill_harmonics(q: Array, out: Array) -> None:
    """Compute sines and cosines of the multiples of joint positions.

    The orders 1 and 2 are evaluated directly, the others by adding twice the angle:

        sin (k+2)q = sin kq·cos 2q + cos kq·sin 2q,    cos (k+2)q = cos kq·cos 2q - sin kq·sin 2q.

    The rounding errors grow in proportion to k.
    """
    for k, harmonic in enumerate(out[:2], 1):
        np.sin(k * q, out=harmonic[0])
        np.cos(k * q, out=harmonic[1])
    for (sine, cosine), harmonic in zip(out, out[2:], strict=False):
        double_sine, double_cosine = out[1]
        np.multiply(sine, double_cosine, out=harmonic[0])
        harmonic[0] += cosine * double_sine
        np.multiply(cosine, double_cosine, out=harmonic[1])
        harmonic[1] -= sine * double_sine
