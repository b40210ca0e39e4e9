"""Measurement files that are read in parts, for files that are larger than the memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial

from ..._typing import PathLike
from ...estimation.problem import CHUNK_SIZE
from ...measurements.base import Measurement
from ...robot.chain import Chain
from ..tables import parse_lines
from ..tables.text import BLANK_CHARACTERS
from ..tabular import decode_text, unreadable
from .columns import with_known_spelling
from .reading import parse_measurements

# Samples, or a function that reads them. The function is small enough to be sent to another process.
Part = Measurement | Callable[[], Measurement]


def iter_measurements(
    path: PathLike, chain: Chain, rows: int = CHUNK_SIZE
) -> Iterator[Callable[[], Measurement]]:
    """Divide a measurement file into parts that are read later, one by one.

    The file must be accessible under this path wherever the parts are read: on a cluster, for all workers.

    Args:
        path: Text file with the project's own columns.
        chain: Robot that was measured.
        rows: Largest number of rows of a part.

    Yields:
        Function that reads the samples to be fitted of one part.

    Raises:
        FileFormatError: The file cannot be read. Errors in its content are raised when a part is read.
    """
    source = os.fspath(path)
    blank = f"{BLANK_CHARACTERS}\r\n".encode()
    header: tuple[int, str] | None = None
    # First byte, first line and number of rows of the current part.
    start = first_line = count = 0
    try:
        with open(path, "rb") as file:
            end = 0
            for line_number, line in enumerate(file, 1):
                end += len(line)
                if not line.strip(blank) or line.lstrip().startswith(b"#"):
                    continue
                if header is None:
                    header = line_number, decode_text(source, line, first_line=line_number).rstrip("\r\n")
                    start, first_line = end, line_number + 1
                    continue
                count += 1
                if count == rows:
                    yield partial(_read_part, source, chain, header, first_line, start, end)
                    start, first_line, count = end, line_number + 1, 0
    except OSError as error:
        raise unreadable(source, error) from error
    # A file without rows has one empty part, so that reading it raises the error.
    if header is not None and (count or first_line == header[0] + 1):
        yield partial(_read_part, source, chain, header, first_line, start, end)


def _read_part(
    source: str, chain: Chain, header: tuple[int, str], first_line: int, start: int, end: int
) -> Measurement:
    """Read the samples to be fitted between two byte positions of a file."""
    with open(source, "rb") as file:
        file.seek(start)
        data = file.read(end - start)
    lines = decode_text(source, data, first_line=first_line).splitlines()
    table = parse_lines(source, [header, *enumerate(lines, first_line)])
    return parse_measurements(with_known_spelling(table, chain), chain).fit
