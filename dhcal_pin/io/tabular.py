"""Text files: UTF-8 text, TOML, and CSV tables whose header names a unit for each column.

A CSV table has `#` comments, one header row of cells `name` or `name[unit]`, and one row per sample.
`CsvTable` converts columns to SI units and names the file, the line and the column in every error. Line
numbers count all lines of the file from 1, as text editors do.
"""

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
from ..exceptions import FileFormatError, UnknownNameError
from ..units import MAX_SI_VALUE

# Characters with a meaning in a header, which the names of joints and columns cannot have.
_RESERVED_CHARACTERS = frozenset(",;[]#\"'")
# Characters of a line without content: spreadsheets write empty rows as separators only.
BLANK_CHARACTERS = " \t,;"
# Longest header cell that a message quotes in full [characters].
_MAX_QUOTED_CELL = 60


def read_text(path: PathLike, encoding: str = "utf-8") -> str:
    """Read a text file.

    Args:
        path: Path of the file.
        encoding: Name of the encoding.

    Returns:
        Content of the file, without a byte order mark.

    Raises:
        FileFormatError: The file cannot be read, or has bytes that the encoding does not allow.
    """
    try:
        return Path(path).read_bytes().decode(encoding).removeprefix("\ufeff")
    except OSError as error:
        raise FileFormatError(f"{path}: cannot read it: {error.strerror}; give the path of a file") from error
    except UnicodeDecodeError as error:
        name = encoding.upper()
        raise FileFormatError(f"{path}: byte {error.start} is not {name}; save the file as {name}") from error


def read_toml(path: PathLike) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: Path of the file.

    Returns:
        Its top-level table.

    Raises:
        FileFormatError: The file cannot be read or is not TOML.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text)
    # Integers with too many digits raise ValueError; brackets nested too deeply raise RecursionError.
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: not TOML: {error}; correct that line") from error


def require_usable_names(names: Sequence[str], source: str) -> None:
    """Require names that can be the header of a CSV column.

    Args:
        names: Names of joints.
        source: File of the robot, for messages.

    Raises:
        FileFormatError: A name is empty, is not printable, or has a character with a meaning in a header.
    """
    for name in names:
        if not name or name != name.strip() or not name.isprintable() or _RESERVED_CHARACTERS & set(name):
            raise FileFormatError(
                f"{source}: joint name {name!r}: a name that heads a column must be printable, "
                f"without {' '.join(sorted(_RESERVED_CHARACTERS))}; rename the joint"
            )


@dataclass(frozen=True)
class Column:
    """Header entry `name[unit]`.

    Attributes:
        name: Name of the column.
        unit: Unit in brackets; empty if the header has none.
        index: Position in the header, counted from 0.
    """

    name: str
    unit: str
    index: int

    def divisor(self, units: Mapping[str, float], where: str) -> float:
        """Return the divisor that converts the column to SI units.

        Args:
            units: Divisor of each allowed unit.
            where: File and line of the header, for messages.

        Returns:
            Divisor of the column's unit.

        Raises:
            FileFormatError: The column has no unit.
            UnknownNameError: The unit is unknown or belongs to another quantity.
        """
        if self.unit in units:
            return units[self.unit]
        choices = ", ".join(f"{self.name}[{unit}]" for unit in units if unit.isascii())
        if not self.unit:
            raise FileFormatError(f"{where}: column {self.name!r} has no unit; write one of {choices}")
        raise UnknownNameError(
            f"{where}: column {self.name!r} has unit {self.unit!r}; write one of {choices}"
        )


