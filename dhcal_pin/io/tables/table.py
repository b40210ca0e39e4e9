"""Tables of text and numbers, whatever file they come from.

A `DataTable` has a header cell for each of its c columns, and m rows with the line of the file that each
comes from. All readers of this package return one. Header cells `name` or `name[unit]` become `Column`
objects, and `DataTable.to_si` converts a column to SI units. Every error names the file, the line and the
column. Lines are counted from 1, as text editors and spreadsheets do.

Rows that cannot be used are not an error at first: they are moved to `DataTable.bad_rows` with the reason, so
that a reader can name all of them in one message or leave them out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...exceptions import DhcalError, FileFormatError, UnknownNameError
from ...formatting import format_lines
from ...messages import quote
from ...units import MAX_SI_VALUE, UNITS
from ..tabular import parse_number

if TYPE_CHECKING:
    from ...measurements.euler_angles import EulerAngles

# Largest number of rows of a table; reading them takes about 10 s and 1 GB.
MAX_ROWS = 1_000_000
# Units that a row under the header may have.
_KNOWN_UNITS = frozenset(unit for units in UNITS.values() for unit in units)
# Numbers with signs for thousands by their decimal sign: only decimals behind them make them unambiguous.
GROUPED_NUMBERS = {
    ".": re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+\.\d+"),
    ",": re.compile(r"[+-]?[1-9]\d{0,2}(?:\.\d{3})+,\d+"),
}
# Numbers that may have signs for thousands, or another decimal sign than the other numbers.
_AMBIGUOUS_NUMBER = re.compile(r"[+-]?\d{1,3}(?:[.,'’ \u00a0\u202f]\d{3})+(?:[.,]\d*)?")
# Other ways to write a unit: the degree sign, and the ordinal indicator that looks like it.
_UNIT_SYNONYMS = {"\u00b0": "deg", "\u00ba": "deg"}
# A header `name` or `name[unit]`; indices in the name, such as `name[0]`, are no units.
_HEADER = re.compile(r"\s*((?:[^\[\]]|\[\d+\])+?)\s*(?:\[(?!\d+\])\s*([^\[\]]*?)\s*\])?\s*")
# Least number of names in a header, and of numbers in a row under it.
_MIN_COLUMNS = 3
# Header of a measurement file, as an example in messages.
MEASUREMENT_HEADER = "joint_1[deg],…,x[mm],y[mm],z[mm]"


@frozen
class Column:
    """Header entry `name[unit]`."""

    name: str
    unit: str  # Unit in brackets; empty if the header has none
    index: int  # Position in the header, counted from 0

    def divisor(self, units: Mapping[str, float], where: str) -> float:
        """Return the divisor that converts the column to SI units."""
        if self.unit in units:
            return units[self.unit]
        if not self.unit:
            raise FileFormatError(f"{where}: {self.lacks_unit(units)}")
        raise UnknownNameError(
            f"{where}: column {self.name!r} has unit {self.unit!r}; {self._expected(units)}"
        )

    def lacks_unit(self, units: Mapping[str, float]) -> str:
        """Return the message that the column has no unit."""
        return f"column {self.name!r} has no unit; {self._expected(units)}"

    def _expected(self, units: Mapping[str, float]) -> str:
        return f"write one of {', '.join(f'{self.name}[{unit}]' for unit in units if unit.isascii())}"


@frozen(eq=False)
class DataTable:
    """Table of a file, or of a part of one, with m rows and c columns."""

    source: str  # Name of the file
    headers: tuple[str, ...]  # Header cell of each column, or its number if the file has no header
    cells: Sequence[Sequence[str]]  # Text of the cells of each row, m rows
    lines: Sequence[int]  # Line of each row in the file
    header_line: int  # Line of the header, or of the first row if the file has none
    comments: tuple[str, ...] = ()  # Text of the comment lines, without `#`
    # Numbers of the columns that were parsed already, shape (m,) each, by column index.
    numbers: Mapping[int, Array] = field(default_factory=dict)
    decimal: str = "."  # Decimal sign of the cells
    bad_rows: Mapping[int, str] = field(default_factory=dict)  # Reason why a row was left out, by line
    description: str = ""  # How the file is written, such as "semicolons, decimal commas"
    notes: tuple[str, ...] = ()  # Sentences on what was not read, such as further sheets
    units: tuple[str, ...] = ()  # Cells of the row of units under the header; empty if there is none
    header_example: str = MEASUREMENT_HEADER  # Header that is expected, for messages
    euler_angles: EulerAngles | None = None  # Angles that columns of rotation vectors were computed from
    file_headers: tuple[str, ...] = ()  # Header cells of the file if `headers` differ from them
    has_counts: bool = False  # Whether columns of joint values were counts of servos
    # Function that reads the table below lines of titles; None if the first line looks like the header.
    read_below_titles: Callable[[], DataTable] | None = None

    @classmethod
    def from_columns(
        cls, source: str, columns: Mapping[str, Array | Sequence[str]], lines: Sequence[int], **others: Any
    ) -> DataTable:
        """Build a table from its columns."""
        values = list(columns.values())
        numbers = {i: column for i, column in enumerate(values) if isinstance(column, np.ndarray)}
        rows = _ColumnRows(values, len(lines))
        return cls(source, tuple(columns), rows, lines, **{"header_line": 1, "numbers": numbers} | others)

    @contextmanager
    def notes_in_errors(self) -> Iterator[None]:
        """Add the notes to the message of an error."""
        try:
            yield
        except DhcalError as error:
            error.args = ("; ".join([str(error), *self.notes]),)
            raise

    @property
    def written_headers(self) -> tuple[str, ...]:
        """Header cells as the file has them."""
        return self.file_headers or self.headers

    @property
    def header_location(self) -> str:
        """File and line of the header, for messages."""
        return f"{self.source}:{self.header_line}"

    @cached_property
    def below_titles(self) -> DataTable | None:
        """Table below lines of titles; None if the first line looks like the header."""
        return self.read_below_titles() if self.read_below_titles is not None else None

    @cached_property
    def has_numbers_as_header(self) -> bool:
        """Whether most header cells are numbers, so that the file probably has no header."""
        cells = [cell for cell in self.headers if cell]
        return 2 * sum(math.isfinite(self._parse(cell)) for cell in cells) >= max(1, len(cells))

    @cached_property
    def columns(self) -> dict[str, Column]:
        """Columns by name; those without a name are left out."""
        if self.has_numbers_as_header:
            raise FileFormatError(
                f"{self.header_location}: numbers where the header must be; "
                f"write one such as {self.header_example}"
            )
        columns: dict[str, Column] = {}
        for index, cell in enumerate(self.headers):
            if not cell:
                continue
            match = _HEADER.fullmatch(cell)
            if not match:
                raise FileFormatError(
                    f"{self.header_location}: header {quote(cell)}: write name or name[unit], with commas "
                    "between them"
                )
            name, unit = match[1], _usual_unit(match[2] or "")
            if below := self.units[index] if self.units else "":
                if unit not in ("", below):
                    raise FileFormatError(
                        f"{self.header_location}: column {quote(name)} has unit {unit!r} in the header and "
                        f"{below!r} in the row under it; correct one"
                    )
                unit = below
            if name in columns:
                raise FileFormatError(
                    f"{self.header_location}: column {quote(name)} appears twice; remove one"
                )
            columns[name] = Column(name, unit, index)
        return columns

    def without_columns(self, names: Container[str]) -> DataTable:
        """Return a table whose `columns` lack some names."""
        out = replace(self)
        vars(out)["columns"] = {name: column for name, column in self.columns.items() if name not in names}
        return out

    def column_label(self, index: int) -> str:
        """Return how messages call a column: its name without the unit, or its number."""
        match = _HEADER.fullmatch(self.headers[index])
        name = match[1] if match else self.headers[index]
        return f"column {quote(name)}" if name else f"column {index + 1}"

    def cell_location(self, row: int, column: str) -> str:
        """Return file, line and column of a cell, for messages."""
        return f"{self.source}:{self.lines[row]}: column {column!r}"

    # ----------------------------------------------------------------------------------------- values
    def require_units(self, units: Mapping[str, Mapping[str, float]]) -> None:
        """Require the unit of each of some columns; an error names all that have none."""
        columns = [self.columns[name] for name in units if name in self.columns]
        missing = [column for column in columns if not column.unit]
        if missing:
            text = missing[0].lacks_unit(units[missing[0].name])
            others = ", ".join(quote(column.name) for column in missing[1:])
            others = f"; without a unit, too: {others}" if others else ""
            raise FileFormatError(f"{self.header_location}: {text}{others}")

    def to_si(self, column: Column, units: Mapping[str, float]) -> Array:
        """Return the numbers of a column in SI units."""
        values = self.finite_numbers(column) / column.divisor(units, self.header_location)
        too_large = np.flatnonzero(np.abs(values) > MAX_SI_VALUE)
        if too_large.size:
            row = int(too_large[0])
            text = self.cells[row][column.index].strip()
            raise FileFormatError(
                f"{self.cell_location(row, column.name)}: {text} {column.unit} is beyond "
                f"{MAX_SI_VALUE:g} {next(iter(units))}; correct the number or the unit"
            )
        return values

    def finite_numbers(self, column: Column) -> Array:
        """Return the numbers of a column, in the column's own unit."""
        values = self.values(column.index)
        wrong = np.flatnonzero(~np.isfinite(values))
        if wrong.size:
            row = int(wrong[0])
            raise FileFormatError(
                f"{self.source}:{self.lines[row]}: {self._bad_cell(row, column.index)}; "
                "correct or remove the row"
            )
        return values

    def values(self, index: int) -> Array:
        """Return the numbers of a column."""
        known = self.numbers.get(index)
        return known if known is not None else np.array([self._parse(row[index]) for row in self.cells])

    def text(self, column: Column) -> list[str]:
        """Return the cells of a column as text."""
        return [row[column.index].strip() for row in self.cells]

    def _parse(self, cell: str) -> float:
        """Return the number in a cell, NaN if it is none."""
        other = "." if self.decimal == "," else ","
        if other in cell:
            if not GROUPED_NUMBERS[self.decimal].fullmatch(cell.strip()):
                return math.nan
            cell = cell.replace(other, "")
        with suppress(ValueError):
            return parse_number(cell.replace(self.decimal, "."))
        return math.nan

    def _bad_cell(self, row: int, index: int) -> str:
        """Return why a cell is not a finite number."""
        text = self.cells[row][index].strip()
        return self.bad_number(text, index) if text else f"{self.column_label(index)} is empty"

    def bad_number(self, text: str, index: int) -> str:
        """Return why a text in a column is not a finite number."""
        signs = " with decimal commas" if self.decimal == "," else ""
        if _AMBIGUOUS_NUMBER.fullmatch(text):
            signs = f" with decimal {'commas' if signs else 'points'}: write it without thousands separators"
        return f"{self.column_label(index)}: {quote(text)} is not a finite number{signs}"

    def thinned(self, max_rows: int) -> DataTable:
        """Return a table with at most a number of rows, drawn at random, and a note if some are left out."""
        count = len(self.lines)
        if count <= max_rows:
            return self
        # Rows at regular distances could all be of one target, or none of them held out.
        rows = np.sort(np.random.default_rng(0).permutation(count)[:max_rows])
        note = f"{max_rows} of {count} rows are used, drawn at random, as more do not improve a calibration"
        return replace(self._with_rows(rows.tolist()), notes=(*self.notes, note))

    def _with_rows(self, rows: Sequence[int]) -> DataTable:
        """Return a table with some of the rows."""
        return replace(
            self,
            cells=self.cells.take(rows)
            if isinstance(self.cells, _ColumnRows)
            else [self.cells[row] for row in rows],
            lines=[self.lines[row] for row in rows],
            numbers={index: column[rows] for index, column in self.numbers.items()},
        )

    # --------------------------------------------------------------------------------------- bad rows
    def without_bad_rows(self, numbers: Iterable[int], texts: Iterable[int] = ()) -> DataTable:
        """Move the rows with a missing value to `bad_rows`."""
        values = {index: self.values(index) for index in numbers}
        reasons: dict[int, str] = {}
        for index, column in values.items():
            for row in np.flatnonzero(~np.isfinite(column)).tolist():
                reasons.setdefault(row, self._bad_cell(row, index))
        for index in texts:
            for row, cells in enumerate(self.cells):
                if not cells[index].strip():
                    reasons.setdefault(row, f"{self.column_label(index)} is empty")
        return replace(self, numbers={**self.numbers, **values}).without_rows(reasons)

    def without_rows(self, reasons: Mapping[int, str]) -> DataTable:
        """Move rows to `bad_rows`, each with the reason why it cannot be used."""
        if not reasons:
            return self
        bad = {self.lines[row]: reason for row, reason in reasons.items()}
        rows = [row for row in range(len(self.lines)) if row not in reasons]
        return replace(self._with_rows(rows), bad_rows=dict(sorted({**self.bad_rows, **bad}.items())))

    def require_good_rows(self, alternative: str = "") -> None:
        """Require that no row was left out."""
        if not self.bad_rows:
            return
        line, reason = next(iter(self.bad_rows.items()))
        what, others = "the row", ""
        if not len(self.lines):
            alternative = ""
        if len(self.bad_rows) > 1:
            what = "them"
            others = f"; {len(self.bad_rows)} rows cannot be used: lines {format_lines(self.bad_rows)}"
        raise FileFormatError(
            f"{self.source}:{line}: {reason}{others}; correct or remove {what}{alternative}"
        )


