"""Columns of measurement files: their names, their contents, and the measurement kind that they make.

A column is a joint of the robot, a value column of a measurement kind, or an auxiliary column. The header
alone selects the kind: of all kinds whose required columns are present, the one with the most required
columns, and among those the one with the fewest columns in all. A rotation can be given as a quaternion in
place of a rotation vector.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping

from ..exceptions import FileFormatError, UnknownNameError
from ..measurements import KINDS
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..units import ANGLES, LENGTHS
from .tabular import CsvTable, require_usable_names

QUATERNION = ("qw", "qx", "qy", "qz")
ROTVEC = ("rx", "ry", "rz")
# Positions that the controller was commanded to, and positions measured again after a calibration. They serve
# the reachability check and the judgement of a compensation, and are never fitted.
COMMANDED = ("commanded_x", "commanded_y", "commanded_z")
AFTER = ("after_x", "after_y", "after_z")
# Prefix of a joint's name in the columns of the second configuration of a row.
SECOND_PREFIX = "to:"

_AUXILIARY = frozenset(("set", "pose_id", *COMMANDED, *AFTER))
_VALUE_COLUMNS = frozenset(name for kind in KINDS.values() for name in kind.columns) | frozenset(QUATERNION)
_KNOWN = _VALUE_COLUMNS | _AUXILIARY
# Content of each column other than joints: "length", "angle", "number" or "text".
_CONTENTS: dict[str, str] = {
    **{name: content for kind in KINDS.values() for name, content in kind.columns.items()},
    **dict.fromkeys(QUATERNION, "number"),
    **dict.fromkeys(("set", "pose_id"), "text"),
    **dict.fromkeys((*COMMANDED, *AFTER), "length"),
}
# Least similarity (0 to 1, `difflib`) of a suggestion to an unknown name.
_MIN_SIMILARITY = 0.7
# Longest part of an unknown name that is compared [characters]: the comparison takes quadratic time.
_MAX_COMPARED = 100


def joint_units(chain: Chain, name: str) -> Mapping[str, float]:
    """Return the units allowed in the column of a joint.

    Args:
        chain: Robot with the joint.
        name: Name of the joint.

    Returns:
        Divisor to SI units of each unit: lengths for a prismatic joint, otherwise angles.
    """
    joint = chain.urdf.joint(name)
    return LENGTHS if joint.type == "prismatic" else ANGLES


def column_contents(chain: Chain) -> dict[str, str]:
    """Return the content of each column that a measurement file of a robot can have.

    Args:
        chain: The robot.

    Returns:
        "length", "angle", "number" or "text" by column name.
    """
    joints = {
        prefix + joint.name: "length" if joint.type == "prismatic" else "angle"
        for joint in chain.urdf.joints
        for prefix in ("", SECOND_PREFIX)
    }
    return {**_CONTENTS, **joints}


def check_joint_names(chain: Chain) -> None:
    """Check that the joints of a robot can be columns beside the measured values.

    Args:
        chain: The robot.

    Raises:
        FileFormatError: A joint's name cannot be a header, or is the name of another column.
    """
    require_usable_names(chain.joint_names, chain.urdf.source)
    if clashes := sorted(_KNOWN & set(chain.joint_names)):
        raise FileFormatError(
            f"{chain.urdf.source}: joint {clashes[0]!r} has the name of a measurement column; "
            "rename the joint"
        )


def check_columns(table: CsvTable, chain: Chain) -> None:
    """Check that every column is a joint of the robot, a measured value or an auxiliary column.

    Args:
        table: Table of a measurement file.
        chain: The robot.

    Raises:
        UnknownNameError: A column is unknown; the message suggests a similar name.
    """
    names = [joint.name for joint in chain.urdf.joints]
    known = _KNOWN | {prefix + name for name in names for prefix in ("", SECOND_PREFIX)}
    for name in table.columns:
        if name in known:
            continue
        # A column that is present already cannot be the intended one.
        suggestions = sorted(_most_similar(name, known) - set(table.columns))
        remedy = (
            f"did you mean {suggestions[0]!r}?"
            if suggestions
            else f"remove it; the joints are {', '.join(chain.joint_names)}"
        )
        raise UnknownNameError(
            f"{table.header_location}: column {name!r} is neither a joint of this robot "
            f"nor a known measurement column; {remedy}"
        )


def _most_similar(name: str, known: Iterable[str]) -> set[str]:
    """Return the known names that are most similar to a misspelt one."""
    similarity = {
        other: difflib.SequenceMatcher(None, name[:_MAX_COMPARED], other).ratio() for other in known
    }
    return {
        other for other, ratio in similarity.items() if ratio == max(_MIN_SIMILARITY, *similarity.values())
    }


def find_kind(table: CsvTable) -> type[Measurement]:
    """Find the measurement kind of a file from its columns.

    Args:
        table: Table of a measurement file.

    Returns:
        Class of the kind.

    Raises:
        FileFormatError: The columns of no kind are complete, or a column does not belong to the kind.
    """
    present = set(table.columns) & _VALUE_COLUMNS
    if present & set(QUATERNION):
        present = present - set(QUATERNION) | set(ROTVEC)
    candidates = [
        (len(required), -len(kind.columns), kind)
        for kind in KINDS.values()
        for required in kind.required_columns
        if required <= present
    ]
    if not candidates:
        incomplete = f"; {', '.join(sorted(present))} alone is not enough" if present else ""
        raise FileFormatError(
            f"{table.header_location}: no measured values{incomplete}; a position needs the columns "
            "x[mm],y[mm],z[mm], a pose needs qw,qx,qy,qz in addition"
        )
    kind = max(candidates, key=lambda candidate: candidate[:2])[2]
    if unrelated := sorted(present - set(kind.columns)):
        raise FileFormatError(
            f"{table.header_location}: column {unrelated[0]!r} does not go with "
            f"{', '.join(sorted(present & set(kind.columns)))}; "
            f"a {kind.kind} file has {', '.join(kind.columns)}"
        )
    return kind
