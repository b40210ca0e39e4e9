"""Text files: UTF-8 text, TOML, and the text of CSV tables. Tables are read by the package `tables`."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any

from .._typing import PathLike
from ..exceptions import FileFormatError
from ..messages import escape_control_characters, quote

# Characters with a meaning in a header, which the names of joints and columns cannot have.
_RESERVED_CHARACTERS = frozenset(",;[]#\"'")
# First characters of a cell that spreadsheets execute as a formula.
_FORMULA_STARTS = ("=", "+", "-", "@")
# Largest table; a million rows have about 200 MiB.
MAX_TABLE_BYTES = 256 << 20
# Largest other text file, TOML file that a user writes, and sidecar [byte]. The uncertainty of the
# correction curves of 11 joints takes 21 MiB, that of the geometry of 64 joints 8 MiB.
MAX_TEXT_BYTES, MAX_TOML_BYTES, MAX_SIDECAR_BYTES = 64 << 20, 1 << 20, 24 << 20
# Text that encodes an array in base64, which is read fast; the parser takes 20 s for 24 MiB of other content.
_ENCODED_ARRAY = r"'''[A-Za-z0-9+/=\n]{1024,}+'''"
# Valid TOML that is refused: the pattern of each case, and what a message says.
_REFUSED_TOML = {
    # `tomllib` takes quadratic time for dotted keys.
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){64}""": (
        "a key of more than 64 parts; write shorter keys"
    ),
    # No path and no name can contain it.
    r"\\(?:u|U0000)0000": "a zero character in a text; remove it",
}


def read_bytes(path: PathLike, max_bytes: int = -1) -> bytes:
    """Read a file, or its first bytes."""
    try:
        with open(path, "rb") as file:
            return file.read(max_bytes)
    except (OSError, ValueError) as error:  # a path with a zero byte raises ValueError
        raise unreadable(path, error) from error


def unreadable(path: PathLike, error: Exception, expected: str = "a file") -> FileFormatError:
    """Make the error about a file that cannot be read."""
    reason = getattr(error, "strerror", None) or error
    return FileFormatError(f"{path}: cannot read it: {reason}; give the path of {expected}")


def read_text(path: PathLike, encoding: str = "utf-8", max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a text file."""
    return decode_text(path, read_limited_bytes(path, max_bytes), encoding)


def read_limited_bytes(path: PathLike, max_bytes: int) -> bytes:
    """Read a file that must not be larger than a size."""
    data = read_bytes(path, max_bytes + 1)
    if len(data) > max_bytes:
        raise FileFormatError(
            f"{path}: the file is larger than {size_text(max_bytes)}; check the path or shorten the file"
        )
    return data


def decode_text(path: PathLike, data: bytes, encoding: str = "utf-8", first_line: int = 1) -> str:
    """Decode a text file, or a part of it from a line on."""
    try:
        text = data.decode(encoding).removeprefix("\ufeff")
    except UnicodeError as error:
        name, start = encoding.upper(), getattr(error, "start", 0)
        line = first_line + data.count(b"\n", 0, start)
        is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        found = "the file is UTF-16," if is_utf16 else f"byte 0x{data[start : start + 1].hex()} is"
        raise FileFormatError(f"{path}:{line}: {found} not {name}; save the file as {name}") from error
    if "\0" in text:
        line = first_line + text.count("\n", 0, text.index("\0"))
        raise FileFormatError(
            f"{path}:{line}: a zero byte, as in UTF-16; save the file as {encoding.upper()}"
        )
    return text


def size_text(size: int) -> str:
    """Return a size in MiB, or in KiB below one MiB."""
    return f"{size >> 20} MiB" if size >> 20 else f"{size >> 10} KiB"


def read_toml(path: PathLike, max_bytes: int = MAX_TOML_BYTES) -> dict[str, Any]:
    """Read a TOML file."""
    text = read_text(path, max_bytes=max_bytes)
    rest = re.sub(_ENCODED_ARRAY, lambda match: "\n" * match[0].count("\n"), text)
    if len(rest) > MAX_TOML_BYTES:
        raise FileFormatError(
            f"{path}: more than {size_text(MAX_TOML_BYTES)} besides arrays in base64; "
            "check the path or shorten the file"
        )
    for pattern, problem in _REFUSED_TOML.items():
        if match := re.search(pattern, rest):
            line = rest.count("\n", 0, match.start()) + 1
            raise FileFormatError(f"{path}: line {line}: {problem}")
    try:
        return _parse_toml(text)
    # Integers with too many digits raise ValueError; brackets nested too deeply raise RecursionError.
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        where = "that line" if "(at line" in reason else "the file"
        raise FileFormatError(f"{path}: not TOML: {reason}; correct {where}") from error


@lru_cache(maxsize=2)
def _parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML; a command reads the tables of one sidecar one after another."""
    import tomllib  # lazy import: few commands read TOML

    return tomllib.loads(text)


def require_usable_names(names: Sequence[str], source: str) -> None:
    """Require names that can be the header of a CSV column."""
    for name in names:
        is_plain = (
            name and name == name.strip() and name.isprintable() and not _RESERVED_CHARACTERS & set(name)
        )
        if not is_plain or name != _without_formula(name):
            raise FileFormatError(
                f"{source}: joint name {quote(name)}: a name that heads a column must be printable, "
                f"without spaces at its ends, without any of {' '.join(sorted(_RESERVED_CHARACTERS))}, "
                f"and not start with one of {' '.join(_FORMULA_STARTS)}; rename the joint"
            )


def parse_number(text: str) -> float:
    """Parse the number in a cell."""
    if "_" in text:
        raise ValueError(text)
    return float(text)


def yaml_number(value: float) -> str:
    """Write a number that reads back exactly; readers of YAML 1.1 take 1e-05 without a point for a word."""
    text = repr(float(value))
    return text if "." in text else text.replace("e", ".0e")


def csv_text(columns: Mapping[str, Iterable[Any]], comments: Iterable[str] = ()) -> str:
    """Return the text of a CSV file."""
    out = io.StringIO()
    out.writelines(f"# {escape_control_characters(comment)}\n" for comment in comments)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    rows = zip(*columns.values(), strict=True)
    writer.writerows(
        [_without_formula(cell) if isinstance(cell, str) else cell for cell in row] for row in rows
    )
    return out.getvalue()


def _without_formula(text: str) -> str:
    """Return the text of a cell, with an apostrophe before a formula; a number such as -1.5 is none."""
    return f"'{text}" if text.lstrip().startswith(_FORMULA_STARTS) and not _is_finite_number(text) else text


def _is_finite_number(text: str) -> bool:
    with suppress(ValueError):
        return math.isfinite(parse_number(text))
    return False
