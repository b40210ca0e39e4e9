"""Joint transmission errors: from commanded to actual joint positions, and the growth of links.

The actual position of independent joint i at commanded positions q is

    q_i + Σ_j A_ij·q_j + Σ_k (S_ki·sin(k·q_i) + C_ki·cos(k·q_i)) + Σ_f c_fi·t_fi

with the gain A_ii, the coupling A_ij of joint i to joint j, the harmonics S_ki and C_ki of order k = 1 … K,
and the coefficients c_fi of the joint terms t_f of `error_families`: the generalised gravity torque τ_i for
compliance, and -s_i/2 for backlash, where s_i is the direction of the last motion. A link term g, such as the
temperature rise, makes link j longer by the factor 1 + α_j·g; its growth moves everything behind it along the
link. All coefficients are entries of one vector:

    A row by row (n·n), then S_k (n) and C_k (n) of each order k, then c_f (n) of each joint term,
    then α (k+1) of each link term

The vector has room for all orders up to `MAX_CURVE_ORDER`. Only the orders that are in use are evaluated.

The functions q, sin q, cos q, sin 2q, cos 2q, …, t_f, g are the *terms*. The derivative of the tool pose by a
coefficient is the twist of one *motion*, of a joint or of the growth of a link, scaled by one term. The
harmonics of a joint therefore share one Jacobian column.

Shapes: t terms, n independent joints, k moving joints (k > n only with mimic joints), m samples, c
coefficients, e selected coefficients. Arrays of joint positions are (n, m) in this module.
"""

from __future__ import annotations

import threading
from dataclasses import field, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from .._frozen import frozen
from .._typing import Array
from .conditions import Conditions
from .error_families import COMPLIANCE, JOINT_TERMS, LINK_TERMS, MAX_CURVE_ORDER, CoefficientParts

# Maximum number of cached torque arrays, one per array of joint positions. A full cache is emptied.
MAX_CACHED_TORQUES = 256

# Number of arrays of terms that each thread keeps: those of all samples, of parts of them and of random
# configurations are needed in turn.
_MAX_CACHED_TERMS = 6


@frozen(eq=False)
class _EvaluatedTerms:
    """Terms, with what they depend on."""

    loads: GravityLoads
    order: int
    conditions: Conditions
    terms: Array


class _LastTerms(threading.local):
    """Terms that a thread used last, the latest one first."""

    def __init__(self) -> None:
        self.evaluated: list[_EvaluatedTerms] = []


_last_terms = _LastTerms()


@frozen
class Payload:
    """Point mass at the tip link, in addition to the masses of the URDF.

    Attributes:
        mass: Mass [kg].
        centre: Centre of gravity in the tip frame [m].
    """

    mass: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


@frozen(eq=False)
class GravityLoads:
    """What joint errors need of a chain: gravity torques on its joints, and its link vectors."""

    model: pin.Model  #: Pinocchio model of the whole robot
    moving_joints: tuple[str, ...]  #: Names of the k moving joints of the chain
    mimic_matrix: Array  #: Matrix (k, n) from independent to moving joint positions
    mimic_offset: Array  #: Constant part of the moving joint positions, shape (k,) [rad or m]
    #: Vector from each joint to the next one, in the axes of the next one before its motion, shape (k+1, 3)
    #: [m]. The first one begins at the base link. The last one ends at the tip and is in the axes of the last
    #: joint.
    link_vectors: Array
    reference_temperature: float  #: Temperature at which the links have the lengths of the model [°C]
    tip: str  #: Name of the link that carries the payload
    payload: Payload | None  #: Payload that the model contains; None without
    _cache: dict[bytes, Array] = field(default_factory=dict, repr=False)

    @property
    def n_joints(self) -> int:
        """Number n of independent joints."""
        return self.mimic_matrix.shape[1]

    @cached_property
    def _with_one_kilogram(self) -> pin.Model:
        """Model whose payload is heavier by 1 kg."""
        model = self.model.copy()
        tip = model.frames[model.getFrameId(self.tip, pin.FrameType.BODY)]
        centre = np.array(self.payload.centre if self.payload else (0.0, 0.0, 0.0))
        inertia = pin.Inertia(1.0, centre, np.zeros((3, 3)))
        model.appendBodyToJoint(tip.parentJoint, inertia, tip.placement)
        return model

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

    def torques(self, q: Array, payload: Array | None = None) -> Array:
        """Compute the generalised gravity torques; the z axis of the root link points up."""
        # A payload (m,) [kg] replaces the mass of the payload in the model.
        torques = self._torques(self.model, b"", q)
        if payload is None:
            return torques
        added = payload - (self.payload.mass if self.payload else 0.0)
        return torques + added * self.torques_per_kilogram(q)

    def torques_per_kilogram(self, q: Array) -> Array:
        """Compute the gravity torques per kilogram of the payload, (n, m) [N·m/kg]."""
        return self._torques(self._with_one_kilogram, b"+1 kg", q) - self._torques(self.model, b"", q)

    def _torques(self, model: pin.Model, prefix: bytes, q: Array) -> Array:
        """Compute the generalised gravity torques of a model, (n, m)."""
        key = prefix + np.ascontiguousarray(q).tobytes()
        if key not in self._cache:
            data = model.createData()
            columns = [model.joints[model.getJointId(name)].idx_v for name in self.moving_joints]
            rows = [pin.computeGeneralizedGravity(model, data, each) for each in self.configurations(q)]
            torques = np.array(rows).reshape(-1, model.nv)[:, columns]
            if len(self._cache) >= MAX_CACHED_TORQUES:
                self._cache.clear()
            self._cache[key] = self.mimic_matrix.T @ torques.T
        return self._cache[key]


