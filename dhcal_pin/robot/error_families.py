"""Families of joint errors: everything that is known about each one, in one row of `FAMILIES`.

A family is one parameter set, such as `harmonics`. Its coefficients scale *terms*, functions of the
conditions of a sample. There are four types of coefficients, see `transmission`:

- linear: the positions of the joint itself (gain) and of the other joints (coupling);
- harmonics: sine and cosine of multiples of the position of the joint;
- joint terms: one function per joint, with one coefficient per joint;
- link terms: one function of the sample, with one coefficient per link, which changes the length of the link.

To add a family with a joint term or a link term: write a row with its function, and the same as a formula.
The 3-D page and exported models evaluate the formula, see `Term`. The name of such a family is an identifier.

Shapes: m samples, n independent joints, k moving joints, K orders of harmonics, f families of joint terms, g
families of link terms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np

from .._frozen import frozen
from .._typing import Array
from .conditions import Conditions

# Highest order of the harmonics: 64 periods per turn of a joint.
MAX_CURVE_ORDER = 64
# Smallest maximum [N·m] of the gravity torque on a compliant joint. A joint that is loaded less has no
# compliance: some URDFs have links with token masses.
MIN_TORQUE = 0.1
# Shortest link [m] that has a thermal growth.
MIN_LINK_LENGTH = 1e-3


class ArmProperties(Protocol):
    """Properties of a chain that the terms depend on; see `transmission.GravityLoads`."""

    @property
    def n_joints(self) -> int:
        """Number n of independent joints."""
        ...

    @property
    def link_vectors(self) -> Array:
        """Vectors of the links, shape (k+1, 3) [m]."""
        ...

    @property
    def reference_temperature(self) -> float:
        """Temperature at which the links have the lengths of the model [°C]."""
        ...

    def torques(self, q: Array, payload: Array | None = None) -> Array:
        """Compute the gravity torques on the joints, shape (n, m) [N·m]."""
        ...


class JointNames(Protocol):
    """Names and types of the independent joints of a chain."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        ...

    @property
    def is_prismatic(self) -> Array:
        """Whether each joint is prismatic, shape (n,)."""
        ...


class CoefficientParts(NamedTuple):
    """Vector of coefficients, or of their indices, in its parts."""

    linear: Array  # Gains on the diagonal and couplings beside it, shape (n, n)
    harmonics: Array  # Sine before cosine of each order, shape (K, 2, n)
    joint_terms: Array  # One row per family of `JOINT_TERMS`, shape (f, n)
    link_terms: Array  # One row per family of `LINK_TERMS`, shape (g, k+1)


class Coefficient(NamedTuple):
    """Coefficient of a family."""

    entry: int  # Index in the vector of coefficients
    owner: int  # Number of the joint that it moves, or of the link that it makes longer
    name: str  # Name, after that of the joint or link
    unit: str  # Unit
    formula: str  # Its term as a formula; see `Term`


@frozen
class Term:
    """Function of the conditions of a sample, and the coefficient that scales it."""

    coefficient: str  # Name of the coefficient, after the name of its joint or link
    unit: str  # Unit of the coefficient
    # The function of joint `{i}`, or that of all links, as an expression that means the same in JavaScript, C
    # and Python. It may use `sin`, `cos`, the positions `q` of all joints, their gravity torques `torque`,
    # the directions `approach`, `temperature` and `reference_temperature`. On the 3-D page joints have no
    # direction, and the links do not grow.
    formula: str
    # Function of the conditions of m samples, shape (n, m) of a joint term and (m,) of a link term, whose
    # value is the same for all links.
    evaluate: Callable[[Conditions, ArmProperties], Array]
    # Joints, shape (n,), or links, shape (k+1,), on which the term has an effect.
    has_effect: Callable[[ArmProperties], Array]
    # Derivative of the formula by the position of joint `{j}`; it may also use the derivatives `torque_by_q`
    # of the torques. It is "0" for a term that does not depend on q, as all link terms.
    derivative: str = "0"


@frozen
class SelectionRule:
    """When a calibration adds a family of joint errors by itself."""

    stage: int  # Families of the same stage are tried together, one stage after the other
    min_improvement: float  # Smallest relative improvement of the cross-validated squared error
    # Whether every arm has such errors: where others are added, the family is added as well and shrunk by its
    # priors.
    is_universal: bool = False


