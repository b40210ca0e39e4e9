"""Another maker's file and a column map to a sheet of the project's own."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import se3
from .column_maps import PARTS, ColumnMap, Entry, Rotation
from .errors import DhcalError
from .files import ANGLES, Column, PathLike, Sheet, read_sheet, read_text
from .reading_columns import ROTVEC
from .se3 import Array

_SEPARATORS = {",": ",", ";": ";", "tab": "\t"}
# A matrix that is less of a rotation than this was not rounded but mistaken.
_MOST_SKEW = 1e-3


@dataclass(frozen=True)
class _Raw:
    """Their file: names of its columns, cells by line, the header's line, comments, and how it is written."""

    source: str
    how: ColumnMap
    names: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: list[int]
    header: int
    comments: tuple[str, ...]

    def place(self, name: str | int) -> int | None:
        """Where a column stands, from 0; None if it is not there."""
        if isinstance(name, int):
            return name - 1 if name <= len(self.names) else None
        if self.names.count(name) > 1:
            raise DhcalError(
                f"{self.source}:{self.header}: column {name!r} stands twice; give its number in the map"
            )
        return self.names.index(name) if name in self.names else None

    def lacking(self) -> list[str | int]:
        """The columns that the map names and the file does not have."""
        rotation = self.how.rotation.columns if self.how.rotation else ()
        theirs = [*(entry.theirs for entry in self.how.entries), *rotation]
        return [name for name in theirs if self.place(name) is None]

    def text(self, name: str | int) -> list[str]:
        """A column's cells."""
        index = self.place(name)
        assert index is not None
        return [row[index] for row in self.rows]

    def numbers(self, name: str | int) -> tuple[list[str], Array]:
        """A column's cells with a decimal point, and its numbers (m,)."""
        cells, decimal = self.text(name), self.how.decimal
        other = "." if decimal == "," else ","
        for cell, line in zip(cells, self.lines, strict=True):
            if other in cell:
                raise DhcalError(
                    f"{self.source}:{line}: column {name!r}: {cell!r} where the decimal sign is {decimal!r}; "
                    "write it with that sign, and none for thousands"
                )
        cells = [cell.replace(decimal, ".") for cell in cells]
        sheet = Sheet(self.source, (), {}, [[cell] for cell in cells], self.lines, self.header)
        return cells, sheet.numbers(Column(str(name), "", 0))


def mapped_sheet(path: PathLike, how: ColumnMap, known: Set[str]) -> Sheet:
    """Another maker's file as a sheet of the project's own.

    Args:
        path: the file.
        how: the map.
        known: columns that a file of the project's own can have.

    Raises:
        DhcalError: the file is not as the map says.
    """
    if _is_own(path, known) and not _fits(path, how):
        return read_sheet(path)
    raw = _read(path, how)
    if lacking := raw.lacking():
        raise DhcalError(
            f"{path}:{raw.header}: no column {lacking[0]!r}, which {how.source} names; with separator "
            f"{how.separator!r} there are {', '.join(map(repr, raw.names[:30]))}"
        )
    found = {entry.name: (entry.unit, _cells(raw, entry)) for entry in how.entries}
    found |= _turned(raw, how.rotation) if how.rotation else {}
    place = Path(path).absolute()
    parts: dict[str, str] = dict(zip(PARTS, (place.name, place.stem, place.parent.name), strict=True))
    for name, text in how.constants.items():
        # No str.format: a path may have braces too.
        full = re.sub("|".join(f"{{{part}}}" for part in PARTS), lambda hit: parts[hit[0][1:-1]], text)
        found[name] = "", [full] * len(raw.rows)
    return Sheet(
        raw.source,
        raw.comments,
        {name: Column(name, unit, i) for i, (name, (unit, _)) in enumerate(found.items())},
        [list(row) for row in zip(*(cells for _, cells in found.values()), strict=True)],
        raw.lines,
        raw.header,
    )


