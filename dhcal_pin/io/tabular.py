"""Text files read and tables written: units, and sheets with a header."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._typing import Array, PathLike
from ..exceptions import DhcalError

# Metres or radians: no reading, but a wrong unit or a typing error.
_MAX_VALUE = 1e6


# Joint names are column names, and one stands in every line of a table.
_NOT_IN_NAMES = frozenset(",;[]#\"'")


def read_text(path: PathLike, encoding: str = "utf-8") -> str:
    """A text file, in UTF-8 if nothing else is said, or DhcalError."""
    try:
        return Path(path).read_bytes().decode(encoding).removeprefix("\ufeff")
    except OSError as error:
        raise DhcalError(f"{path}: cannot read it: {error.strerror}; give the path of a file") from error
    except UnicodeDecodeError as error:
        name = encoding.upper()
        raise DhcalError(f"{path}: byte {error.start} is not {name}; save the file as {name}") from error


def read_toml(path: PathLike) -> dict:
    """A TOML file, or DhcalError."""
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # more than TOMLDecodeError: endless numbers and brackets
        raise DhcalError(f"{path}: not TOML: {error}; correct that line") from error


def require_usable_names(names: Sequence[str], source: str) -> None:
    """Complains about joint names that a table or a measurement file cannot carry.

    Raises:
        DhcalError: a name is empty, not printable, or has a sign that means something in a header.
    """
    for name in names:
        if not name or name != name.strip() or not name.isprintable() or _NOT_IN_NAMES & set(name):
            raise DhcalError(
                f"{source}: joint name {name!r}: a name that heads a column must be printable, "
                f"without {' '.join(sorted(_NOT_IN_NAMES))}; rename the joint"
            )


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
        raise DhcalError(
            f"{where}: column {self.name!r} {found}; write one of "
            f"{', '.join(f'{self.name}[{unit}]' for unit in units if unit.isascii())}"
        )


@dataclass(frozen=True)
class CsvTable:
    """A CSV file: comments, columns, and cells with the line each row stands on.

    `parsed` has the numbers (m,) of columns, by index, that a quick parser understood as a whole.
    """

    source: str
    comments: tuple[str, ...]
    columns: dict[str, Column]
    cells: Sequence[list[str]]
    lines: list[int]
    header: int
    parsed: Mapping[int, Array] = field(default_factory=dict)

    def to_si(self, column: Column, units: Mapping[str, float]) -> Array:
        """A column's numbers (m,) in metres or radians, or DhcalError naming line and column."""
        out = self.numbers(column) / column.scale(units, f"{self.source}:{self.header}")
        bad = np.flatnonzero(np.abs(out) > _MAX_VALUE)
        if bad.size:
            text = self.cells[bad[0]][column.index].strip()
            raise DhcalError(
                f"{self.source}:{self.lines[bad[0]]}: column {column.name!r}: {text} {column.unit} is beyond "
                f"{_MAX_VALUE:g} {next(iter(units))}; correct the number or the unit"
            )
        return out

    def numbers(self, column: Column) -> Array:
        """A column's finite numbers (m,), or DhcalError naming line and column."""
        with suppress(ValueError):
            out = self.parsed.get(column.index)
            if out is None:
                out = np.array([number(row[column.index]) for row in self.cells])
            if np.isfinite(out).all():
                return out
        for row, line in zip(self.cells, self.lines, strict=True):
            text = row[column.index].strip()
            if not _is_number(text):
                what = f"{text!r} is not a finite number" if text else "is empty"
                raise DhcalError(
                    f"{self.source}:{line}: column {column.name!r}: {what}; correct or remove the row"
                )
        raise AssertionError("unreachable")

    def text(self, column: Column) -> list[str]:
        """A column's cells as text (m,)."""
        return [row[column.index].strip() for row in self.cells]


def number(text: str) -> float:
    """The number that a cell holds, or ValueError; 1_000, which Python would read, is none."""
    if "_" in text:
        raise ValueError(text)
    return float(text)


