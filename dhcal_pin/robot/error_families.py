"""Families of joint errors: the parameter sets that describe how a joint misses its commanded position.

A family is one parameter set, such as `harmonics`. The formula of all of them is in `transmission`. This
module imports nothing heavy, because the help of the command line lists the families.
"""

from __future__ import annotations

from dataclasses import dataclass

# Highest order of the harmonics: 64 periods per turn of a joint.
MAX_CURVE_ORDER = 64


@dataclass(frozen=True)
class SelectionRule:
    """When a calibration adds a family of joint errors by itself.

    Attributes:
        stage: Families of the same stage are tried together, one stage after the other. The families of stage
            0 have a physical cause in every arm and are shrunk rather than left out where others are added.
        min_improvement: Smallest relative improvement of the cross-validated squared error.
    """

    stage: int
    min_improvement: float


@dataclass(frozen=True)
class ErrorFamily:
    """Family of joint errors that users select by one name.

    Attributes:
        name: Name of the parameter set.
        description: Physical cause, such as "gear ratio errors", for help and reports.
        requirement: What a robot must have for the family to have parameters, for error messages.
        rule: When the family is added; there is no family without a rule.
        orders: Orders of the harmonics of correction curves; empty for other families.
    """

    name: str
    description: str
    requirement: str
    rule: SelectionRule
    orders: range = range(0)


GAIN, COMPLIANCE, COUPLING = "gain", "compliance", "coupling"
HARMONICS, CURVES, FINE_CURVES = "harmonics", "curves", "fine-curves"

# Orders of correction curves, and those of high order.
CURVE_ORDERS, FINE_CURVE_ORDERS = range(3, 33), range(33, MAX_CURVE_ORDER + 1)

# Eccentricity and elasticity hold outside the measured region; other families have to improve the error
# noticeably. Curves are tried one after the other, on top of those of lower order.
_PHYSICAL, _OTHER = SelectionRule(0, 0.0), SelectionRule(1, 0.1)

FAMILIES = {
    family.name: family
    for family in (
        ErrorFamily(GAIN, "gear ratio errors", "a moving joint", _OTHER),
        ErrorFamily(HARMONICS, "gear eccentricity", "a revolute joint", _PHYSICAL),
        ErrorFamily(
            CURVES, "joint correction curves", "a revolute joint", SelectionRule(2, 0.02), CURVE_ORDERS
        ),
        ErrorFamily(
            FINE_CURVES,
            "joint correction curves of high order",
            "a revolute joint",
            SelectionRule(3, 0.02),
            FINE_CURVE_ORDERS,
        ),
        ErrorFamily(
            COMPLIANCE,
            "joint elasticity under gravity",
            "a revolute joint that gravity loads, and links with masses in the URDF",
            _PHYSICAL,
        ),
        ErrorFamily(COUPLING, "coupling between joints", "a revolute joint and another joint", _OTHER),
    )
}