@frozen(eq=False)
class Transmission:
    """Transmission errors of a chain's independent joints."""

    coefficients: Array  #: All coefficients of the formula in the module docstring, shape (c,)
    loads: GravityLoads  #: Gravity torques on the joints
    #: Order up to which the harmonics are evaluated even if their coefficients are zero, so that the
    #: derivatives by them are available.
    min_order: int = 0

    @classmethod
    def zero(cls, loads: GravityLoads) -> Transmission:
        """Create a transmission without errors: all coefficients are zero."""
        return cls(np.zeros(n_coefficients(*loads.mimic_matrix.shape)), loads)

    @property
    def linear(self) -> Array:
        """Change of each joint per unit of every joint's position, shape (n, n), as a view."""
        return self._parts.linear

    @property
    def harmonics(self) -> Array:
        """Coefficients of sine and cosine of each order, shape (K, 2, n) [rad], as a view."""
        return self._parts.harmonics

    @property
    def joint_terms(self) -> Array:
        """Coefficients of the joint terms, one row per family of `JOINT_TERMS`, shape (f, n), as a view."""
        return self._parts.joint_terms

    @property
    def link_terms(self) -> Array:
        """Coefficients of the link terms, one row per family of `LINK_TERMS`, shape (g, k+1), as a view."""
        return self._parts.link_terms

    @property
    def compliance(self) -> Array:
        """Change of each joint per unit of its gravity torque, shape (n,) [rad/Nm], as a view."""
        return self.joint_terms[list(JOINT_TERMS).index(COMPLIANCE)]

    @property
    def has_compliance(self) -> bool:
        """Whether gravity torques change the joint positions."""
        return bool(self.compliance.any())

    @cached_property
    def is_zero(self) -> bool:
        """Whether all coefficients are zero."""
        return not self.coefficients.any()

    @cached_property
    def _parts(self) -> CoefficientParts:
        """Views of the coefficients."""
        return split_coefficients(self.coefficients, self.loads.n_joints)

    @cached_property
    def order(self) -> int:
        """Highest order of the harmonics that are evaluated; 0 for none."""
        used = np.flatnonzero(self.harmonics.any((1, 2)))
        return max(self.min_order, int(used[-1]) + 1 if used.size else 0)

    @cached_property
    def _n_joint_terms(self) -> int:
        """Number of joint terms up to the last one with a coefficient that is not zero."""
        return int(np.flatnonzero(self.joint_terms.any(1)).max(initial=-1)) + 1

    def terms(self, conditions: Conditions) -> Array:
        """Evaluate the terms q, sin q, cos q, sin 2q, cos 2q, …, the joint terms and the link terms."""
        # They do not depend on the coefficients. Each thread keeps those that it used last.
        last, of_joints = _last_terms.evaluated, conditions.of_joints
        for i, one in enumerate(last):
            if one.loads is self.loads and one.order == self.order and one.conditions.equals(of_joints):
                found = last.pop(i)
                break
        else:
            found = _EvaluatedTerms(self.loads, self.order, of_joints.copy(), self._terms(conditions))
        last[:] = [found, *last[: _MAX_CACHED_TERMS - 1]]
        return found.terms

    def _terms(self, conditions: Conditions) -> Array:
        """Evaluate the terms."""
        q = np.ascontiguousarray(conditions.q.T)
        first = 2 * self.order + 1
        out = np.empty((first + len(JOINT_TERMS) + len(LINK_TERMS), *q.shape))
        out[0] = q
        fill_harmonics(q, out[1:first].reshape(self.order, 2, *q.shape))
        for row, term in zip(out[first:], (*JOINT_TERMS.values(), *LINK_TERMS.values()), strict=True):
            row[:] = term.evaluate(conditions, self.loads)
        out.flags.writeable = False
        return out

    def errors(self, terms: Array) -> Array:
        """Compute the differences between actual and commanded joint positions."""
        n, used = len(self.linear), self.joint_terms[: self._n_joint_terms]
        terms = terms[: 2 * self.order + 1 + len(used)]
        joints, weights = np.arange(n), np.zeros((len(terms), n, n))
        weights[0] = self.linear
        weights[1 : len(terms) - len(used), joints, joints] = self.harmonics[: self.order].reshape(-1, n)
        weights[len(terms) - len(used) :, joints, joints] = used
        return np.tensordot(weights, terms, ((0, 2), (0, 1)))

    def growth(self, terms: Array) -> Array:
        """Compute the relative growth of each link, shape (k+1, m)."""
        return np.tensordot(self.link_terms, terms[-len(LINK_TERMS) :, 0], (0, 0))

    def locate(self, entries: Array) -> tuple[Array, Array, Array]:
        """Find the motion of each of some coefficients (e,), its term and the joint of the term."""
        # Motions 0 to n-1 are those of the joints; those of the growth of links follow.
        n, n_links = len(self.linear), self.link_terms.shape[1]
        first_link_term = len(self.coefficients) - self.link_terms.size
        rows, sources = np.divmod(entries, n)
        families, links = np.divmod(entries - first_link_term, n_links)
        n_waves, is_link = 2 * self.order, entries >= first_link_term
        terms = np.select(
            [rows < n, rows < n + 2 * MAX_CURVE_ORDER, ~is_link],
            [0, rows - n + 1, rows - n - 2 * MAX_CURVE_ORDER + 1 + n_waves],
            1 + n_waves + len(JOINT_TERMS) + families,
        )
        motions = np.where(is_link, n + links, np.where(rows < n, rows, sources))
        return motions, terms, np.where(is_link, 0, sources)

    def evaluating(self, entries: Array) -> Transmission:
        """Return a transmission that evaluates the terms of some coefficients."""
        order = int(harmonic_orders(entries, len(self.linear)).max(initial=0))
        return self if order <= self.order else replace(self, min_order=order)

    def with_zeros_moved(self, summands: Array) -> Transmission:
        """Return the same errors as functions of joint positions q' = q + d, but for the constant -A·d."""
        # S·sin(k·q) + C·cos(k·q) becomes a sum of sine and cosine of k·q' with S' = S·cos(k·d) + C·sin(k·d)
        # and C' = C·cos(k·d) - S·sin(k·d).
        moved = replace(self, coefficients=self.coefficients.copy())
        (sine, cosine), n_orders = self.harmonics.swapaxes(0, 1), len(self.harmonics)
        phase = np.arange(1, n_orders + 1)[:, None] * summands
        moved.harmonics[:, 0] = sine * np.cos(phase) + cosine * np.sin(phase)
        moved.harmonics[:, 1] = cosine * np.cos(phase) - sine * np.sin(phase)
        return moved

    def with_coefficients_added(self, entries: Array, changes: Array) -> Transmission:
        """Return a copy with increments added to some coefficients."""
        coefficients = self.coefficients.copy()
        coefficients[entries] += changes
        return replace(self.evaluating(entries), coefficients=coefficients)


