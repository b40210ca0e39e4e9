"""What a joint's drive adds to its value: terms in the joint's own value and its load, as data.

The effective value of independent joint i at commanded values q is

    q_i + Σ_t Σ_j W[t, i, j] · term_t(q_j, τ_j)

with the terms of `TERMS` and the generalised forces τ that hold the arm against gravity. W (t, n, n) is
diagonal but for the term of the value itself, whose entries off the diagonal couple a joint to others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from .._typing import Array


@dataclass(frozen=True)
class TransmissionTerm:
    """One way in which a joint's value comes out wrong.

    Attributes:
        name: what users call it behind the joint's name, as `elbow_joint.sin`.
        key: its name in a sidecar.
        family: the parameter set it belongs to.
        unit: of its coefficient.
        prior: standard deviation of the coefficient expected before any measurement.
        value: from joint values and generalised forces (n, m) to the term (n, m), both in SI.
        applies_to_prismatic: whether prismatic joints have it, too.
    """

    name: str
    key: str
    family: str
    unit: str
    prior: float
    value: Callable[[Array, Array], Array]
    applies_to_prismatic: bool = False


# A drive's ratio holds to some tenths of a percent, gears run out of true by some tenths of a degree at
# most, and an arm's joint gives by some millidegrees a newton metre.
TERMS = (
    TransmissionTerm("gain", "gain", "gain", "1", 2e-3, lambda q, load: q, applies_to_prismatic=True),
    TransmissionTerm("sin", "sin_rad", "harmonics", "rad", 1e-3, lambda q, load: np.sin(q)),
    TransmissionTerm("cos", "cos_rad", "harmonics", "rad", 1e-3, lambda q, load: np.cos(q)),
    TransmissionTerm("sin2", "sin2_rad", "harmonics", "rad", 1e-3, lambda q, load: np.sin(2 * q)),
    TransmissionTerm("cos2", "cos2_rad", "harmonics", "rad", 1e-3, lambda q, load: np.cos(2 * q)),
    TransmissionTerm(
        "compliance", "compliance_rad_per_nm", "compliance", "rad/Nm", 1e-4, lambda q, load: load
    ),
)


# The term whose coefficients off the diagonal couple joints.
COUPLING_TERM = 0


FAMILIES = tuple(dict.fromkeys(term.family for term in TERMS))


COUPLING_PRIOR = 2e-3


# Sets of joint values whose torques are remembered.
MAX_CACHED_TORQUES = 256


@dataclass(frozen=True)
class Payload:
    """What a tip carries besides the masses of the URDF.

    Attributes:
        mass: kg.
        centre: of gravity in the tip frame, m.
    """

    mass: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class GravityLoads:
    """The masses that load a path's joints.

    Attributes:
        model: Pinocchio's, of the whole robot.
        moving_joints: (k,) names of the joints that move along the path.
        mimic_matrix, mimic_offset: (k, n), (k,): the moving joints' values are mixing @ q + shift.
    """

    model: pin.Model
    moving_joints: tuple[str, ...]
    mimic_matrix: Array
    mimic_offset: Array
    _cache: dict[bytes, Array] = field(default_factory=dict, repr=False)

    def configurations(self, q: Array) -> Array:
        """Pinocchio's configurations (m, nq) at values q (n, m); joints off the path stay at neutral."""
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
        """Pinocchio's generalised gravity (n, m) at values q (n, m), N·m or N; z of the root is up."""
        key = np.ascontiguousarray(q).tobytes()
        if key not in self._cache:
            data = self.model.createData()
            columns = [self.model.joints[self.model.getJointId(name)].idx_v for name in self.moving_joints]
            held = np.empty((q.shape[1], len(columns)))
            for row, configuration in zip(held, self.configurations(q), strict=True):
                row[:] = pin.computeGeneralizedGravity(self.model, data, configuration)[columns]
            if len(self._cache) >= MAX_CACHED_TORQUES:
                self._cache.clear()
            self._cache[key] = self.mimic_matrix.T @ held.T
        return self._cache[key]


@dataclass(frozen=True, eq=False)
class Transmission:
    """How a path's independent joints miss their commanded values.

    Attributes:
        coefficients: (t, n, n) W of the module's formula.
        loads: what gravity pulls at.
    """

    coefficients: Array
    loads: GravityLoads

    @classmethod
    def zero(cls, loads: GravityLoads) -> Transmission:
        """Joints that do as they are told."""
        n = loads.mimic_matrix.shape[1]
        return cls(np.zeros((len(TERMS), n, n)), loads)

    @property
    def has_compliance(self) -> bool:
        """Whether a load moves a joint."""
        return any(self.coefficients[t].any() for t, term in enumerate(TERMS) if term.family == "compliance")

    def terms(self, q: Array) -> Array:
        """All terms (t, n, m) at commanded values q (n, m)."""
        torques = self.loads.torques(q)
        return np.stack([term.value(q, torques) for term in TERMS])

    def errors(self, terms: Array) -> Array:
        """What the terms (t, n, m) add to the joints' values (n, m)."""
        return np.tensordot(self.coefficients, terms, ((0, 2), (0, 1)))

    def with_coefficients_added(self, entries: Array, changes: Array) -> Transmission:
        """With entries of the flat coefficients changed."""
        coefficients = self.coefficients.copy()
        coefficients.reshape(-1)[entries] += changes
        return replace(self, coefficients=coefficients)