def read_csv_table(path: PathLike) -> CsvTable:
    """A comma-separated UTF-8 file with `#` comments and one header line.

    Raises:
        DhcalError: it is empty, its header is none, or a row is too short or too long.
    """
    return parse_csv_table(os.fspath(path), enumerate(read_text(path).splitlines(), 1))


def parse_csv_table(source: str, numbered: Iterable[tuple[int, str]]) -> CsvTable:
    """The sheet of numbered lines, which need not be all of a file; as `read_sheet`."""
    comments, kept = [], []
    for number, line in numbered:
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip()[1:].strip())
        elif line.strip(" \t,;"):
            kept.append((number, line))
    if not kept:
        raise DhcalError(
            f"{source}: is empty; the first line must be a header such as joint_1[deg],…,x[mm],y[mm],z[mm]"
        )
    first, head = kept[0]
    columns = _columns(_cells(head, f"{source}:{first}"), f"{source}:{first}")
    lines = [number for number, _ in kept[1:]]
    cells = _Rows(source, kept[1:])
    for i, (line, text) in enumerate(kept[1:]):
        count = len(cells[i]) if '"' in text else text.count(",") + 1
        if count != len(columns):
            raise DhcalError(
                f"{source}:{line}: {count} values under a header of {len(columns)} columns; "
                "give every row one value a column (decimal point, comma between)"
            )
    if not lines:
        raise DhcalError(f"{source}: no rows under the header in line {first}; add at least one row")
    return CsvTable(source, tuple(comments), columns, cells, lines, first, cells.numbers())


class _Rows(Sequence[list[str]]):
    """Rows of comma-separated text, split when they are asked for: numbers mostly need no cells."""

    def __init__(self, source: str, kept: Sequence[tuple[int, str]]):
        self.source, self.kept = source, kept

    def __len__(self) -> int:
        return len(self.kept)

    def __getitem__(self, index: Any) -> Any:
        number, line = self.kept[index]
        # Line by line, so that a stray quote stays in its own row.
        return _cells(line, f"{self.source}:{number}")

    def numbers(self) -> dict[int, Array]:
        """All columns of numbers (m,) by index; none if a cell of them is something else, or quoted."""
        if any('"' in line for _, line in self.kept):
            return {}
        numeric = []
        for i, cell in enumerate(self[0]):
            with suppress(ValueError):
                float(cell)
                numeric.append(i)
        try:
            table = np.loadtxt(
                (line for _, line in self.kept), delimiter=",", comments=None, usecols=numeric, ndmin=2
            )
        except ValueError:
            return {}
        return dict(zip(numeric, np.ascontiguousarray(table.T), strict=True))


def _cells(line: str, where: str) -> list[str]:
    try:
        return next(csv.reader([line]))
    except csv.Error as error:
        raise DhcalError(f"{where}: not comma-separated text: {error}; correct this line") from error


def _columns(header: Sequence[str], where: str) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    for index, cell in enumerate(header):
        match = re.fullmatch(r"\s*([^\[\]]+?)\s*(?:\[\s*([^\[\]]*?)\s*\])?\s*", cell)
        if not match:
            shown = cell if len(cell) <= 60 else cell[:57] + "..."
            raise DhcalError(f"{where}: header {shown!r}: write name or name[unit], with commas between them")
        name, unit = match[1], match[2] or ""
        if name in columns:
            raise DhcalError(f"{where}: column {name!r} stands twice; remove one")
        columns[name] = Column(name, unit, index)
    if all(map(_is_number, columns)):
        raise DhcalError(
            f"{where}: numbers where the header must be; write one such as joint_1[deg],…,x[mm],y[mm],z[mm]"
        )
    return columns


def _is_number(text: str) -> bool:
    with suppress(ValueError):
        return math.isfinite(number(text))
    return False


def csv_text(columns: Mapping[str, Iterable[Any]], comments: Iterable[str] = ()) -> str:
    """Comments and columns of equal length as CSV; numbers to the last digit, None as an empty cell."""
    out = io.StringIO()
    out.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return out.getvalue()
