"""The columns that a measurement file can have, and the kind of measurement that they make."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

from ..exceptions import DhcalError
from ..measurements import KINDS
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..units import ANGLES, LENGTHS
from .tabular import CsvTable, require_usable_names

QUATERNION = ("qw", "qx", "qy", "qz")


ROTVEC = ("rx", "ry", "rz")


# Where a controller was told to go, and where it went with the calibrated model: for screening and for
# judging a compensation, never fitted.
COMMANDED = ("commanded_x", "commanded_y", "commanded_z")


AFTER = ("after_x", "after_y", "after_z")


_AUXILIARY = frozenset(("set", "pose_id", *COMMANDED, *AFTER))


# The second configuration of a row stands under the joints' names with this before them.
SECOND_PREFIX = "to:"


_READINGS = frozenset(name for kind in KINDS.values() for name in kind.columns) | frozenset(QUATERNION)


_KNOWN = _READINGS | _AUXILIARY


# What each column but the joints' holds: "length", "angle", "number" or "text".
_QUANTITIES: dict[str, str] = {
    **{name: what for kind in KINDS.values() for name, what in kind.columns.items()},
    **dict.fromkeys(QUATERNION, "number"),
    **dict.fromkeys(("set", "pose_id"), "text"),
    **dict.fromkeys((*COMMANDED, *AFTER), "length"),
}


def units_of(chain: Chain, name: str) -> Mapping[str, float]:
    """The units that a joint's column can have."""
    joint = chain.urdf.joint(name)
    return LENGTHS if joint.type == "prismatic" else ANGLES


def quantities(chain: Chain) -> dict[str, str]:
    """What each column that a robot's file can have holds: "length", "angle", "number" or "text"."""
    joints = {
        before + joint.name: "length" if joint.type == "prismatic" else "angle"
        for joint in chain.urdf.joints
        for before in ("", SECOND_PREFIX)
    }
    return {**_QUANTITIES, **joints}


def check_joint_names(chain: Chain) -> None:
    """Complains about joints whose names cannot head a column beside the readings."""
    require_usable_names(chain.joint_names, chain.urdf.source)
    if clash := sorted(_KNOWN & set(chain.joint_names)):
        raise DhcalError(
            f"{chain.urdf.source}: joint {clash[0]!r} has the name of a reading; rename it there"
        )


def _nearest(name: str, known: Iterable[str]) -> set[str]:
    """Those known names that a mistyped one is most like, if it is like any."""
    alike = {other: difflib.SequenceMatcher(None, name[:100], other).ratio() for other in known}
    return {other for other, ratio in alike.items() if ratio == max(0.7, *alike.values())}


def check_columns(sheet: CsvTable, chain: Chain) -> None:
    """Complains about a column that is neither a joint nor a reading."""
    names = [joint.name for joint in chain.urdf.joints]
    joints = {*names, *(SECOND_PREFIX + name for name in names)}
    for name in sheet.columns:
        if name not in _KNOWN | joints:
            near = _nearest(name, _KNOWN | joints)
            # What is there already was not meant.
            meant = sorted(near - set(sheet.columns))
            hint = (
                f"did you mean {meant[0]!r}?"
                if meant
                else f"remove it; the joints are {', '.join(chain.joint_names)}"
            )
            raise DhcalError(
                f"{sheet.source}:{sheet.header}: column {name!r} is neither a joint of this robot "
                f"nor a known reading; {hint}"
            )


def find_kind(sheet: CsvTable) -> type[Measurement]:
    """The kind with the most of its columns there, or DhcalError if a column does not go with it."""
    there = set(sheet.columns) & _READINGS
    if there & set(QUATERNION):
        there = there - set(QUATERNION) | set(ROTVEC)
    fits = [
        (len(wanted), -len(kind.columns), kind)
        for kind in KINDS.values()
        for wanted in kind.required_columns
        if wanted <= there
    ]
    where = f"{sheet.source}:{sheet.header}"
    if not fits:
        lone = f"; {', '.join(sorted(there))} alone is not enough" if there else ""
        raise DhcalError(
            f"{where}: no readings{lone}; a position needs the columns x[mm],y[mm],z[mm], "
            "a pose qw,qx,qy,qz beside them"
        )
    kind = max(fits, key=lambda fit: fit[:2])[2]
    if odd := sorted(there - set(kind.columns)):
        raise DhcalError(
            f"{where}: column {odd[0]!r} does not go with {', '.join(sorted(there & set(kind.columns)))}; "
            f"a {kind.kind} file has {', '.join(kind.columns)}"
        )
    return kind
