"""Tables in text files: separators, decimal signs, comments, header.

What the layout of a file does not state is detected from its lines:

- Separator: of comma, semicolon, tab and runs of spaces the one under which most rows have as many cells as
  the header, and most of their cells are numbers. Commas are preferred among equals.
- Decimal sign: a comma, if there are numbers with a decimal comma and none with a decimal point. Numbers
  with separated thousands, such as `1.234,5`, decide it.

Lines are split one by one, so that an unbalanced quote does not extend over the following lines. A row with
another number of cells than the header is a bad row; empty cells at the end of a row do not count.

Files are UTF-8. Only comments may be in the encoding of Windows, as no number and no name depends on them.
"""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..._frozen import frozen
from ..._typing import Array, PathLike
from ...exceptions import FileFormatError
from ..tabular import MAX_TABLE_BYTES, decode_text, parse_number, read_limited_bytes
from .table import (
    GROUPED_NUMBERS,
    MEASUREMENT_HEADER,
    DataTable,
    find_header,
    require_few_rows,
    units_under_header,
)

# Characters of a line without content: spreadsheets write empty rows as separators only.
BLANK_CHARACTERS = " \t,;"
# Separator characters by their names; None for any white space. The order is that of preference.
SEPARATORS: Mapping[str, str | None] = {",": ",", ";": ";", "tab": "\t", "space": None}
# Names of separators in descriptions.
_SEPARATOR_NAMES = {",": "commas", ";": "semicolons", "tab": "tabs", "space": "spaces"}
# Longest line of a table.
MAX_LINE_LENGTH = 1 << 20
# Rows that the separator and the decimal sign are detected from.
_N_SEPARATOR_ROWS, _N_DECIMAL_ROWS = 50, 2000
# A number without and with a decimal sign.
_INTEGER = re.compile(r"[+-]?\d+(?:[eE][+-]?\d+)?")
_DECIMALS = {sign: re.compile(rf"[+-]?(?:\d+\{sign}\d*|\{sign}\d+)(?:[eE][+-]?\d+)?") for sign in ".,"}

# Formats that are taken for tables by mistake, by how their first lines begin in lower case.
_OTHER_FORMATS = {
    "HTML": re.compile(r"<!doctype html|<html"),
    # A joint may be called <b>.
    "XML": re.compile(r"<[?!]|<[a-z][^<>]*(>\s*(<|$)|$)"),
    "TOML": re.compile(r"\[\[?[\w.\"' -]+\]\]?\s*(#|$)|[\w.\"'-]+\s*="),
    "JSON": re.compile(r"\{|\[\s*([\[{\"]|$)"),
}


@frozen
class TextLayout:
    """How a file is divided into cells."""

    separator: str = ""  # Key of `SEPARATORS`; empty if it is to be detected
    decimal: str = ""  # Decimal sign; empty if it is to be detected
    sheet: str = ""  # Sheet of a workbook; empty if it is to be detected
    names: Set[str] = frozenset()  # Names of columns by which a sheet is detected
    skip: int = 0  # Number of lines before the header
    has_header: bool = True  # Whether the first row is a header
    # Start of a comment line; empty if there are none.
    comment: str = "#"
    encoding: str = "utf-8"  # Encoding of the file
    header_example: str = MEASUREMENT_HEADER  # Header that is expected, for messages


# Layout of a file of which nothing is known.
DETECTED = TextLayout()
# Encoding of Windows in Western Europe and America.
_WINDOWS = "cp1252"
# All positions at which `str.splitlines` divides text of ASCII characters.
_LINE_STARTS = re.compile(rb"(?<=[\n\r\x0b\x0c\x1c-\x1e])")


def _decode(path: PathLike, data: bytes, layout: TextLayout) -> str:
    """Decode a text file; comments that are not UTF-8 are taken for the encoding of Windows."""
    try:
        return decode_text(path, data, layout.encoding)
    except FileFormatError:
        if not layout.comment or b"\0" in data or layout.encoding != DETECTED.encoding:
            raise
    return decode_text(path, b"".join(_comments_in_utf8(data, layout.comment.encode())), layout.encoding)


def _comments_in_utf8(data: bytes, sign: bytes) -> Iterator[bytes]:
    """Yield the lines of a file with the comments in UTF-8."""
    for line in _LINE_STARTS.split(data):
        if not line.lstrip().startswith(sign):
            yield line
            continue
        try:
            line.decode()
            yield line
        except UnicodeDecodeError:
            yield line.decode(_WINDOWS, "replace").encode()