@dataclass(frozen=True)
class CsvTable:
    """CSV table, or a part of one.

    Attributes:
        source: Name of the file.
        comments: Text of the comment lines, without `#`.
        columns: Columns by name.
        cells: Cells of each row, m rows.
        lines: File line number of each row, counted from 1.
        header_line: File line number of the header.
        parsed: Numbers, shape (m,), of those columns that could be parsed as a whole, by column index.
    """

    source: str
    comments: tuple[str, ...]
    columns: dict[str, Column]
    cells: Sequence[list[str]]
    lines: list[int]
    header_line: int
    parsed: Mapping[int, Array] = field(default_factory=dict)

    @property
    def header_location(self) -> str:
        """File and line of the header, for messages."""
        return f"{self.source}:{self.header_line}"

    def cell_location(self, row: int, column: str) -> str:
        """Return file, line and column of a cell, for messages.

        Args:
            row: Index of the row, counted from 0.
            column: Name of the column.

        Returns:
            Text such as `data.csv:7: column 'x'`.
        """
        return f"{self.source}:{self.lines[row]}: column {column!r}"

    def to_si(self, column: Column, units: Mapping[str, float]) -> Array:
        """Return the numbers of a column in SI units.

        Args:
            column: Column of this table.
            units: Divisor of each allowed unit.

        Returns:
            Values, shape (m,) [m or rad].

        Raises:
            FileFormatError: A number is too large. A cell that is not a number and a unit that is missing or
                unknown raise the errors of `numbers` and `Column.divisor`.
        """
        values = self.numbers(column) / column.divisor(units, self.header_location)
        too_large = np.flatnonzero(np.abs(values) > MAX_SI_VALUE)
        if too_large.size:
            row = int(too_large[0])
            text = self.cells[row][column.index].strip()
            raise FileFormatError(
                f"{self.cell_location(row, column.name)}: {text} {column.unit} is beyond "
                f"{MAX_SI_VALUE:g} {next(iter(units))}; correct the number or the unit"
            )
        return values

    def numbers(self, column: Column) -> Array:
        """Return the numbers of a column, in the column's own unit.

        Args:
            column: Column of this table.

        Returns:
            Finite numbers, shape (m,).

        Raises:
            FileFormatError: A cell is not a finite number.
        """
        with suppress(ValueError):
            values = self.parsed.get(column.index)
            if values is None:
                values = np.array([parse_number(row[column.index]) for row in self.cells])
            if np.isfinite(values).all():
                return values
        row, text = next(
            (row, cells[column.index].strip())
            for row, cells in enumerate(self.cells)
            if not _is_finite_number(cells[column.index])
        )
        problem = f"{text!r} is not a finite number" if text else "is empty"
        raise FileFormatError(f"{self.cell_location(row, column.name)}: {problem}; correct or remove the row")

    def text(self, column: Column) -> list[str]:
        """Return the cells of a column as text.

        Args:
            column: Column of this table.

        Returns:
            One text per row, without surrounding white space.
        """
        return [row[column.index].strip() for row in self.cells]


def parse_number(text: str) -> float:
    """Parse the number in a cell.

    Args:
        text: Text of the cell.

    Returns:
        The number, possibly infinite or not a number.

    Raises:
        ValueError: The text is not a number. Underscores such as in 1_000 are refused, although Python reads
            them.
    """
    if "_" in text:
        raise ValueError(text)
    return float(text)


def read_csv_table(path: PathLike) -> CsvTable:
    """Read a comma-separated UTF-8 file with `#` comments and one header row.

    Args:
        path: Path of the file.

    Returns:
        The table; `parse_csv_table` names the possible errors.
    """
    return parse_csv_table(os.fspath(path), enumerate(read_text(path).splitlines(), 1))


