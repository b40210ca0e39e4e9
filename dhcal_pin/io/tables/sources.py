"""Sources of tables: which reader reads which file.

To add a file format, add a module with a reader and one row to `FORMATS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple

from ..._typing import PathLike
from ...exceptions import FileFormatError, InvalidArgumentError
from .data_frame import data_frame_table, is_data_frame, read_parquet
from .spreadsheet import read_spreadsheet
from .table import DataTable
from .text import DETECTED, TextLayout, read_text_table


class TableFormat(NamedTuple):
    """File format of a table."""

    endings: tuple[str, ...]  # Endings of file names, lower case; none for the format of all other files
    read: Callable[[PathLike, TextLayout], DataTable]  # Function that reads a file


# Endings of files with sheets.
WORKBOOK_ENDINGS = (".xlsx", ".xlsm")
FORMATS = (
    TableFormat(WORKBOOK_ENDINGS, read_spreadsheet),
    TableFormat((".parquet", ".pq"), read_parquet),
    TableFormat((), read_text_table),
)
# Usual endings of tables in text; files with other endings are read as text, too.
_TEXT_ENDINGS = (".csv", ".tsv", ".txt", ".dat")
# Endings of files that cannot be read, and what to do with them.
_UNREADABLE = {
    ".xls": "save it as .xlsx",
    ".ods": "save it as .xlsx or .csv",
    ".bag": "convert it with `dhcal convert`",
    ".db3": "convert its folder with `dhcal convert`",
    ".mcap": "convert it with `dhcal convert`",
    **dict.fromkeys((".urdf", ".xacro", ".xml"), "expected a table of measurements"),
}


def has_table_ending(path: PathLike) -> bool:
    """Return whether a path has the ending of a table."""
    endings = (*_TEXT_ENDINGS, *(ending for form in FORMATS for ending in form.endings))
    return os.fspath(path).lower().endswith(endings)


def read_table(source: PathLike | Any, layout: TextLayout = DETECTED) -> DataTable:
    """Read a table from a file or a data frame."""
    if is_data_frame(source):
        return data_frame_table(source)
    if not isinstance(source, str | os.PathLike):
        raise InvalidArgumentError(
            f"source has type {type(source).__name__}; expected a path or a data frame"
        )
    name = os.fspath(source).lower()
    for ending, remedy in _UNREADABLE.items():
        if name.endswith(ending):
            raise FileFormatError(f"{os.fspath(source)}: {ending} files cannot be read; {remedy}")
    reader = next(form for form in FORMATS if not form.endings or name.endswith(form.endings))
    return reader.read(source, layout)
