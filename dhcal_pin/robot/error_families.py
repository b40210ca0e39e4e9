"""Families of joint errors: the parameter sets that describe how a joint misses its commanded position.

A family is one parameter set, such as `harmonics`. The formula of all of them is in `transmission`. This
module imports nothing heavy, because the help of the command line lists the families.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ErrorFamily:
    """Family of joint errors that users select by one name.

    Attributes:
        name: Name of the parameter set.
        description: Physical cause, such as "gear ratio errors", for help and reports.
        requirement: What a robot must have for the family to have parameters, for error messages.
    """

    name: str
    description: str
    requirement: str


GAIN, COMPLIANCE, COUPLING = "gain", "compliance", "coupling"
HARMONICS, CURVES, FINE_CURVES = "harmonics", "curves", "fine-curves"

FAMILIES = {
    family.name: family
    for family in (
        ErrorFamily(GAIN, "gear ratio errors", "a moving joint"),
        ErrorFamily(HARMONICS, "gear eccentricity", "a revolute joint"),
        ErrorFamily(CURVES, "joint correction curves", "a revolute joint"),
        ErrorFamily(FINE_CURVES, "joint correction curves of high order", "a revolute joint"),
        ErrorFamily(
            COMPLIANCE,
            "joint elasticity under gravity",
            "a revolute joint that gravity loads, and links with masses in the URDF",
        ),
        ErrorFamily(COUPLING, "coupling between joints", "a revolute joint and another joint"),
    )
}
