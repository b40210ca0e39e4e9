"""Joint transmission errors: from commanded to actual joint positions.

The actual position of independent joint i at commanded positions q is

    q_i + Σ_t Σ_j W[t, i, j] · f_t(q_j, τ_j)

where f_t are the terms of `TERMS`, τ is the generalised gravity torque, and W is the array of coefficients,
shape (t, n, n). W[t] is diagonal except for the term f(q_j) = q_j, whose off-diagonal entries couple a joint
to the positions of other joints.

Shapes: t terms, n independent joints, k moving joints (k > n only with mimic joints), m samples. Arrays of
joint positions are (n, m) in this module.

To add a term, add one row to `TERMS`. Parameters, sidecar keys, and the formula in the 3-D viewer follow from
it. A new family also needs one row in `error_families.FAMILIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from .._typing import Array


@dataclass(frozen=True)
class TransmissionTerm:
    """One term of a joint's transmission error.

    Attributes:
        name: Suffix of the parameter name, as in `elbow_joint.sin`.
        key: Key in the sidecar file.
        family: Name of its family in `error_families.FAMILIES`.
        unit: Unit of the coefficient.
        prior: Standard deviation of the coefficient before any measurement.
        value: Function from joint positions and gravity torques, both (n, m) in SI units, to the term (n, m).
        javascript: The same function as a JavaScript expression in `q` and `torque`, for the 3-D viewer.
        applies_to_prismatic: Whether prismatic joints have the term as well.
        depends_on_load: Whether the term depends on the gravity torque.
    """

    name: str
    key: str
    family: str
    unit: str
    prior: float
    value: Callable[[Array, Array], Array]
    javascript: str
    applies_to_prismatic: bool = False
    depends_on_load: bool = False


# The priors are typical of industrial arms: gear ratios are off by 0.2 %, eccentricity is about 1 mrad, and
# a joint yields by about 0.1 mrad/Nm.
TERMS = (
    TransmissionTerm("gain", "gain", "gain", "1", 2e-3, lambda q, load: q, "q", applies_to_prismatic=True),
    TransmissionTerm("sin", "sin_rad", "harmonics", "rad", 1e-3, lambda q, load: np.sin(q), "Math.sin(q)"),
    TransmissionTerm("cos", "cos_rad", "harmonics", "rad", 1e-3, lambda q, load: np.cos(q), "Math.cos(q)"),
    TransmissionTerm(
        "sin2", "sin2_rad", "harmonics", "rad", 1e-3, lambda q, load: np.sin(2 * q), "Math.sin(2 * q)"
    ),
    TransmissionTerm(
        "cos2", "cos2_rad", "harmonics", "rad", 1e-3, lambda q, load: np.cos(2 * q), "Math.cos(2 * q)"
    ),
    TransmissionTerm(
        "compliance",
        "compliance_rad_per_nm",
        "compliance",
        "rad/Nm",
        1e-4,
        lambda q, load: load,
        "torque",
        depends_on_load=True,
    ),
)

# Families of diagonal terms, in the order of `TERMS`; all of `FAMILIES` but the last one, coupling.
TERM_FAMILIES = tuple(dict.fromkeys(term.family for term in TERMS))

# Index of the term whose off-diagonal coefficients couple joints: the joint position itself.
COUPLING_TERM = 0

# Standard deviation of a coupling coefficient before any measurement [rad/rad or rad/m].
COUPLING_PRIOR = 2e-3

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
        """Return Pinocchio configurations; joints that are not on the chain stay at neutral.

        Args:
            q: Actual joint positions, shape (n, m) [rad or m].

        Returns:
            Configurations of the whole model, shape (m, nq).
        """
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
        """Compute the generalised gravity torques; the z axis of the root link points up.

        Args:
            q: Joint positions, shape (n, m) [rad or m].

        Returns:
            Torques or forces of the independent joints, shape (n, m) [N·m or N].
        """
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
        coefficients: Coefficients W of the formula in the module docstring, shape (t, n, n).
        loads: Gravity torques on the joints.
    """

    coefficients: Array
    loads: GravityLoads

    @classmethod
    def zero(cls, loads: GravityLoads) -> Transmission:
        """Create a transmission without errors: all coefficients are zero.

        Args:
            loads: Gravity torques on the joints.

        Returns:
            Transmission for which actual and commanded positions agree.
        """
        n = loads.mimic_matrix.shape[1]
        return cls(np.zeros((len(TERMS), n, n)), loads)

    @property
    def has_compliance(self) -> bool:
        """Whether gravity torques change the joint positions."""
        return any(self.coefficients[t].any() for t, term in enumerate(TERMS) if term.depends_on_load)

    def terms(self, q: Array) -> Array:
        """Evaluate all terms.

        Args:
            q: Commanded joint positions, shape (n, m) [rad or m].

        Returns:
            Values of the terms, shape (t, n, m).
        """
        torques = self.loads.torques(q)
        return np.stack([term.value(q, torques) for term in TERMS])

    def errors(self, terms: Array) -> Array:
        """Compute the differences between actual and commanded joint positions.

        Args:
            terms: Values of the terms, shape (t, n, m).

        Returns:
            Joint errors, shape (n, m) [rad or m].
        """
        return np.tensordot(self.coefficients, terms, ((0, 2), (0, 1)))

    def with_coefficients_added(self, entries: Array, changes: Array) -> Transmission:
        """Return a copy with increments added to some coefficients.

        Args:
            entries: Indices into the flattened coefficients, shape (e,).
            changes: Increments, shape (e,).

        Returns:
            Transmission with the sums as coefficients.
        """
        coefficients = self.coefficients.copy()
        coefficients.reshape(-1)[entries] += changes
        return replace(self, coefficients=coefficients)
