"""Standard output and standard error, whose reader may have gone and whose disk may be full.

What is printed on standard output is the result, so it is an error if that cannot be written. Messages on
standard error change neither the result nor the exit status.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TextIO

from ...exceptions import FileFormatError


def print_result(text: str, noun: str, remedy: str = "expected an open file or pipe") -> None:
    """Print a text on standard output; `UnicodeEncodeError` if its encoding lacks a character."""
    if sys.stdout is None:
        raise FileFormatError(f"standard output is closed; {remedy}")
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        _discard(sys.stdout)
        raise FileFormatError(
            f"standard output: cannot write the {noun}: {error.strerror}; {remedy}"
        ) from error


def print_message(text: str) -> None:
    """Print lines on standard error, if anything reads it."""
    if sys.stderr is None:
        return
    try:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
    except OSError:
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    """Discard what a stream still holds; Python would try to write it at its end, and print a traceback."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
