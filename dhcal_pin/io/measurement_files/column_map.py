"""Column maps: read measurement files of other vendors.

A column map is a TOML file that describes the columns of a vendor's file, see docs/reference/robot_files.md.
Every key except the columns themselves has a default. Placeholders in texts of `[constant]` are `{file}`,
`{stem}` and `{parent}`, the parts of the path of the file.

`[to_joints]` has the keys of `[joints]` and describes the second configuration of a row. Columns of the file
that the map does not name are ignored. The map applies to every file, except to files with a header of the
project's own that lack columns of the map.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..._frozen import frozen
from ..._typing import PathLike
from ...exceptions import FileFormatError, UnknownNameError
from ...messages import quote
from ...robot.chain import Chain
from ...units import ANGLES, UNITS
from .. import toml_table as toml
from ..tables import SEPARATORS, TextLayout
from ..toml_table import Key, TomlTable
from .columns import (
    ROTVEC,
    SECOND_PREFIX,
    column_contents,
    condition_contents,
    known_columns,
    unknown_column_error,
)
from .counts import TICKS

# Placeholders in a constant, each written in braces.
PATH_PARTS = ("file", "stem", "parent")
# Number of columns of each convention of rotations, and the other keys that it needs.
CONVENTIONS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "rotvec": (3, ("unit",)),
    "euler": (3, ("unit", "axes", "frame")),
    "quaternion": (4, ("order",)),
    "matrix": (9, ()),
}
# Pattern of the value of each of these keys, and its description.
_CONVENTION_KEYS = {
    "unit": ("|".join(ANGLES), " or ".join(ANGLES)),
    "axes": (r"(?i:([xyz])(?!\1)([xyz])(?!\2)[xyz])", 'three axes, such as "XYZ" or "ZYZ"'),
    "frame": ("intrinsic|extrinsic", "intrinsic (rotated axes) or extrinsic (fixed axes)"),
    "order": ("wxyz|xyzw", "wxyz or xyzw"),
}
_COLUMN = Key('the header of a column, as in from = "X pos"', {"type": ["string", "integer"]})
# Keys at the top of a map.
LAYOUT_KEYS = {
    "separator": toml.choice(SEPARATORS, default=""),
    "decimal": toml.choice((".", ","), default=""),
    "skip": Key(
        "a number of lines, as in skip = 2",
        {"type": "integer", "minimum": 0},
        lambda value: type(value) is int,
        default=0,
    ),
    "header": toml.flag(True),
    "comment": toml.text(default="#"),
    "encoding": toml.text(default="utf-8"),
}
# Keys of a column in the table [columns].
COLUMN_KEYS = {
    "from": _COLUMN,
    "unit": Key(schema={"type": "string"}, default=""),
    "scale": toml.number(default=1.0),
    "offset": toml.number(default=0.0),
}


def joint_keys(size: int | None = None, names: Sequence[str] = ()) -> dict[str, Key]:
    """Declare the keys of [joints] for a number of columns and the joints of a robot."""
    repeated = size or 0
    return {
        "order": toml.list_of(_COLUMN, size),
        "names": toml.list_of(Key(), size, default=names),
        "unit": Key(schema={"type": ["string", "array"]}, default=""),
        "sign": toml.list_of(Key(), size, default=[1] * repeated),
        "offset": toml.list_of(Key(), size, default=[0] * repeated),
    }


def rotation_keys(convention: str) -> dict[str, Key]:
    """Declare the keys of [rotation] for a convention."""
    count, needed_keys = CONVENTIONS[convention]
    needed = {key: row for key, row in _CONVENTION_KEYS.items() if key in needed_keys}
    return {
        "convention": toml.choice(CONVENTIONS),
        **{key: toml.text(f"{words} for {convention}", pattern) for key, (pattern, words) in needed.items()},
        "columns": toml.list_of(_COLUMN, count),
    }


@frozen
class ColumnRule:
    """Rule that makes a column of the project from a column of the vendor: scale * column + offset."""

    name: str  # Name of the project's column
    content: str  # "length", "angle", "number" or "text"
    unit: str  # Unit of the vendor's column and of the offset
    source_column: str | int  # Header of the vendor's column, or its number counted from 1
    scale: float  # Factor
    offset: float  # Summand, in `unit`


@frozen
class Rotation:
    """Notation of a rotation. Keys that the convention does not need are empty."""

    convention: str  # "rotvec", "euler", "quaternion" or "matrix"
    columns: tuple[str | int, ...]  # Header or number of each of the vendor's columns
    unit: str = ""  # Unit of angles
    axes: str = ""  # Euler axes in lower case, such as "zyx"
    frame: str = ""  # "intrinsic" or "extrinsic"
    order: str = ""  # "wxyz" or "xyzw"


@frozen
class ColumnMap:
    """Checked content of a column map."""

    source: str  # Name of the map's file
    rules: tuple[ColumnRule, ...]  # Columns of the project that are columns of the vendor
    rotation: Rotation | None  # Notation of the rotation; None if the file has none
    constants: Mapping[str, str]  # Columns of the project that have one text for the whole file
    layout: TextLayout  # How the file is divided into cells

    @property
    def source_columns(self) -> list[str | int]:
        """Columns of the vendor that the map names."""
        rotation = self.rotation.columns if self.rotation else ()
        return [*(rule.source_column for rule in self.rules), *rotation]


# --- reading a map ---------------------------------------------------------------------------------


def read_map(path: PathLike, chain: Chain) -> ColumnMap:
    """Read a column map and check it for a robot."""
    table = TomlTable.read(path)
    contents = column_contents(chain)
    layout = _layout(table)
    rules: list[ColumnRule] = []
    for key, prefix in (("joints", ""), ("to_joints", SECOND_PREFIX)):
        if key in table:
            names = [prefix + name for name in chain.joint_names]
            rules += _joint_rules(table.table(key), names, contents)
    rules += _column_rules(table.table("columns"), contents, condition_contents(chain))
    rotation = _rotation(table.table("rotation")) if "rotation" in table else None
    constants = _constants(table.table("constant"), contents)
    table.finish()
    names = [*(rule.name for rule in rules), *constants, *(ROTVEC if rotation else ())]
    if repeated := [name for i, name in enumerate(names) if name in names[:i]]:
        raise FileFormatError(f"{table.where}: column {repeated[0]!r} is given twice; remove one")
    for name in names:
        if name not in contents:
            raise unknown_column_error(table.where, name, known_columns(chain), names, chain.joint_names)
    return ColumnMap(table.path, tuple(rules), rotation, constants, layout)


def _layout(table: TomlTable) -> TextLayout:
    """Read how the file is divided into cells."""
    values = table.some_values(LAYOUT_KEYS)
    layout = TextLayout(has_header=values.pop("header"), **values)
    if layout.separator == layout.decimal == ",":
        raise FileFormatError(f"{table.where}: separator and decimal are both ','; change one of them")
    if layout.skip < 0:
        raise table.error("skip", "expected the number of lines before the header")
    try:
        # Codecs of Python that do not encode text, such as rot13, raise LookupError.
        "a".encode(layout.encoding)
    except (LookupError, ValueError):
        raise UnknownNameError(
            f"{table.where}: unknown encoding {quote(layout.encoding)}; expected one such as utf-8 or cp1252"
        ) from None
    return layout


def _joint_rules(table: TomlTable, joints: Sequence[str], contents: Mapping[str, str]) -> list[ColumnRule]:
    size = len(toml.list_of(_COLUMN).read(table, "order") if "names" in table else joints)
    values = table.values(joint_keys(size, joints))
    unit, signs, offsets = (values[key] for key in ("unit", "sign", "offset"))
    units = toml.list_of(Key(), size).read(table, "unit") if isinstance(unit, list) else [unit] * size
    if any(type(sign) is bool or sign not in (1, -1) for sign in signs):
        raise table.error("sign", "expected 1 or -1 for each joint")
    for offset in offsets:
        if not toml.is_number(offset):
            raise table.error("offset", f"{quote(offset)} is not a number")
    return [
        _rule(table, str(name), contents, (TICKS,), source, unit, float(sign), float(offset))
        for name, source, unit, sign, offset in zip(
            values["names"], values["order"], units, signs, offsets, strict=True
        )
    ]


def _column_rules(
    table: TomlTable, contents: Mapping[str, str], conditions: Mapping[str, str]
) -> list[ColumnRule]:
    rules = []
    for name in table.keys():
        entry = table.table(name)
        source, unit, scale, offset = entry.values(COLUMN_KEYS).values()
        known = {**contents, **conditions} if unit else contents
        rules.append(_rule(entry, name, known, (), source, unit, scale, offset))
    return rules


def _rule(
    table: TomlTable,
    name: str,
    contents: Mapping[str, str],
    more_units: Sequence[str],
    source: Any,
    unit: Any,
    scale: float,
    offset: float,
) -> ColumnRule:
    """Build the rule of a column of the project."""
    # Unknown names of columns are reported by `read_map`.
    content = contents.get(name, "")
    units = [*UNITS.get(content, {}), *more_units]
    if not isinstance(unit, str):
        raise FileFormatError(f"{table.where}: {name}: unit {quote(unit)}; expected a text in quotes")
    if content and (units or unit) and unit not in units:
        choices = ", ".join(f'"{choice}"' for choice in units if choice.isascii())
        remedy = f"choose from {choices}" if units else "leave the unit out"
        raise UnknownNameError(f"{table.where}: {name}: unit = {quote(unit)}; {remedy}")
    if content == "text" and (scale, offset) != (1.0, 0.0):
        raise FileFormatError(f"{table.where}: {name}: is text; leave scale and offset out")
    return ColumnRule(name, content, unit, _source_column(table, source), scale, offset)


def _source_column(table: TomlTable, value: Any) -> str | int:
    """Check the name of a vendor's column."""
    if type(value) is str or (type(value) is int and value > 0):
        return value
    raise FileFormatError(
        f"{table.where}: {quote(value)} is not a column; write its header, or its number counted from 1"
    )


