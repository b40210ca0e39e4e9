"""Tables of TOML files, read key by key with checks.

A reader asks for each key that it knows, with the type and the range that it expects, and calls `finish` at
the end:

    table = TomlTable.read("arm.calibration.toml")
    payload = table.table("payload")
    mass = payload.number("mass_kg", above=0)
    centre = payload.vector("centre_m", 3, default=(0.0, 0.0, 0.0))
    payload.finish()

Every error is a `FileFormatError` that names the file, the table, the key, the value and what is expected. A
key that no one asked for is an error of `finish`, which names the keys that are allowed.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from .. import se3
from .._typing import Array, PathLike
from ..exceptions import FileFormatError
from ..messages import quote
from .tabular import MAX_TOML_BYTES, read_toml

T = TypeVar("T", str, int, bool)

# Largest number that remains a finite double after a conversion of units.
_MAX_NUMBER = 1e300
# Largest component of a pose [m or rad]; a larger one has the wrong unit.
_MAX_POSE_VALUE = 1e4
_TYPE_NAMES = {str: "a text in quotes", int: "a whole number", bool: "true or false"}


class TomlTable:
    """Table of a TOML file, with checked access to its keys.

    Attributes:
        path: Path of the file.
        name: Name of the table in messages, such as `[base]`; empty for the top level.
    """

    def __init__(self, path: PathLike, raw: object, name: str = ""):
        """Wrap a table."""
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

    def number(
        self,
        key: str,
        default: float | None = None,
        *,
        at_least: float = -_MAX_NUMBER,
        above: float | None = None,
        at_most: float = _MAX_NUMBER,
        expected: str = "",
    ) -> float:
        """Return a finite number."""
        expected = expected or _range_text(at_least, above, at_most)
        value = self.get(key, default, expected=expected)
        if not is_number(value) or not at_least <= value <= at_most or (above is not None and value <= above):
            raise self.error(key, f"expected {expected}")
        return float(value)

    def value(self, key: str, kind: type[T], default: T | None = None, *, expected: str = "") -> T:
        """Return a text, a whole number or a truth value."""
        expected = expected or _TYPE_NAMES[kind]
        value = self.get(key, default, expected=expected)
        if type(value) is not kind:
            raise self.error(key, f"expected {expected}")
        return value

    def text(self, key: str, default: str | None = None, *, expected: str = "") -> str:
        """Return a text."""
        return self.value(key, str, default, expected=expected)

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """Return one of several texts."""
        choices = list(choices)
        # Micro has two code points in Unicode: units are listed in their ASCII spelling only.
        names = ", ".join(f'"{choice}"' for choice in choices if choice.isascii())
        value = self.get(key, default, expected=f"one of {names}")
        if value not in choices:
            raise self.error(key, f"choose from {names}")
        return value

    def array(self, key: str, default: Sequence[Any] | None = None, *, size: int | None = None) -> list[Any]:
        """Return a list of any values."""
        expected = "a list in brackets" + ("" if size is None else f" with {size} entries")
        value = self.get(key, default, expected=expected)
        if isinstance(value, str) or not isinstance(value, Sequence) or not value:
            raise self.error(key, f"expected {expected}")
        if size is not None and len(value) != size:
            raise FileFormatError(f"{self.where}: {key} has {len(value)} entries; expected {size}")
        return list(value)

    def vector(
        self, key: str, size: int, default: Sequence[float] | None = None, *, at_most: float = _MAX_NUMBER
    ) -> list[float]:
        """Return a list of finite numbers."""
        limit = f" up to ±{at_most:g}" if at_most < _MAX_NUMBER else ""
        expected = f"{size} numbers{limit}, such as {[0.0] * size}"
        value = self.get(key, default, expected=expected)
        if (
            isinstance(value, str)
            or not isinstance(value, Sequence)
            or len(value) != size
            or not all(is_number(entry) and abs(entry) <= at_most for entry in value)
        ):
            raise self.error(key, f"expected {expected}")
        return [float(entry) for entry in value]

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


def is_number(value: object) -> bool:
    """Return whether a TOML value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MAX_NUMBER


def _range_text(at_least: float, above: float | None, at_most: float) -> str:
    limits = []
    if above is not None:
        limits.append(f"above {above:g}")
    if at_least > -_MAX_NUMBER:
        limits.append(f"of at least {at_least:g}")
    if at_most < _MAX_NUMBER:
        limits.append(f"of at most {at_most:g}")
    return f"a number {' and '.join(limits)}" if limits else "a finite number"


def read_pose(table: TomlTable) -> Array:
    """Read a pose from the keys xyz_m and rotvec_rad."""
    zero = (0.0, 0.0, 0.0)
    xyz, rotvec = (table.vector(key, 3, zero, at_most=_MAX_POSE_VALUE) for key in ("xyz_m", "rotvec_rad"))
    table.finish()
    return se3.transform(se3.exp3(rotvec), xyz)


def pose_content(pose: Array) -> dict[str, list[float]]:
    """Return the keys and values of a pose, the inverse of `read_pose`."""
    return {"xyz_m": pose[:3, 3].tolist(), "rotvec_rad": se3.log3(pose[:3, :3]).tolist()}