def units_under_header(headers: Sequence[str], cells: Sequence[str]) -> tuple[str, ...]:
    """Return the unit of each column if a row has units and no numbers, and nothing if it is another row.

    >>> units_under_header(["joint_1", "x", "set"], ["[deg]", "mm", "-"])
    ('deg', 'mm', '')
    """
    units = ["" if cell.strip() == "-" else _usual_unit(cell.strip(" []()")) for cell in cells]
    if not _KNOWN_UNITS.intersection(units) or any(map(_is_number, units)):
        return ()
    return (*units, *[""] * len(headers))[: len(headers)]


def _usual_unit(unit: str) -> str:
    """Return the usual way to write a unit."""
    return _UNIT_SYNONYMS.get(unit, unit)


def find_header(rows: Sequence[Sequence[str]]) -> int | None:
    """Return the index of the first row of names above numbers, or above units and numbers; None without it.

    >>> find_header([["Job", "7"], ["J1", "J2", "x"], ["deg", "deg", "mm"], ["1", "2", "3"]])
    1
    """
    for i, cells in enumerate(rows):
        filled = [cell for cell in cells if cell]
        n_names = sum(not _is_number(cell) for cell in filled)
        if n_names >= _MIN_COLUMNS and 2 * n_names > len(filled):
            for below in rows[i + 1 : i + 3]:
                is_as_wide = not any(below[_width(cells) :])
                if is_as_wide and sum(map(_is_number, below)) >= _MIN_COLUMNS:
                    return i
    return None


