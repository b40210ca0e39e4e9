"""Text files in and out: units, sheets with a header, and writing all files or none."""

from __future__ import annotations

import csv
import os
import re
import tempfile
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import DhcalError
from .se3 import Array

PathLike = str | os.PathLike[str]

# Divisors, so that 606.8 mm is the double nearest to 0.6068 m.
LENGTHS = {"m": 1.0, "cm": 1e2, "mm": 1e3, "um": 1e6, "µm": 1e6}
ANGLES = {"rad": 1.0, "mrad": 1e3, "deg": 180.0 / np.pi}


def save(contents: Mapping[PathLike, str | bytes]) -> None:
    """Writes all files or none: each beside its place first, then renamed over.

    Raises:
        DhcalError: a folder is missing or not writable.
    """
    staged: list[tuple[str, PathLike]] = []
    try:
        for path, content in contents.items():
            folder = os.path.dirname(os.path.abspath(path))
            try:
                handle, name = tempfile.mkstemp(prefix=".dhcal-", dir=folder)
            except OSError as error:
                raise DhcalError(f"{path}: cannot write there: {error.strerror}") from error
            staged.append((name, path))
            with os.fdopen(handle, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
            mask = os.umask(0)
            os.umask(mask)
            os.chmod(name, 0o666 & ~mask)
        for name, path in staged:
            try:
                os.replace(name, path)
            except OSError as error:
                raise DhcalError(f"{path}: cannot write there: {error.strerror}") from error
    finally:
        for name, _ in staged:
            with suppress(FileNotFoundError):
                os.unlink(name)


def read_text(path: PathLike) -> str:
    """A UTF-8 text file, or DhcalError."""
    try:
        return Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise DhcalError(f"{path}: cannot read it: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DhcalError(f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8") from error


def read_toml(path: PathLike) -> dict:
    """A TOML file, or DhcalError."""
    try:
        return tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise DhcalError(f"{path}: not TOML: {error}") from error


def parse_noise(text: str) -> tuple[float, float]:
    """Standard deviations in m and rad from a text such as `0.1mm` or `0.1mm,0.01deg`."""
    out = {"length": 0.0, "angle": 0.0}
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([a-zµ]+)\s*", part)
        kind = "length" if match and match[2] in LENGTHS else "angle"
        units = LENGTHS if kind == "length" else ANGLES
        if not match or match[2] not in units:
            raise DhcalError(f"noise {part.strip()!r}: write a number with a unit, as 0.1mm or 0.1mm,0.01deg")
        try:
            out[kind] = float(match[1]) / units[match[2]]
        except ValueError:
            raise DhcalError(f"noise {part.strip()!r}: {match[1]!r} is not a number") from None
        if not 0 <= out[kind] < float("inf"):
            raise DhcalError(f"noise {part.strip()!r}: must be zero or more")
    return out["length"], out["angle"]


@dataclass(frozen=True)
class Column:
    """A header entry `name[unit]`; unit is empty where the header gives none."""

    name: str
    unit: str
    index: int

    def scale(self, units: Mapping[str, float], where: str) -> float:
        """The divisor to SI, or DhcalError when the unit is missing or of another quantity."""
        if self.unit in units:
            return units[self.unit]
        found = f"has unit {self.unit!r}" if self.unit else "has no unit"
        first = next(iter(units))
        raise DhcalError(
            f"{where}: column {self.name!r} {found}; write one of "
            f"{', '.join(f'{self.name}[{u}]' for u in units if u != 'µm')} (for example {self.name}[{first}])"
        )


@dataclass(frozen=True)
class Sheet:
    """A CSV file: comments, columns, and cells with the line each row stands on."""

    source: str
    comments: tuple[str, ...]
    columns: dict[str, Column]
    cells: list[list[str]]
    lines: list[int]
    header: int

    def numbers(self, column: Column) -> Array:
        """A column's finite numbers (m,), or DhcalError naming line and column."""
        with suppress(ValueError):
            out = np.array([row[column.index] for row in self.cells], dtype=float)
            if np.isfinite(out).all():
                return out
        for row, line in zip(self.cells, self.lines, strict=True):
            text = row[column.index].strip()
            try:
                good = np.isfinite(float(text))
            except ValueError:
                good = False
            if not good:
                what = f"{text!r} is not a finite number" if text else "is empty"
                raise DhcalError(
                    f"{self.source}:{line}: column {column.name!r}: {what}; correct or remove the row"
                )
        raise AssertionError("unreachable")

    def text(self, column: Column) -> list[str]:
        """A column's cells as text (m,)."""
        return [row[column.index].strip() for row in self.cells]


def read_sheet(path: PathLike) -> Sheet:
    """A comma-separated UTF-8 file with `#` comments and one header line."""
    source, comments, kept = os.fspath(path), [], []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip()[1:].strip())
        elif line.strip(" \t,;"):
            kept.append((number, line))
    if not kept:
        raise DhcalError(
            f"{source}: is empty; the first line must be a header such as joint_1[deg],…,x[mm],y[mm],z[mm]"
        )
    rows = list(csv.reader(line for _, line in kept))
    first = kept[0][0]
    columns: dict[str, Column] = {}
    for index, cell in enumerate(rows[0]):
        match = re.fullmatch(r"\s*([^\[\]]+?)\s*(?:\[\s*([^\[\]]*?)\s*\])?\s*", cell)
        if not match:
            raise DhcalError(f"{source}:{first}: header {cell!r}: write a name, or name[unit]")
        name, unit = match[1], match[2] or ""
        if name in columns:
            raise DhcalError(f"{source}:{first}: column {name!r} stands twice; remove one")
        columns[name] = Column(name, unit, index)
    lines = [number for number, _ in kept[1:]]
    for row, line in zip(rows[1:], lines, strict=True):
        if len(row) != len(rows[0]):
            raise DhcalError(
                f"{source}:{line}: {len(row)} values under a header of {len(rows[0])} columns; "
                "give every row one value a column (decimal point, comma between)"
            )
    if not lines:
        raise DhcalError(f"{source}: no rows under the header in line {first}; add at least one measurement")
    return Sheet(source, tuple(comments), columns, rows[1:], lines, first)