def n_coefficients(k: int, n: int) -> int:
    """Return the number of coefficients of a chain of k moving and n independent joints."""
    return n * (n + 2 * MAX_CURVE_ORDER + len(JOINT_TERMS)) + (k + 1) * len(LINK_TERMS)


def coefficient_indices(k: int, n: int) -> CoefficientParts:
    """Return the indices of the coefficients of a chain of k moving and n independent joints."""
    return split_coefficients(np.arange(n_coefficients(k, n)), n)


def split_coefficients(coefficients: Array, n: int) -> CoefficientParts:
    """Return views of the parts of a vector of coefficients (c,), or of their indices, of n joints."""
    n_harmonics, n_rows = 2 * MAX_CURVE_ORDER, n + 2 * MAX_CURVE_ORDER + len(JOINT_TERMS)
    rows, link_terms = coefficients[: n * n_rows].reshape(n_rows, n), coefficients[n * n_rows :]
    harmonics, joint_terms = rows[n : n + n_harmonics], rows[n + n_harmonics :]
    waves, growth = harmonics.reshape(MAX_CURVE_ORDER, 2, n), link_terms.reshape(len(LINK_TERMS), -1)
    return CoefficientParts(rows[:n], waves, joint_terms, growth)


def harmonic_orders(entries: Array, n: int) -> Array:
    """Return the orders of some coefficients."""
    orders = (entries // n - n) // 2 + 1
    return np.where((entries >= n * n) & (orders <= MAX_CURVE_ORDER), orders, 0)


def fill_harmonics(q: Array, out: Array) -> None:
    """Compute sines and cosines of the multiples of joint positions."""
    # The orders above 2 follow from sin (k+2)q = sin kq·cos 2q + cos kq·sin 2q, and the same for the cosine.
    # The rounding errors grow in proportion to k.
    for k, harmonic in enumerate(out[:2], 1):
        np.sin(k * q, out=harmonic[0])
        np.cos(k * q, out=harmonic[1])
    for (sine, cosine), harmonic in zip(out, out[2:], strict=False):
        double_sine, double_cosine = out[1]
        np.multiply(sine, double_cosine, out=harmonic[0])
        harmonic[0] += cosine * double_sine
        np.multiply(cosine, double_cosine, out=harmonic[1])
        harmonic[1] -= sine * double_sine
