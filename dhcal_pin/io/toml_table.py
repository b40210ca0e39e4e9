"""Tables of TOML files, and declarations of their keys.

A reader declares the keys that it knows, with the type, the limits and the default of each:

    PAYLOAD_KEYS = {"mass_kg": number(above=0), "centre_m": vector(3, default=(0.0, 0.0, 0.0))}

    table = TomlTable.read("arm.calibration.toml")
    payload = table.table("payload").values(PAYLOAD_KEYS)

Every error is a `FileFormatError` that names the file, the table, the key, the value and what is expected. A
key that is not declared is an error, which names the keys that are allowed. The documentation writes its JSON
schemas from the same declarations (`docs/extensions/schema_files.py`).
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field
from typing import Any

from .. import se3
from .._frozen import frozen
from .._typing import Array, PathLike
from ..exceptions import FileFormatError
from ..messages import quote
from .tabular import MAX_TOML_BYTES, read_toml

# Largest number that remains a finite double after a conversion of units.
MAX_NUMBER = 1e300
# Largest component of a pose [m or rad]; a larger one has the wrong unit.
_MAX_POSE_VALUE = 1e4


class TomlTable:
    """Table of a TOML file, with checked access to its keys."""

    def __init__(self, path: PathLike, raw: object, name: str = ""):
        """Wrap a table with a name for messages, such as `[base]`; that of the top level is empty."""
        self.path, self.name = os.fspath(path), name
        if not isinstance(raw, dict):
            raise FileFormatError(
                f"{self.where}: {quote(raw)} is not a table; write a table of keys and values"
            )
        self._raw: dict[str, Any] = raw
        # A dict, because the message of `finish` names the keys in the order of the questions.
        self._known_keys: dict[str, None] = {}

    @classmethod
    def read(cls, path: PathLike, max_bytes: int = MAX_TOML_BYTES) -> TomlTable:
        """Read the top level of a TOML file."""
        return cls(path, read_toml(path, max_bytes))

    @property
    def where(self) -> str:
        """Start of every message: the file, and the table."""
        return f"{self.path}: {self.name}" if self.name else self.path

    def __contains__(self, key: str) -> bool:
        """Return whether the table has a key; `finish` allows the key from now on."""
        self._known_keys[key] = None
        return key in self._raw

    def keys(self) -> list[str]:
        """Return the keys in the order of the file, for tables whose keys are names."""
        return list(self._raw)

    def error(self, key: str, expected: str) -> FileFormatError:
        """Build the error of a wrong value."""
        return FileFormatError(f"{self.where}: {key} = {quote(self._raw[key])}; {expected}")

    def get(self, key: str, default: Any = None, *, expected: str = "a value") -> Any:
        """Return a value of any type."""
        if key in self:
            return self._raw[key]
        if default is not None:
            return default
        unread = [other for other in self._raw if other not in self._known_keys]
        if similar := difflib.get_close_matches(key, unread, 1):
            raise FileFormatError(f"{self.where}: unknown key {similar[0]!r}; did you mean {key!r}?")
        given = f"; the keys given are {', '.join(self._raw)}" if self._raw else ""
        raise FileFormatError(f"{self.where}: {key} is missing; expected {expected}{given}")

    def some_values(self, keys: Mapping[str, Key]) -> dict[str, Any]:
        """Return the values of declared keys."""
        return {key: declared.read(self, key) for key, declared in keys.items()}

    def values(self, keys: Mapping[str, Key]) -> dict[str, Any]:
        """Return the values of declared keys; any other key is an error."""
        values = self.some_values(keys)
        self.finish()
        return values

    def values_by_name(self, each: Key) -> dict[str, Any]:
        """Return the values of a table whose keys are names."""
        return self.some_values(dict.fromkeys(self._raw, each))

    def table(self, key: str, *, required: bool = False) -> TomlTable:
        """Return a table of this table."""
        outer = self.name.removeprefix("[").removesuffix("]")
        name = f"[{outer}.{key}]" if outer else f"[{key}]"
        raw = self.get(key, None if required else {}, expected=f"a table {name}")
        return TomlTable(self.path, raw, name)

    def tables(self, key: str, *, expected: str) -> list[TomlTable]:
        """Return an array of tables, one or more."""
        value = self.get(key, [], expected=expected)
        if not isinstance(value, list) or not value or not all(isinstance(entry, dict) for entry in value):
            raise FileFormatError(f"{self.where}: no [[{key}]] table; write {expected}")
        return [TomlTable(self.path, entry, f"{key} {number}") for number, entry in enumerate(value, 1)]

    def finish(self) -> None:
        """Raise an error if the table has a key that was not asked for."""
        for key in self._raw:
            if key not in self._known_keys:
                allowed = ", ".join(self._known_keys)
                raise FileFormatError(f"{self.where}: unknown key {key!r}; choose from {allowed}")


# --- declarations ----------------------------------------------------------------------------------


def is_number(value: object) -> bool:
    """Return whether a TOML value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER


@frozen
class Key:
    """Declaration of the value of a key; the functions below make those of each type."""

    description: str = "a value"  # Allowed values, for messages
    schema: Mapping[str, Any] = field(default_factory=dict)  # The same as a JSON schema
    accepts: Callable[[Any], bool] = lambda value: True  # Whether a value is allowed
    converted: Callable[[Any], Any] = lambda value: value  # Allowed value in the type that readers use
    default: Any = None  # Value of an absent key; None if it has none
    is_optional: bool = False  # Whether a key without a default may be absent; its value is then None
    remedy: str = ""  # End of the message on another value; what is expected if it is empty

    @property
    def is_required(self) -> bool:
        """Whether an absent key is an error."""
        return self.default is None and not self.is_optional

    def read(self, table: TomlTable, key: str) -> Any:
        """Return the value of a key of a table."""
        if self.is_optional and key not in table:
            return None
        value = table.get(key, self.default, expected=self.description)
        if key in table and not self.accepts(value):
            raise table.error(key, self.remedy or f"expected {self.description}")
        return self.converted(value)


@frozen
class ListKey(Key):
    """Declaration of a list of `size` entries, each as `entry` declares it."""

    entry: Key = field(default_factory=Key)
    size: int | None = None

    def read(self, table: TomlTable, key: str) -> list[Any] | None:
        """Return the entries of a list."""
        values = super().read(table, key)
        if values is None:
            return None
        if self.size not in (None, len(values)):
            count = f"{len(values)} {'entry' if len(values) == 1 else 'entries'}"
            raise FileFormatError(f"{table.where}: {key} has {count}; expected {self.size}")
        for value in values:
            if not self.entry.accepts(value):
                raise FileFormatError(
                    f"{table.where}: {key} has the entry {value!r}; expected {self.entry.description}"
                )
        return [self.entry.converted(value) for value in values]


@frozen
class TableKey(Key):
    """Declaration of a table: its keys, or `each` if its keys are names that the user chooses."""

    keys: Mapping[str, Key] = field(default_factory=dict)
    each: Key | None = None

    def read(self, table: TomlTable, key: str) -> dict[str, Any] | None:
        """Return the values of a table by their keys."""
        if self.is_optional and key not in table:
            return None
        inner = table.table(key, required=self.is_required)
        return inner.values(self.keys) if self.each is None else inner.values_by_name(self.each)


def table_schema(keys: Mapping[str, Key]) -> dict[str, Any]:
    """Return the JSON schema of a table with these keys."""
    return {
        "type": "object",
        "required": [key for key, declared in keys.items() if declared.is_required],
        "properties": {key: declared.schema for key, declared in keys.items()},
        "additionalProperties": False,
    }


def table_of(keys: Mapping[str, Key], *, is_optional: bool = True) -> Key:
    """Declare a table with these keys."""
    return TableKey(schema=table_schema(keys), is_optional=is_optional, keys=keys)


def table_by_name(each: Key) -> Key:
    """Declare a table whose keys are names; it is empty if it is absent."""
    return TableKey(schema={"type": "object", "additionalProperties": each.schema}, default={}, each=each)


