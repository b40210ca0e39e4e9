"""Columns of measurement files: their names, their contents, and the measurement kind that they make.

A column is a joint of the robot, a value column of a measurement kind, or an auxiliary column. The header
alone selects the kind: of all kinds whose required columns are present, the one with the most required
columns, and among those the one with the fewest columns in all. A rotation can be given as a quaternion in
place of a rotation vector. Image coordinates may have the columns of a pose in place of those of the joints.

A column that names a joint belongs to the joint. Joints cannot have the names of columns that a measurement
kind needs in any case, and no names that start with the prefix of the second configuration of a row.

The conditions of the samples may stand beside them: `time[s]`, `temperature[degC]`, `payload[kg]` and the
direction of the last motion of a joint, `approach_JOINT`. A joint of such a name comes first.

Other columns are ignored if they cannot be meant as a joint or a measured value: times, counters, texts that
do not go with the measured values, and quantities other than lengths and angles. Any other unknown column is
an error, as it may be misspelt.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Set
from dataclasses import replace

import numpy as np

from ..._typing import Array
from ...exceptions import FileFormatError, UnknownNameError
from ...measurements import KINDS
from ...measurements.base import Measurement
from ...messages import quote
from ...robot.chain import Chain
from ...robot.conditions import CONDITIONS
from ...units import ANGLES, LENGTHS, UNITS, column_header
from ..tables import Column, DataTable
from ..tabular import require_usable_names

# Comment that declares that the rows of a file are in the order of measurement.
IN_ORDER = "rows: in order"
QUATERNION = ("qw", "qx", "qy", "qz")
ROTVEC = ("rx", "ry", "rz")
# Positions that the controller was commanded to, and positions measured again after a calibration. They serve
# the reachability check and the judgement of a compensation, and are never fitted.
COMMANDED = ("commanded_x", "commanded_y", "commanded_z")
AFTER = ("after_x", "after_y", "after_z")
# Pose of the tip, which image coordinates may have in place of the values of all joints.
TOOL_POSE = ("x", "y", "z", *ROTVEC)
# Columns of Kawasaki's angles. Beside other columns than X, Y and Z these letters can mean anything.
KAWASAKI = ("o", "a", "t")
# Axes and frame of Euler angles by their columns: A, B, C of KUKA; angles about fixed axes, W, P, R of FANUC.
EULER_NOTATIONS: Mapping[tuple[str, ...], tuple[str, str]] = {
    ("a", "b", "c"): ("ZYX", "intrinsic"),
    ("roll", "pitch", "yaw"): ("XYZ", "extrinsic"),
    ("w", "p", "r"): ("XYZ", "extrinsic"),
    KAWASAKI: ("ZYZ", "intrinsic"),
}
# Prefix of a joint's name in the columns of the second configuration of a row.
SECOND_PREFIX = "to:"

# Point and cycle of a test according to ISO 9283, such as P1:12.
ISO_POINT = "iso_point"

# Columns for people only, some of which a kind uses for its messages; others are ignored without a note.
_REMARKS = frozenset(
    name for kind in KINDS.values() for name, content in kind.columns.items() if content == "remark"
) | {"pose_id", "time", ISO_POINT}
AUXILIARY_COLUMNS = frozenset(("set", *_REMARKS, *COMMANDED, *AFTER))
VALUE_COLUMNS = (
    frozenset((*(name for kind in KINDS.values() for name in kind.columns), *QUATERNION)) - _REMARKS
)
_KNOWN = VALUE_COLUMNS | AUXILIARY_COLUMNS
# Columns that may be those of joints: only kinds that can be written in several ways have them.
AMBIGUOUS_COLUMNS = VALUE_COLUMNS.difference(
    QUATERNION, *(kind.columns for kind in KINDS.values() if len(kind.required_columns) == 1)
)
# Content of each column other than joints: "length", "angle", "number" or "text".
_CONTENTS: dict[str, str] = {
    **{name: content for kind in KINDS.values() for name, content in kind.columns.items()},
    **dict.fromkeys(QUATERNION, "number"),
    **dict.fromkeys(("set", *_REMARKS), "text"),
    **dict.fromkeys((*COMMANDED, *AFTER), "length"),
}
# Contents of measured values with a unit.
_MEASURED_CONTENTS = ("length", "angle", "pixel", "acceleration")
# Names of times and counters in the files of other programs.
_TIME_OR_COUNTER = re.compile(
    r".*(?:time|stamp|date|datum|zeit).*|t|no\.?|nr\.?|#|i|id|idx|index|row|line|sample|seq|unnamed.*",
    re.IGNORECASE,
)
# Least similarity (0 to 1, `difflib`) of a suggestion to an unknown name.
_MIN_SIMILARITY = 0.7
# Longest part of an unknown name that is compared [characters]: the comparison takes quadratic time.
_MAX_COMPARED = 100


def joint_units(chain: Chain, name: str) -> Mapping[str, float]:
    """Return the units allowed in the column of a joint."""
    joint = chain.urdf.joint(name)
    return LENGTHS if joint.type == "prismatic" else ANGLES


def joint_column_names(names: Iterable[str]) -> list[str]:
    """Return the columns of joints in the first and in the second configuration of a row."""
    names = list(names)
    return [prefix + name for prefix in ("", SECOND_PREFIX) for name in names]


def column_contents(chain: Chain) -> dict[str, str]:
    """Return the content of each column that a measurement file of a robot can have."""
    joints = {
        name: "length" if joint.type == "prismatic" else "angle"
        for joint in chain.urdf.joints
        for name in joint_column_names([joint.name])
    }
    return {**condition_contents(chain), **_CONTENTS, **joints}


def condition_contents(chain: Chain) -> dict[str, str]:
    """Return the quantity of each column of a condition; a time without a unit is a text for people."""
    return {
        column: CONDITIONS[name].quantity
        for name, columns in condition_columns(chain).items()
        for column in columns
    }


def check_joint_names(chain: Chain) -> None:
    """Check that the joints of a robot can be columns beside the measured values."""
    require_usable_names(chain.joint_names, chain.urdf.source)
    if clashes := sorted((_KNOWN - AMBIGUOUS_COLUMNS) & set(chain.joint_names)):
        raise FileFormatError(
            f"{chain.urdf.source}: joint {clashes[0]!r} has the name of a measurement column; "
            "rename the joint"
        )
    if prefixed := [name for name in chain.joint_names if name.startswith(SECOND_PREFIX)]:
        raise FileFormatError(
            f"{chain.urdf.source}: joint {quote(prefixed[0])} starts with {SECOND_PREFIX!r}, which heads the "
            "columns of the second configuration of a row; rename the joint"
        )


def condition_columns(chain: Chain) -> dict[str, list[str]]:
    """Return the names of the columns of each condition: one, or one per joint."""
    joints = {joint.name for joint in chain.urdf.joints}
    columns = {
        condition.name: [f"{condition.name}_{joint}" for joint in chain.joint_names]
        if condition.is_per_joint
        else [condition.name]
        for condition in CONDITIONS.values()
    }
    return {name: names for name, names in columns.items() if not joints.intersection(names)}


def is_condition(name: str, chain: Chain | None) -> bool:
    """Return whether a column states a condition of the samples, of any joint if the robot is not known."""
    if chain is not None:
        return any(name in columns for columns in condition_columns(chain).values())
    return name in CONDITIONS or any(
        condition.is_per_joint and name.startswith(f"{condition.name}_") for condition in CONDITIONS.values()
    )


def with_known_spelling(table: DataTable, chain: Chain | None) -> DataTable:
    """Return a table in which names with a unit are spelt as known ones, such as `x[mm]` for `X[mm]`."""
    try:
        columns = table.columns
    except FileFormatError:  # reported where the columns are used
        return table
    contents = _CONTENTS if chain is None else column_contents(chain)
    spellings: dict[str, list[str]] = {}
    for name, content in contents.items():
        if content in _MEASURED_CONTENTS:
            spellings.setdefault(name.lower(), []).append(name)
    headers = list(table.headers)
    names = [name.lower() for name in columns]
    for name, column in columns.items():
        known = spellings.get(name.lower(), [])
        is_only = len(known) == names.count(name.lower()) == 1
        if is_only and name != known[0] and column.unit in UNITS[contents[known[0]]]:
            headers[column.index] = column_header(known[0], column.unit)
    if headers == [*table.headers]:
        return table
    return replace(table, headers=tuple(headers), file_headers=table.written_headers)


def is_in_order(table: DataTable) -> bool:
    """Return whether a comment declares that the rows of a table are in the order of measurement."""
    return any(text.strip().lower() == IN_ORDER for text in table.comments)


def describe_conditions() -> str:
    """Return the columns of all conditions, for messages."""
    return ", ".join(condition.header for condition in CONDITIONS.values())


def known_columns(chain: Chain) -> frozenset[str]:
    """Return the names of all columns that a measurement file of a robot can have."""
    names = [joint.name for joint in chain.urdf.joints]
    conditions = [name for columns in condition_columns(chain).values() for name in columns]
    return _KNOWN.union(joint_column_names(names), conditions)


def value_table(table: DataTable, chain: Chain) -> DataTable:
    """Return a table without the columns that belong to joints, see the module."""
    joints = {joint.name for joint in chain.urdf.joints} & AMBIGUOUS_COLUMNS
    names = [header.partition("[")[0].strip() for header in table.headers]
    for name in sorted(name for name in joints if names.count(name) > 1):
        ways = [
            kind.required_columns for kind in KINDS.values() if name in set().union(*kind.required_columns)
        ]
        other = [",".join(sorted(way)) for each in ways for way in each if name not in way]
        raise FileFormatError(
            f"{table.header_location}: column {name!r} appears twice, and is the joint {name!r}; "
            f"{f'write the measured values as {other[0]}, or ' if other else ''}rename the joint"
        )
    return table.without_columns(joints)


def joints_off_the_chain(chain: Chain) -> list[str]:
    """Return the names of the joints of the URDF whose values do not change the pose of the tip."""
    used = {*chain.joint_names, *chain.moving_joints}
    return [joint.name for joint in chain.urdf.joints if joint.name not in used]


def needs_column_map(table: DataTable, chain: Chain) -> bool:
    """Return whether a file has no header, one that names no joint or no measured value, or Euler angles."""
    if table.has_numbers_as_header or has_titles(table, chain):
        return True
    values = value_table(table, chain)
    if has_tool_poses(values):
        return False
    names = set(table.columns)
    joints = {*joint_column_names(chain.joint_names)}
    if euler_columns(table, chain):
        return True
    # A map cannot describe a file with too few unknown columns.
    n_unknown = len(names - known_columns(chain))
    if set(values.columns) & VALUE_COLUMNS:
        return not names & joints and n_unknown >= chain.n_joints
    return n_unknown >= (1 if names & joints else chain.n_joints)


def has_titles(table: DataTable, chain: Chain | None) -> bool:
    """Return whether the header seems to be below lines of titles, as the first line has no known name."""
    names = {header.partition("[")[0].strip() for header in table.headers}
    known = _KNOWN if chain is None else known_columns(chain)
    return table.read_below_titles is not None and not names & known


def euler_columns(table: DataTable, chain: Chain) -> list[str]:
    """Return the names of Euler angles beside the joints of a robot and x, y and z; empty without them."""
    columns = {name.lower(): name for name in table.columns if name not in chain.joint_names}
    if not {*chain.joint_names, "x", "y", "z"} <= table.columns.keys():
        return []
    known = known_columns(chain)
    found = [[columns[key] for key in keys] for keys in EULER_NOTATIONS if columns.keys() >= set(keys)]
    return next((names for names in found if not known.issuperset(names)), [])


def check_columns(table: DataTable, chain: Chain) -> list[str]:
    """Check that every column is a joint of the robot, a measured value, or can be ignored."""
    known = known_columns(chain)
    columns = table.columns
    _check_condition_names(table, chain)
    for name, column in columns.items():
        if name not in known and not _can_be_ignored(table, column, known):
            raise unknown_column_error(table.header_location, name, known, columns, chain.joint_names)
    used_names = known.difference(joint_column_names(joints_off_the_chain(chain)))
    used = {columns[name].index for name in columns if name in used_names}
    return [
        table.column_label(index)
        for index, cell in enumerate(table.headers)
        if index not in used and (cell or any(row[index].strip() for row in table.cells))
    ]


def _check_condition_names(table: DataTable, chain: Chain) -> None:
    """Check that the columns of conditions of single joints end with the names of joints."""
    known = known_columns(chain)
    for condition in CONDITIONS.values():
        for name in table.columns:
            if condition.is_per_joint and name.startswith(f"{condition.name}_") and name not in known:
                raise UnknownNameError(
                    f"{table.header_location}: column {name!r} is not a condition; the conditions are "
                    f"{describe_conditions()}, and the joints {', '.join(chain.joint_names)}"
                )


def _can_be_ignored(table: DataTable, column: Column, known: Iterable[str]) -> bool:
    """Return whether an unknown column cannot be meant as a joint or a measured value."""
    if _TIME_OR_COUNTER.fullmatch(column.name):
        return True
    suggestions = _suggestions(column.name, known, table.columns)
    if column.unit in {*LENGTHS, *ANGLES}:
        return False
    if column.unit:
        return not suggestions
    values = table.values(column.index)
    is_text = not all(
        is_number or not cells[column.index].strip()
        for is_number, cells in zip(np.isfinite(values), table.cells, strict=True)
    )
    if not is_text and not counts_rows(values):
        return False
    return not any(_is_possible(table, name) for name in suggestions)


def _is_possible(table: DataTable, name: str) -> bool:
    """Return whether a table may have one more column of texts, so that another column may be meant by it."""
    if _CONTENTS.get(name) != "text" or name in AUXILIARY_COLUMNS:
        return True
    try:
        _kind_of_columns({*_present_values(table), name}, table.header_location)
    except FileFormatError:
        return False
    return True


def counts_rows(values: Array) -> bool:
    """Return whether a column (m,) counts its rows."""
    return len(values) > 2 and values[0] in (0, 1) and bool(np.all(np.diff(values) == 1))


def unknown_column_error(
    where: str, name: str, known: Iterable[str], present: Iterable[str], joint_names: Iterable[str]
) -> UnknownNameError:
    """Build the error of a column that is neither a joint nor a measured value."""
    suggestions = _suggestions(name, known, present)
    remedy = (
        f"did you mean {suggestions[0]!r}?"
        if suggestions
        else f"remove it or rename it; the joints of the robot are {', '.join(joint_names)}"
    )
    return UnknownNameError(
        f"{where}: column {name!r} is neither a joint of this robot nor a known measurement column; {remedy}"
    )


def _suggestions(name: str, known: Iterable[str], present: Iterable[str]) -> list[str]:
    """Return the known names that are most similar to a misspelt one, except those that are present."""
    wanted = name[:_MAX_COMPARED].lower()
    similarity = {
        other: difflib.SequenceMatcher(None, wanted, other.lower()).ratio()
        for other in known
        if other not in _REMARKS
    }
    best = max(_MIN_SIMILARITY, *similarity.values())
    # A column that is present already cannot be the intended one.
    return sorted({other for other, ratio in similarity.items() if ratio == best} - set(present))


def _present_values(table: DataTable) -> set[str]:
    """Return the names of the columns of measured values, with a rotation vector in place of a quaternion."""
    present = set(table.columns) & VALUE_COLUMNS
    return present - set(QUATERNION) | set(ROTVEC) if present & set(QUATERNION) else present


def has_tool_poses(table: DataTable) -> bool:
    """Return whether a file has image coordinates and poses of the tip."""
    present = _present_values(table)
    return present.issuperset(TOOL_POSE) and any(
        present.issuperset(columns)
        for kind in KINDS.values()
        if kind.accepts_tool_poses
        for columns in kind.required_columns
    )


def find_kind(table: DataTable) -> type[Measurement]:
    """Find the measurement kind of a file from its columns."""
    present = _present_values(table)
    if has_tool_poses(table):
        present -= set(TOOL_POSE)
    return _kind_of_columns(present, table.header_location, join_hint(table))


def join_hint(table: DataTable) -> str:
    """Say how values over time in a file of their own are joined with the others; empty without times."""
    if "time" not in table.columns:
        return ""
    return (
        "; joint values and measured values of two recordings are joined by dhcal convert JOINTS.csv OUT.csv "
        "--poses FILE.csv --robot ROBOT"
    )


def _kind_of_columns(present: Set[str], where: str, hint: str = "") -> type[Measurement]:
    """Find the measurement kind that has some columns of values."""
    candidates = [
        (len(required), -len(kind.columns), kind)
        for kind in KINDS.values()
        for required in kind.required_columns
        if required <= present
    ]
    if not candidates:
        incomplete = f"; {', '.join(sorted(present))} alone is not enough" if present else ""
        expected = "a position needs the columns x[mm],y[mm],z[mm], a pose needs qw,qx,qy,qz in addition"
        possible = [other for other in KINDS.values() if present and present <= set(other.columns)]
        if len(possible) == 1:
            (missing, *_) = sorted((sorted(each - present) for each in possible[0].required_columns), key=len)
            expected = f"kind {possible[0].kind} needs {', '.join(missing)}, too"
        raise FileFormatError(f"{where}: no measured values{incomplete}; {expected}{hint}")
    kind = max(candidates, key=lambda candidate: candidate[:2])[2]
    if unrelated := sorted(present - set(kind.columns)):
        others = "".join(
            f"; one of kind {other.kind} needs {', '.join(missing)}, too"
            for other in KINDS.values()
            if present <= set(other.columns)
            and (missing := min((sorted(each - present) for each in other.required_columns), key=len))
        )
        raise FileFormatError(
            f"{where}: column {unrelated[0]!r} does not go with "
            f"{', '.join(sorted(present & set(kind.columns)))}; "
            f"a file of kind {kind.kind} has {', '.join(kind.columns)}{others}"
        )
    return kind
