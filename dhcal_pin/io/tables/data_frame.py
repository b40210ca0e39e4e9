"""Tables in memory, such as pandas data frames, and Parquet files.

Any object with `columns` and a column under each of their names is a data frame. Its rows are numbered from
1. Parquet files need pyarrow (`pip install 'dhcal-pin[parquet]'`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..._typing import Array, PathLike
from ...exceptions import FileFormatError
from ..tabular import unreadable
from .table import DataTable, require_few_rows
from .text import TextLayout, detect_decimal

# Kinds of NumPy arrays that are numbers, and that are times.
_NUMERIC_KINDS, _TIME_KINDS = "fiu", "mM"
# Texts of missing values.
_MISSING = frozenset(("None", "nan", "NaN", "NaT", "<NA>"))


def is_data_frame(source: Any) -> bool:
    """Return whether an object is a data frame."""
    return not isinstance(source, str | os.PathLike) and hasattr(source, "columns")


def data_frame_table(frame: Any) -> DataTable:
    """Make a table from a data frame."""
    columns = {}
    for name in frame.columns:
        values = np.asarray(frame[name])
        if values.ndim != 1:
            raise FileFormatError(f"DataFrame: column {name!r} appears twice; remove one")
        columns[str(name)] = values
    return _table_of_arrays(columns, "DataFrame", "data frame")


def read_parquet(path: PathLike, layout: TextLayout) -> DataTable:
    """Read a table from a Parquet file."""
    del layout
    source = os.fspath(path)
    try:
        import pyarrow  # lazy import: an optional package
        import pyarrow.parquet
    except ImportError:
        raise FileFormatError(
            f"{source}: reading Parquet files needs pyarrow; install it with "
            "pip install 'dhcal-pin[parquet]', or save the table as CSV"
        ) from None
    try:
        with pyarrow.parquet.ParquetFile(source) as file:
            require_few_rows(source, file.metadata.num_rows)
            table = file.read()
    except OSError as error:
        raise unreadable(source, error) from error
    except pyarrow.ArrowInvalid as error:
        raise FileFormatError(f"{source}: not a Parquet file: {error}; save the table again") from error
    columns = {
        name: table.column(name).to_numpy() for name in table.column_names if not name.startswith("__index")
    }
    return _table_of_arrays(columns, source, "Parquet")


def _table_of_arrays(columns: Mapping[str, Array], source: str, description: str) -> DataTable:
    """Make a table from arrays, (m,) each, with numbers or other objects."""
    values: dict[str, Array | Sequence[str]] = {
        name: column.astype(float) if column.dtype.kind in _NUMERIC_KINDS else _texts(column)
        for name, column in columns.items()
    }
    count = len(next(iter(columns.values()), ()))
    if not count:
        raise FileFormatError(f"{source}: has no rows; add at least one")
    texts = [cell for column in values.values() if isinstance(column, list) for cell in column]
    return DataTable.from_columns(
        source, values, range(1, count + 1), description=description, decimal=detect_decimal(texts)
    )


def _texts(column: Array) -> list[str]:
    """Return objects (m,) as texts, empty for missing values."""
    cells = column.astype(str) if column.dtype.kind in _TIME_KINDS else column
    texts = [str(cell).strip() for cell in cells.tolist()]
    return ["" if text in _MISSING else text for text in texts]