def list_of(entry: Key, size: int | None = None, default: Sequence[Any] | None = None, **options: Any) -> Key:
    """Declare a list that is not empty."""
    return ListKey(
        "a list in brackets" + ("" if size is None else f" with {size} entries"),
        {"type": "array", "minItems": size or 1, "items": entry.schema}
        | ({"maxItems": size} if size else {}),
        lambda value: isinstance(value, Sequence) and not isinstance(value, str) and len(value) > 0,
        default=default,
        entry=entry,
        size=size,
        **options,
    )


def number(
    at_least: float = -MAX_NUMBER,
    at_most: float = MAX_NUMBER,
    *,
    above: float = -math.inf,
    description: str = "",
    **options: Any,
) -> Key:
    """Declare a finite number."""
    limits = [
        (f"above {above:g}", {"exclusiveMinimum": above}, above > -math.inf),
        (f"of at least {at_least:g}", {"minimum": at_least}, at_least > -MAX_NUMBER),
        (f"of at most {at_most:g}", {"maximum": at_most}, at_most < MAX_NUMBER),
    ]
    schema: dict[str, Any] = {"type": "number"}
    for _, limit, is_given in limits:
        schema |= limit if is_given else {}
    texts = [text for text, _, is_given in limits if is_given]
    return Key(
        description or (f"a number {' and '.join(texts)}" if texts else "a finite number"),
        schema,
        lambda value: is_number(value) and at_least <= value <= at_most and value > above,
        float,
        **options,
    )


def whole(at_least: int, at_most: int | None = None, description: str = "", **options: Any) -> Key:
    """Declare a whole number."""
    upper = math.inf if at_most is None else at_most
    return Key(
        description or f"a whole number from {at_least} to {at_most}",
        {"type": "integer", "minimum": at_least} | ({} if at_most is None else {"maximum": at_most}),
        lambda value: type(value) is int and at_least <= value <= upper,
        **options,
    )


def flag(default: bool) -> Key:
    """Declare a truth value."""
    return Key("true or false", {"type": "boolean"}, lambda value: isinstance(value, bool), default=default)


def text(description: str = "a text in quotes", pattern: str = "(?s:.*)", **options: Any) -> Key:
    """Declare a text, which may have to match a regular expression."""
    return Key(
        description,
        {"type": "string"},
        lambda value: isinstance(value, str) and re.fullmatch(pattern, value) is not None,
        **options,
    )


def choice(choices: Iterable[str], **options: Any) -> Key:
    """Declare one of several texts."""
    choices = list(choices)
    # Micro has two code points in Unicode: units are listed in their ASCII spelling only.
    names = ", ".join(f'"{each}"' for each in choices if each.isascii())
    return Key(
        f"one of {names}", {"enum": choices}, choices.__contains__, remedy=f"choose from {names}", **options
    )


def vector(size: int, at_most: float = MAX_NUMBER, description: str = "", **options: Any) -> Key:
    """Declare a list of finite numbers."""
    limit = f" up to ±{at_most:g}" if at_most < MAX_NUMBER else ""
    return Key(
        description or f"{size} numbers{limit}, such as {[0.0] * size}",
        {"type": "array", "minItems": size, "maxItems": size, "items": {"type": "number"}},
        lambda value: (
            isinstance(value, Sequence)
            and len(value) == size
            and all(is_number(entry) and abs(entry) <= at_most for entry in value)
        ),
        lambda value: [float(entry) for entry in value],
        **options,
    )


# Keys of a pose.
POSE_KEYS: Mapping[str, Key] = dict.fromkeys(
    ("xyz_m", "rotvec_rad"), vector(3, _MAX_POSE_VALUE, default=(0.0, 0.0, 0.0))
)


def pose_of(values: Mapping[str, Any]) -> Array:
    """Return the pose of the values of `POSE_KEYS`."""
    return se3.transform(se3.exp3(values["rotvec_rad"]), values["xyz_m"])


def read_pose(table: TomlTable) -> Array:
    """Read a pose from the keys xyz_m and rotvec_rad."""
    return pose_of(table.values(POSE_KEYS))


def pose_content(pose: Array) -> dict[str, list[float]]:
    """Return the keys and values of a pose, the inverse of `read_pose`."""
    return {"xyz_m": pose[:3, 3].tolist(), "rotvec_rad": se3.log3(pose[:3, :3]).tolist()}