def _read(path: PathLike, how: ColumnMap) -> _Raw:
    """Their lines cut into cells."""
    comments: list[str] = []
    kept: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(path, how.encoding).splitlines(), 1):
        if number <= how.skip or not line.strip(" \t,;"):
            continue
        if how.comment and line.lstrip().startswith(how.comment):
            comments.append(line.lstrip()[len(how.comment) :].strip())
            continue
        try:
            # Line by line, so that a stray quote stays in its own row.
            cells = (
                line.split()
                if how.separator == "space"
                else next(csv.reader([line], delimiter=_SEPARATORS[how.separator]))
            )
        except csv.Error as error:
            raise DhcalError(f"{path}:{number}: {error}; correct this line") from error
        kept.append((number, [cell.strip() for cell in cells]))
    if len(kept) <= how.header:
        raise DhcalError(f"{path}: no rows with readings; add at least one")
    first, names = kept[0]
    if not how.header:
        names = [str(i) for i in range(1, len(names) + 1)]
    rows = kept[how.header :]
    for number, cells in rows:
        # A separator at the end of a line makes no column.
        if len(cells) < len(names) or any(cells[len(names) :]):
            raise DhcalError(
                f"{path}:{number}: {len(cells)} values for {len(names)} columns; correct the row, or "
                f"separator and decimal in {how.source}"
            )
    return _Raw(
        str(path),
        how,
        names,
        [cells for _, cells in rows],
        [number for number, _ in rows],
        first,
        tuple(comments),
    )


def _is_own(path: PathLike, known: Set[str]) -> bool:
    """Whether a file's header is the project's own."""
    try:
        return set(read_sheet(path).columns) <= known
    except DhcalError:
        return False


def _fits(path: PathLike, how: ColumnMap) -> bool:
    """Whether a file has a header with all the columns of a map."""
    try:
        return how.header and not _read(path, how).lacking()
    except DhcalError:
        return False


def _cells(raw: _Raw, entry: Entry) -> list[str]:
    """One column of ours; digits stay as they are where nothing is computed."""
    if entry.what == "text":
        return raw.text(entry.theirs)
    cells, values = raw.numbers(entry.theirs)
    if (entry.scale, entry.offset) == (1.0, 0.0):
        return cells
    return [repr(value) for value in (entry.scale * values + entry.offset).tolist()]


def _turned(raw: _Raw, how: Rotation) -> dict[str, tuple[str, list[str]]]:
    """The columns of ours for a rotation of theirs, each with its unit."""
    pairs = [raw.numbers(name) for name in how.columns]
    if how.convention in ("rotvec", "quaternion"):
        names = ROTVEC if how.convention == "rotvec" else [f"q{letter}" for letter in how.order]
        return {name: (how.unit, cells) for name, (cells, _) in zip(names, pairs, strict=True)}
    values = np.stack([numbers for _, numbers in pairs], -1)
    if how.convention == "euler":
        turns = euler(values / ANGLES[how.unit], how.axes, how.frame)
    else:
        turns = _nearest(values.reshape(-1, 3, 3), raw)
    vectors = se3.log3(turns).T.tolist()
    return {name: ("rad", [*map(repr, column)]) for name, column in zip(ROTVEC, vectors, strict=True)}


def euler(angles: Array, axes: str, frame: str) -> Array:
    """Rotations (m, 3, 3) of Euler angles (m, 3) in rad about three axes, such as "xyz", in that order.

    Intrinsic angles turn about axes as the turns before have left them, extrinsic ones about fixed axes.
    """
    first, second, third = (
        se3.exp3(angles[:, i, None] * np.eye(3)["xyz".index(axis)]) for i, axis in enumerate(axes)
    )
    return first @ second @ third if frame == "intrinsic" else third @ second @ first


def _nearest(matrices: Array, raw: _Raw) -> Array:
    """Rotations (m, 3, 3) nearest to matrices, or DhcalError where one is none."""
    u, s, vt = np.linalg.svd(matrices)
    off = np.abs(s - 1).max(-1) + (np.linalg.det(matrices) < 0)
    if (bad := np.flatnonzero(off > _MOST_SKEW)).size:
        raise DhcalError(
            f"{raw.source}:{raw.lines[bad[0]]}: the nine numbers are no rotation, by {off[bad[0]]:.2g}; "
            "give them row by row, right-handed, within a thousandth"
        )
    return u @ vt
