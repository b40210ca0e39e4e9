"""Locks of folders: one run at a time saves files in a folder."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from ..exceptions import FileFormatError
from .signals import DeferredSignals

# Longest time to wait for another run, and time between two attempts [s]. Saving takes milliseconds.
TIMEOUT_S, INTERVAL_S = 30.0, 0.02


@contextmanager
def lock_folders(folders: Iterable[str], signals: DeferredSignals) -> Iterator[bool]:
    """Lock folders against other runs that save in them; the system releases locks of killed processes."""
    descriptors: list[int] = []
    is_locked = True
    try:
        # All runs lock in the same order, so that no two of them wait for each other.
        for folder in sorted(set(folders)):
            try:
                descriptors.append(os.open(folder, os.O_RDONLY))
                with signals.interruptible():
                    _wait_for_lock(descriptors[-1], folder)
            except OSError:
                is_locked = False
        yield is_locked
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def _wait_for_lock(descriptor: int, folder: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise
        if time.monotonic() > deadline:
            raise FileFormatError(
                f"{folder}: another run has been saving files there for {TIMEOUT_S:.0f} s; end it, or write "
                "to another folder"
            )
        time.sleep(INTERVAL_S)