def read_text_table(path: PathLike, layout: TextLayout) -> DataTable:
    """Read a table from a text file."""
    source, data = os.fspath(path), read_limited_bytes(path, MAX_TABLE_BYTES)
    text = _decode(path, data, layout)
    # The other lines are the header and comments.
    sign = layout.comment
    n_comments = text.startswith(sign) + text.count(f"\n{sign}") if sign else 0
    require_few_rows(source, text.count("\n") - n_comments - 1)
    lines = text.splitlines()
    lengths = list(map(len, lines))
    if (longest := max(lengths, default=0)) > MAX_LINE_LENGTH:
        raise FileFormatError(
            f"{source}:{lengths.index(longest) + 1}: a line of {longest} characters, more than "
            f"{MAX_LINE_LENGTH}; check that the file is a table"
        )
    return parse_lines(source, enumerate(lines, 1), layout)


def parse_lines(source: str, numbered: Iterable[tuple[int, str]], layout: TextLayout = DETECTED) -> DataTable:
    """Parse numbered lines of a text file, possibly of a part of it."""
    comments: list[str] = []
    content: list[tuple[int, str]] = []
    for line_number, line in numbered:
        if line_number <= layout.skip or not line.strip(BLANK_CHARACTERS):
            continue
        if layout.comment and line.lstrip().startswith(layout.comment):
            comments.append(line.lstrip()[len(layout.comment) :].strip())
        else:
            content.append((line_number, line))
    if not content:
        raise FileFormatError(
            f"{source}: is empty; the first line must be a header such as {layout.header_example}"
        )
    texts = [line for _, line in content]
    if name := _other_format(texts):
        raise FileFormatError(
            f"{source}:{content[0][0]}: is {name}, not a table; expected a table with a header such as "
            f"{layout.header_example}"
        )
    separator = layout.separator or _detect_separator(texts[:_N_SEPARATOR_ROWS])
    split = _splitter(separator)
    header_line, header = content[0]
    try:
        headers = [cell.strip() for cell in split(header)]
    except csv.Error as error:
        raise FileFormatError(f"{source}:{header_line}: {error}; correct the header") from error
    if not layout.has_header:
        headers = [str(number) for number in range(1, len(headers) + 1)]
    while headers and not headers[-1]:
        headers.pop()
    rows = content[layout.has_header :]
    has_two = layout.has_header and len(rows) > 1
    units = units_under_header(headers, _split_stripped(rows[0][1], separator)) if has_two else ()
    rows = rows[bool(units) :]
    if not rows:
        raise FileFormatError(
            f"{source}: no rows under the header in line {header_line}; add at least one row"
        )
    good, bad = _divide_rows(rows, separator, len(headers))
    body = [line for _, line in good]
    decimal = layout.decimal or _decimal_of_lines(body[:_N_DECIMAL_ROWS], separator)
    name = _SEPARATOR_NAMES[separator]
    return DataTable(
        source,
        tuple(headers),
        _TextRows(body, split),
        [line_number for line_number, _ in good],
        header_line,
        tuple(comments),
        _parse_numbers(body, separator, decimal),
        decimal,
        bad,
        f"{name}, decimal commas" if decimal == "," else name,
        units=units,
        header_example=layout.header_example,
        read_below_titles=_reader_below_titles(source, content, layout) if layout.has_header else None,
    )


def _other_format(lines: Sequence[str]) -> str:
    """Return the format of lines that are no table; empty if they may be one."""
    first = lines[0].lstrip().lower()
    name = next((name for name, start in _OTHER_FORMATS.items() if start.match(first)), "")
    if name != "TOML":
        return name
    import tomllib  # lazy import: slow to load

    # Titles above a table may look like the first line of TOML.
    try:
        tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError:
        return ""
    return name


def _reader_below_titles(
    source: str, content: Sequence[tuple[int, str]], layout: TextLayout
) -> Callable[[], DataTable] | None:
    """Return the function that reads a table below lines of titles, None without such lines."""
    first = content[:_N_SEPARATOR_ROWS]
    separators = [layout.separator] if layout.separator else SEPARATORS
    found = []
    for name in separators:
        header = find_header([_split_stripped(line, name) for _, line in first])
        if header == 0:
            return None
        found += [] if header is None else [header]
    if not found:
        return None
    header = min(found)
    return partial(parse_lines, source, content, replace(layout, skip=content[header][0] - 1))


class _TextRows(Sequence[list[str]]):
    """Rows of separated text, split on access: numeric columns are parsed without splitting."""

    def __init__(self, rows: Sequence[str], split: Callable[[str], list[str]]):
        self._rows, self._split = rows, split

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        return self._split(self._rows[int(index)])


def _splitter(separator: str) -> Callable[[str], list[str]]:
    """Return the function that splits a line; `csv.Error` if a cell is too long."""
    character = SEPARATORS[separator]
    if character is None:
        return str.split
    return lambda line: next(csv.reader([line], delimiter=character))


