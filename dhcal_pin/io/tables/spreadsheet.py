"""Tables in Excel workbooks, read with openpyxl (`pip install 'dhcal-pin[excel]'`).

The sheet that the layout names is read, else the one with the most known columns, and of several ones the one
with the most rows of several numbers. The rows are numbered as in Excel. Rows whose only cell starts with `#`
are comments, as in a text file. Of a formula the value is read that Excel saved with it.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence, Set
from dataclasses import replace
from datetime import date, datetime, time
from functools import partial
from typing import Any
from zipfile import BadZipFile, ZipFile

from ..._typing import PathLike
from ...exceptions import FileFormatError, UnknownNameError
from ..tabular import unreadable
from .table import DataTable, find_header, units_under_header
from .text import TextLayout, detect_decimal

# Largest size of all sheets and texts of a workbook [byte]; openpyxl reads 4 MiB per second.
MAX_XML_BYTES = 32 << 20

# Rows in which a header below titles is looked for.
_N_TITLE_ROWS = 50


def read_spreadsheet(path: PathLike, layout: TextLayout) -> DataTable:
    """Read a table from an Excel workbook."""
    source = os.fspath(path)
    try:
        from openpyxl import load_workbook  # lazy import: an optional package
        from openpyxl.utils.exceptions import InvalidFileException
    except ImportError:
        raise FileFormatError(
            f"{source}: reading Excel files needs openpyxl; install it with pip install 'dhcal-pin[excel]', "
            "or save the sheet as CSV"
        ) from None
    try:
        _require_small(path, source)
        with warnings.catch_warnings():
            # Unknown extensions of a workbook, such as charts, do not matter here.
            warnings.simplefilter("ignore", UserWarning)
            workbook = load_workbook(path, read_only=True, data_only=True)
            sheets = {
                sheet.title: _numbered_rows(sheet.iter_rows(values_only=True))
                for sheet in workbook.worksheets
            }
            workbook.close()
    except FileFormatError:  # also a ValueError
        raise
    except OSError as error:
        raise unreadable(source, error) from error
    except (BadZipFile, InvalidFileException, KeyError, ValueError) as error:
        raise FileFormatError(f"{source}: not an Excel workbook: {error}; save it as .xlsx") from error
    filled = {title: rows for title, rows in sheets.items() if rows}
    if not filled:
        raise FileFormatError(
            f"{source}: is empty; the first row must be a header such as {layout.header_example}"
        )
    if layout.sheet and layout.sheet not in filled:
        raise UnknownNameError(
            f"{source}: no sheet {layout.sheet!r} with content; choose from {', '.join(map(repr, filled))}"
        )
    title = layout.sheet or max(filled, key=lambda each: _likelihood(filled[each], layout.names))
    rows = filled[title]
    others = [other for other in filled if other != title]
    notes = (f"sheet {title!r} was read, not {', '.join(map(repr, others))}",) if others else ()
    return _build_table(source, rows, layout, f"Excel sheet {title!r}", notes)


def _require_small(path: PathLike, source: str) -> None:
    """Require that the unpacked sheets and texts of a workbook are small enough to be read in seconds."""
    with ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist() if entry.filename.endswith(".xml"))
    if size > MAX_XML_BYTES:
        raise FileFormatError(
            f"{source}: a workbook of {size >> 20} MiB when unpacked, more than {MAX_XML_BYTES >> 20} MiB; "
            "save the sheet as CSV"
        )


def _numbered_rows(rows: Iterable[Sequence[Any]]) -> list[tuple[int, list[Any]]]:
    """Return the values of the rows with content, with their numbers; empty cells are empty texts."""
    values = (
        (number, ["" if value is None else value for value in row]) for number, row in enumerate(rows, 1)
    )
    return [(number, cells) for number, cells in values if any(cell != "" for cell in cells)]


def _likelihood(rows: Sequence[tuple[int, Sequence[Any]]], names: Set[str]) -> tuple[int, int]:
    """Return what makes a sheet likely: the number of known columns in a header, and of rows of numbers."""
    texts = ([cell for cell in cells if isinstance(cell, str)] for _, cells in rows)
    known = (sum(bool(names & {text, text.partition("[")[0].strip()}) for text in row) for row in texts)
    return max(known) if len(rows) > 1 else 0, sum(map(_has_numbers, rows))


def _has_numbers(row: tuple[int, Sequence[Any]]) -> bool:
    """Return whether a row has as many numbers as the smallest table of measurements: three."""
    return sum(isinstance(cell, int | float) and not isinstance(cell, bool) for cell in row[1]) >= 3


def _cell_text(value: Any, decimal: str) -> str:
    """Return the text of a cell; numbers with all digits."""
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    return repr(value).replace(".", decimal) if isinstance(value, float) else str(value).strip()


def _build_table(
    source: str,
    rows: list[tuple[int, list[Any]]],
    layout: TextLayout,
    description: str,
    notes: tuple[str, ...],
) -> DataTable:
    """Divide the rows of a sheet into comments, header and data."""
    comments: list[str] = []
    content: list[tuple[int, list[Any]]] = []
    for number, cells in rows:
        first, *others = [cell for cell in cells if cell != ""]
        if number <= layout.skip:
            continue
        if layout.comment and not others and str(first).startswith(layout.comment):
            comments.append(str(first).removeprefix(layout.comment).strip())
        else:
            content.append((number, cells))
    if len(content) <= layout.has_header:
        raise FileFormatError(f"{source}: no rows under the header; add at least one row")
    decimal = layout.decimal or detect_decimal(
        cell for _, cells in content for cell in cells if isinstance(cell, str)
    )
    texts = [(number, [_cell_text(cell, decimal) for cell in cells]) for number, cells in content]
    header = find_header([cells for _, cells in texts[:_N_TITLE_ROWS]]) if layout.has_header else 0
    read_below_titles = None
    if header:
        below = replace(layout, skip=texts[header][0] - 1)
        read_below_titles = partial(_build_table, source, rows, below, description, notes)
    header_line, headers = texts[0]
    data = texts[layout.has_header :]
    units = units_under_header(headers, data[0][1]) if layout.has_header and data[1:] else ()
    data = data[bool(units) :]
    while headers and not headers[-1] and not any("".join(cells[len(headers) - 1 :]) for _, cells in data):
        headers.pop()
    width = len(headers)
    return DataTable(
        source,
        tuple(headers if layout.has_header else map(str, range(1, width + 1))),
        [(cells + [""] * width)[:width] for _, cells in data],
        [number for number, _ in data],
        header_line,
        tuple(comments),
        decimal=decimal,
        description=description,
        notes=notes,
        units=units[:width],
        header_example=layout.header_example,
        read_below_titles=read_below_titles,
    )