@frozen
class ErrorFamily:
    """Family of joint errors that users select by one name."""

    name: str  #: Name of the parameter set
    description: str  #: Physical cause, such as "gear ratio errors", for help and reports
    requirement: str  #: What a robot must have for the family to have parameters, for error messages
    rule: SelectionRule  #: When the family is added; there is no family without a rule
    prior: float  #: Standard deviation of its coefficients expected before any measurement, in their unit
    sidecar_key: str  #: Key of its coefficients in sidecar files
    #: Function that lists its linear coefficients from their indices; None for other families.
    linear: Callable[[JointNames, Array], Iterator[Coefficient]] | None = None
    orders: range = range(0)  #: Orders of its harmonics; empty for other families
    joint_term: Term | None = None  #: Term of each joint; None for other families
    link_term: Term | None = None  #: Term of the links; None for other families
    #: Condition that must be known of the samples, one of `CONDITIONS`; empty for q alone.
    condition: str = ""
    low_cost_prior: float | None = None  #: Prior of a low-cost arm; None if it is the same

    @property
    def is_curve(self) -> bool:
        """Whether the family consists of correction curves."""
        return self.orders.start >= CURVE_ORDERS.start

    def coefficients(self, arm: JointNames, indices: CoefficientParts) -> list[Coefficient]:
        """List the coefficients of the family; only gains belong to prismatic joints."""
        joints = np.flatnonzero(~arm.is_prismatic).tolist()
        if self.linear:
            return list(self.linear(arm, indices.linear))
        if term := self.joint_term:
            row = indices.joint_terms[list(JOINT_TERMS).index(self.name)].tolist()
            return [
                Coefficient(row[i], i, term.coefficient, term.unit, term.formula.format(i=i)) for i in joints
            ]
        if term := self.link_term:
            row = indices.link_terms[list(LINK_TERMS).index(self.name)].tolist()
            return [
                Coefficient(entry, j, term.coefficient, term.unit, term.formula)
                for j, entry in enumerate(row)
            ]
        numbers = indices.harmonics[: self.orders.stop - 1].tolist()
        return [
            Coefficient(numbers[k - 1][part][i], i, f"{function}{k}", "rad", f"{function}({k} * q[{i}])")
            for i in joints
            for k in self.orders
            for part, function in enumerate(("sin", "cos"))
        ]


def _gains(arm: JointNames, linear: Array) -> Iterator[Coefficient]:
    """List the gain of each joint."""
    for i, entry in enumerate(np.diag(linear).tolist()):
        yield Coefficient(entry, i, "gain", "1", f"q[{i}]")


def _couplings(arm: JointNames, linear: Array) -> Iterator[Coefficient]:
    """List the couplings of each revolute joint to all others."""
    units = ["rad/m" if is_prismatic else "rad/rad" for is_prismatic in arm.is_prismatic]
    for i in np.flatnonzero(~arm.is_prismatic).tolist():
        for j, (entry, name) in enumerate(zip(linear[i].tolist(), arm.joint_names, strict=True)):
            if i != j:
                yield Coefficient(entry, i, name, units[j], f"q[{j}]")


def _torques(conditions: Conditions, arm: ArmProperties) -> Array:
    """Return the gravity torques on the joints."""
    return arm.torques(np.ascontiguousarray(conditions.q.T), conditions.payload)