def _width(cells: Sequence[str]) -> int:
    """Return the number of cells up to the last one with content."""
    return max((i for i, cell in enumerate(cells, 1) if cell), default=0)


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number with either decimal sign."""
    if any(pattern.fullmatch(cell) for pattern in GROUPED_NUMBERS.values()):
        return True
    with suppress(ValueError):
        parse_number(cell.replace(",", "."))
        return True
    return False


def require_few_rows(source: str, count: int) -> None:
    """Require that a table is small enough for the memory."""
    if count > MAX_ROWS:
        raise FileFormatError(
            f"{source}: {count} rows, more than {MAX_ROWS}; keep one in "
            f"{-(-count // MAX_ROWS)} of them, or calibrate with `calibrate_stream` of the Python package"
        )


class _ColumnRows(Sequence[list[str]]):
    """Rows of a table that is stored by columns; cells are made on access."""

    def __init__(self, columns: Sequence[Array | Sequence[str]], count: int):
        self._columns, self._count = columns, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        if not -self._count <= index < self._count:
            raise IndexError(index)
        return [
            repr(float(column[index])) if isinstance(column, np.ndarray) else column[index]
            for column in self._columns
        ]

    def take(self, rows: Sequence[int]) -> _ColumnRows:
        """Return some of the rows."""
        columns = [
            column[rows] if isinstance(column, np.ndarray) else [column[row] for row in rows]
            for column in self._columns
        ]
        return _ColumnRows(columns, len(rows))