def _divide_rows(
    rows: Sequence[tuple[int, str]], separator: str, width: int
) -> tuple[list[tuple[int, str]], dict[int, str]]:
    """Return the rows that have a cell for each column, and the reasons why the others do not, by line."""
    character = SEPARATORS[separator]
    if character is not None and all(text.count(character) == width - 1 for _, text in rows):
        limit = csv.field_size_limit()
        if not any('"' in text or len(text) > limit for _, text in rows):
            return list(rows), {}
    split, name = _splitter(separator), _SEPARATOR_NAMES[separator]
    counts: dict[int, int] = {}
    bad: dict[int, str] = {}
    for line_number, text in rows:
        try:
            counts[line_number] = _count_cells(text, separator, split)
        except csv.Error as error:
            bad[line_number] = f"not text separated by {name}: {error}"
    # A decimal comma among commas makes a cell more, which an empty last cell may hide.
    frequency = Counter(counts.values())
    usual = max(frequency, key=lambda count: (frequency[count], -count), default=width)
    good: list[tuple[int, str]] = []
    for line_number, text in rows:
        count = counts.get(line_number, -1)
        if count == width or (
            count > width
            and (count == usual or separator != ",")
            and not any(cell.strip() for cell in split(text)[width:])
        ):
            good.append((line_number, text))
        elif count >= 0:
            hint = " and decimal points" if separator == "," else ""
            if hint and count > width:
                hint += "; decimal commas need semicolons"
            values, columns = (
                f"{n} {word}{'s' * (n != 1)}" for n, word in ((count, "value"), (width, "column"))
            )
            bad[line_number] = f"{values} for {columns}, with {name} between them{hint}"
    return good, dict(sorted(bad.items()))


def _count_cells(text: str, separator: str, split: Callable[[str], list[str]]) -> int:
    """Return the number of cells of a row; `csv.Error` if one is too long."""
    character = SEPARATORS[separator]
    if character is None or '"' in text or len(text) > csv.field_size_limit():
        return len(split(text))
    return text.count(character) + 1


def _detect_separator(lines: Sequence[str]) -> str:
    """Return the separator of a file from its header and first rows."""
    scores: dict[str, tuple[float, int]] = {}
    candidates = [name for name in SEPARATORS if len(_split_stripped(lines[0], name)) > 1]
    for name in candidates if len(candidates) > 1 else ():
        rows = [_split_stripped(line, name) for line in lines]
        width = len(rows[0])
        fitting = [row for row in rows[1:] if len(row) <= width]
        n_numbers = sum(_is_decimal(cell) for row in fitting for cell in row)
        scores[name] = n_numbers / (width * max(1, len(rows) - 1)), width
    return max(scores, key=lambda name: scores[name], default=candidates[0] if candidates else ",")


def _split_stripped(line: str, separator: str) -> list[str]:
    """Return the cells of a line without empty ones at its end; none if the line cannot be split."""
    try:
        cells = [cell.strip() for cell in _splitter(separator)(line)]
    except csv.Error:
        return []
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _is_decimal(cell: str) -> bool:
    """Return whether a cell is a number with either decimal sign."""
    return any(
        pattern.fullmatch(cell) for pattern in (_INTEGER, *_DECIMALS.values(), *GROUPED_NUMBERS.values())
    )


def _decimal_of_lines(rows: Sequence[str], separator: str) -> str:
    """Return the decimal sign of rows that are not split yet."""
    if not any("," in line and (separator != "," or '"' in line) for line in rows):
        return "."
    split = _splitter(separator)
    return detect_decimal(cell for line in rows for cell in split(line))


def detect_decimal(cells: Iterable[str]) -> str:
    """Return the decimal sign of some cells."""
    cells = [cell.strip() for cell in cells]
    for patterns in (GROUPED_NUMBERS, _DECIMALS):
        has = {sign: any(map(pattern.fullmatch, cells)) for sign, pattern in patterns.items()}
        if has["."] or has[","]:
            return "." if has["."] else ","
    return "."


def _parse_numbers(rows: Sequence[str], separator: str, decimal: str) -> dict[int, Array]:
    """Parse all columns that are numeric in the first row."""
    has_points = decimal == "," and any("." in line for line in rows)
    if not rows or has_points or any('"' in line for line in rows):
        return {}
    numeric = []
    for i, cell in enumerate(_splitter(separator)(rows[0])):
        with suppress(ValueError):
            parse_number(cell.replace(decimal, "."))
            numeric.append(i)
    if not numeric:
        return {}
    lines = (line.replace(",", ".") for line in rows) if decimal == "," else rows
    try:
        table = np.loadtxt(lines, delimiter=SEPARATORS[separator], comments=None, usecols=numeric, ndmin=2)
    except ValueError:
        return {}
    return dict(zip(numeric, np.ascontiguousarray(table.T), strict=True))
