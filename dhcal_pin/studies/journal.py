"""Journal of a study: the results of the blocks that are finished, so that an interrupted study can go on.

The first line identifies the study. Each further line holds the results of one block as JSON; it is appended
as soon as the block is finished. An incomplete last line is dropped when the journal is opened. A journal is
locked while a run uses it.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ..exceptions import FileFormatError, InvalidArgumentError
from ..saving import is_stream
from .grid import StudyGrid
from .runner import MEASURE_UNITS

# Longest line [byte]; that of a block has some kilobytes.
_MAX_LINE_BYTES = 1 << 20
# Results of one block: one row per calibration.
Block = list[list[float]]


class StudyJournal:
    """Open journal: path of the file, and results of the finished blocks, in order."""

    def __init__(self, path: str, descriptor: int, blocks: list[Block]):
        self.path, self.blocks, self._descriptor = path, blocks, descriptor

    def append(self, block: Block) -> None:
        """Add the results of a block; if the process is killed then, only unfinished blocks are lost."""
        self._write(json.dumps(block))
        self.blocks.append(block)

    def _write(self, line: str) -> None:
        data = f"{line}\n".encode()
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError as error:
            raise FileFormatError(
                f"{self.path}: cannot write there: {error.strerror}; the journal contains {len(self.blocks)} "
                "blocks; make room and run the same command to resume"
            ) from error


@contextmanager
def open_journal(path: str, study: StudyGrid) -> Iterator[StudyJournal]:
    """Open the journal of a study, or begin one."""
    if is_stream(path):
        raise InvalidArgumentError(f"{path}: is not a regular file; choose another output path")
    try:
        descriptor = _open_locked(path)
    except OSError as error:
        raise FileFormatError(
            f"{path}: cannot write there: {error.strerror}; choose another place"
        ) from error
    try:
        header = f"{study.digest}\n".encode()
        blocks: list[Block] = []
        size = 0
        with open(descriptor, "rb", closefd=False) as file:
            found = file.readline(len(header))
            # A header without its end is that of a process that was killed.
            if found != header and (found.endswith(b"\n") or len(found) == len(header)):
                raise FileFormatError(
                    f"{path}: belongs to another study or to other robots; finish that study, or remove the "
                    "file"
                )
            if found == header:
                size = len(header)
                for _, _, count in study.tasks():
                    line = file.readline(_MAX_LINE_BYTES)
                    block = _parse_block(line, count)
                    if block is None:
                        break
                    blocks.append(block)
                    size += len(line)
        journal = StudyJournal(path, descriptor, blocks)
        os.ftruncate(descriptor, size)
        os.lseek(descriptor, 0, os.SEEK_END)
        if not size:
            journal._write(study.digest)
        yield journal
    finally:
        os.close(descriptor)


def _open_locked(path: str) -> int:
    """Open a file that no other run uses, and lock it."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # Some network file systems have no locks.
            if error.errno in (errno.EAGAIN, errno.EACCES):
                os.close(descriptor)
                raise FileFormatError(
                    f"{path}: another run of this study is using it; wait for its end, or choose another "
                    "output"
                ) from None
        # A run that has ended in between has removed the file.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        os.close(descriptor)


def _parse_block(line: bytes, count: int) -> Block | None:
    """Parse the results of a block of some calibrations; None if the line is damaged or incomplete."""
    if not line.endswith(b"\n"):
        return None
    try:
        block = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return block if isinstance(block, list) and len(block) == count and all(map(_is_row, block)) else None


def _is_row(row: Any) -> bool:
    return (
        isinstance(row, list)
        and len(row) == len(MEASURE_UNITS)
        and all(isinstance(value, float) for value in row)
    )