def _rotation(table: TomlTable) -> Rotation:
    convention = toml.choice(CONVENTIONS).read(table, "convention")
    keys = rotation_keys(convention)
    for key in (other for other in _CONVENTION_KEYS if other not in keys):
        if key in table:
            raise table.error(key, f"does not go with {convention}; leave it out")
    values = table.values(keys)
    columns = tuple(_source_column(table, name) for name in values.pop("columns"))
    return Rotation(
        values.pop("convention"),
        columns,
        **{key: value if key == "unit" else value.lower() for key, value in values.items()},
    )


def _constants(table: TomlTable, contents: Mapping[str, str]) -> dict[str, str]:
    keys = {
        name: toml.text(f'a text in quotes, as in {name} = "{{stem}}"', "(?s:.+)", is_optional=True)
        for name, content in contents.items()
        if content == "text"
    }
    constants = {name: value for name, value in table.values(keys).items() if value is not None}
    for name in constants:
        if unknown := set(re.findall(r"\{([^}]*)\}", constants[name])) - set(PATH_PARTS):
            choices = ", ".join(f"{{{part}}}" for part in PATH_PARTS)
            raise UnknownNameError(
                f"{table.where}: {name}: unknown placeholder {{{min(unknown)}}}; choose from {choices}"
            )
    return constants