def _is_loaded(arm: ArmProperties) -> Array:
    """Return whether gravity loads each joint, in random configurations."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (arm.n_joints, 64))
    return np.abs(arm.torques(q)).max(-1) > MIN_TORQUE


def _half_direction(conditions: Conditions, arm: ArmProperties) -> Array:
    """Return half the direction of the last motion of each joint, negative because the joint lags behind."""
    if conditions.approach is None:
        return np.zeros(conditions.q.T.shape)
    return conditions.approach.T / -2


def _all_joints(arm: ArmProperties) -> Array:
    """Return that the term has an effect on all joints."""
    return np.ones(arm.n_joints, bool)


def _temperature_rise(conditions: Conditions, arm: ArmProperties) -> Array:
    """Return the difference from the reference temperature."""
    if conditions.temperature is None:
        return np.zeros(len(conditions.q))
    return conditions.temperature - arm.reference_temperature


def growing_links(link_vectors: Array) -> Array:
    """Return which links (k+1, 3) have a length that can grow, (k+1,)."""
    return np.linalg.norm(link_vectors, axis=1) > MIN_LINK_LENGTH


GAIN, COMPLIANCE, COUPLING = "gain", "compliance", "coupling"
HARMONICS, CURVES, FINE_CURVES = "harmonics", "curves", "fine-curves"
BACKLASH, THERMAL = "backlash", "thermal"

# Orders of eccentricity and its second harmonic, of correction curves, and of those of high order.
HARMONIC_ORDERS = range(1, 3)
CURVE_ORDERS, FINE_CURVE_ORDERS = range(3, 33), range(33, MAX_CURVE_ORDER + 1)

# Eccentricity and elasticity hold outside the measured region; other families have to improve the error
# noticeably. Curves are tried one after the other, on top of those of lower order.
_UNIVERSAL, _OTHER = SelectionRule(0, 0.0, is_universal=True), SelectionRule(1, 0.1)
# Backlash and thermal growth follow from a measured condition, which chance hardly imitates.
_OF_A_CONDITION = SelectionRule(0, 0.02)

# The priors are typical of industrial arms: gear ratios are off by 0.2 %; eccentricity is about 1 mrad, and a
# higher harmonic about 0.1 mrad; a joint yields by about 0.1 mrad/Nm; backlash reaches a few mrad; aluminium
# grows by 23e-6 per kelvin, steel by 12e-6. Servos of low-cost arms have a play of half a degree, and their
# plastic links and controllers yield by a degree under the weight of a stretched arm, about 1 Nm.
FAMILIES = {
    family.name: family
    for family in (
        ErrorFamily(GAIN, "gear ratio errors", "a moving joint", _OTHER, 2e-3, "gain", _gains),
        ErrorFamily(
            HARMONICS,
            "gear eccentricity",
            "a revolute joint",
            _UNIVERSAL,
            1e-3,
            "harmonics",
            orders=HARMONIC_ORDERS,
        ),
        ErrorFamily(
            CURVES,
            "joint correction curves",
            "a revolute joint",
            SelectionRule(2, 0.02),
            1e-4,
            "harmonics",
            orders=CURVE_ORDERS,
        ),
        ErrorFamily(
            FINE_CURVES,
            "joint correction curves of high order",
            "a revolute joint",
            SelectionRule(3, 0.02),
            1e-4,
            "harmonics",
            orders=FINE_CURVE_ORDERS,
        ),
        ErrorFamily(
            COMPLIANCE,
            "joint elasticity under gravity",
            "a revolute joint that gravity loads, and links with masses in the URDF",
            _UNIVERSAL,
            1e-4,
            "compliance_rad_per_nm",
            joint_term=Term(
                "compliance", "rad/Nm", "torque[{i}]", _torques, _is_loaded, "torque_by_q[{i}][{j}]"
            ),
            low_cost_prior=1e-2,
        ),
        ErrorFamily(
            COUPLING,
            "coupling between joints",
            "a revolute joint and another joint",
            _OTHER,
            2e-3,
            "coupling",
            _couplings,
        ),
        ErrorFamily(
            BACKLASH,
            "backlash of the joints",
            "a revolute joint",
            _OF_A_CONDITION,
            3e-3,
            "backlash_rad",
            joint_term=Term("backlash", "rad", "-0.5 * approach[{i}]", _half_direction, _all_joints),
            condition="approach",
            low_cost_prior=np.deg2rad(0.5),
        ),
        ErrorFamily(
            THERMAL,
            "thermal growth of the links",
            "a link with a length",
            _OF_A_CONDITION,
            2e-5,
            "per_kelvin",
            link_term=Term(
                "thermal",
                "1/K",
                "temperature - reference_temperature",
                _temperature_rise,
                lambda arm: growing_links(arm.link_vectors),
            ),
            condition="temperature",
        ),
    )
}
# Families with a term of each joint, and of the links, in the order of their coefficients.
JOINT_TERMS = {name: family.joint_term for name, family in FAMILIES.items() if family.joint_term}
LINK_TERMS = {name: family.link_term for name, family in FAMILIES.items() if family.link_term}