def parse_csv_table(source: str, numbered: Iterable[tuple[int, str]]) -> CsvTable:
    """Parse numbered lines of a CSV file, possibly of a part of it.

    Args:
        source: Name of the file, for messages.
        numbered: File line number and text of each line; the first one with content is the header.

    Returns:
        The table.

    Raises:
        FileFormatError: There is no row, the header is invalid, or a row has too few or too many cells.
    """
    comments: list[str] = []
    content: list[tuple[int, str]] = []
    for line_number, line in numbered:
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip()[1:].strip())
        elif line.strip(BLANK_CHARACTERS):
            content.append((line_number, line))
    if not content:
        raise FileFormatError(
            f"{source}: is empty; the first line must be a header such as joint_1[deg],…,x[mm],y[mm],z[mm]"
        )
    (header, header_text), rows = content[0], content[1:]
    where = f"{source}:{header}"
    columns = _parse_header(_split_cells(header_text, where), where)
    cells = _LazyRows(source, rows)
    for i, (line_number, text) in enumerate(rows):
        count = len(cells[i]) if '"' in text else text.count(",") + 1
        if count != len(columns):
            raise FileFormatError(
                f"{source}:{line_number}: {count} values under a header of {len(columns)} columns; "
                "write one value per column in every row, with decimal points and commas between values"
            )
    if not rows:
        raise FileFormatError(f"{source}: no rows under the header in line {header}; add at least one row")
    lines = [line_number for line_number, _ in rows]
    return CsvTable(source, tuple(comments), columns, cells, lines, header, cells.parse_numbers())


class _LazyRows(Sequence[list[str]]):
    """Rows of comma-separated text, split on access: numeric columns are parsed without splitting."""

    def __init__(self, source: str, rows: Sequence[tuple[int, str]]):
        self._source, self._rows = source, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        line_number, line = self._rows[index]
        return _split_cells(line, f"{self._source}:{line_number}")

    def parse_numbers(self) -> dict[int, Array]:
        """Parse all columns that are numeric in the first row.

        Returns:
            Numbers, shape (m,) each, by column index; empty if a cell is quoted, or if a cell of such a
            column is not a number.
        """
        if any('"' in line for _, line in self._rows):
            return {}
        numeric = []
        for i, cell in enumerate(self[0]):
            with suppress(ValueError):
                float(cell)
                numeric.append(i)
        try:
            table = np.loadtxt(
                (line for _, line in self._rows), delimiter=",", comments=None, usecols=numeric, ndmin=2
            )
        except ValueError:
            return {}
        return dict(zip(numeric, np.ascontiguousarray(table.T), strict=True))


def _split_cells(line: str, where: str) -> list[str]:
    """Split one line, so that an unbalanced quote does not extend over the following lines."""
    try:
        return next(csv.reader([line]))
    except csv.Error as error:
        raise FileFormatError(f"{where}: not comma-separated text: {error}; correct this line") from error


def _parse_header(header: Sequence[str], where: str) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    for index, cell in enumerate(header):
        match = re.fullmatch(r"\s*([^\[\]]+?)\s*(?:\[\s*([^\[\]]*?)\s*\])?\s*", cell)
        if not match:
            quoted = cell if len(cell) <= _MAX_QUOTED_CELL else cell[: _MAX_QUOTED_CELL - 3] + "..."
            raise FileFormatError(
                f"{where}: header {quoted!r}: write name or name[unit], with commas between them"
            )
        name, unit = match[1], match[2] or ""
        if name in columns:
            raise FileFormatError(f"{where}: column {name!r} appears twice; remove one")
        columns[name] = Column(name, unit, index)
    if all(map(_is_finite_number, columns)):
        raise FileFormatError(
            f"{where}: numbers where the header must be; write one such as joint_1[deg],…,x[mm],y[mm],z[mm]"
        )
    return columns


def _is_finite_number(text: str) -> bool:
    with suppress(ValueError):
        return math.isfinite(parse_number(text))
    return False


def csv_text(columns: Mapping[str, Iterable[Any]], comments: Iterable[str] = ()) -> str:
    """Return the text of a CSV file.

    Args:
        columns: Values by header, all of one length m. Numbers are written with all digits, None as an empty
            cell.
        comments: Lines that precede the header, each after `# `.

    Returns:
        Comment lines, header and m rows.
    """
    out = io.StringIO()
    out.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return out.getvalue()
