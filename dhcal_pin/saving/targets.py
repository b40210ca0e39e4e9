"""Targets of saving: checks of a path, and streams that are written to and never replaced."""

from __future__ import annotations

import os
import re
import stat
import sys

from .._typing import PathLike
from ..exceptions import InvalidArgumentError

# Names of open descriptors of this process.
_DESCRIPTOR = re.compile(r"/dev/(?:(?P<name>stdout|stderr)|fd/(?P<number>\d+))|/proc/self/fd/(?P<proc>\d+)")
_STANDARD_STREAMS = {"stdout": 1, "stderr": 2}


def require_writable(path: PathLike) -> None:
    """Require that a file can be created at a path."""
    folder = os.path.dirname(path) or os.curdir
    if os.path.isdir(path):
        raise InvalidArgumentError(f"{path}: is a folder; name a file in it")
    if not os.path.isdir(folder):
        raise InvalidArgumentError(f"{path}: there is no folder {folder}; make it first, or write elsewhere")


def is_stream(path: PathLike) -> bool:
    """Return whether a path is a device, a pipe, a socket or an open descriptor such as /dev/stdout."""
    if _descriptor(path) is not None:
        return True
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def write_stream(path: PathLike, data: bytes) -> None:
    """Write to a stream. Opening a named pipe waits for its reader; errors are `OSError`."""
    descriptor = _descriptor(path)
    if descriptor is not None:
        # Opening the path again would write over the beginning of a redirected file.
        sys.stdout.flush()
        _write_all(descriptor, data)
        return
    descriptor = os.open(path, os.O_WRONLY | os.O_NOCTTY)
    try:
        _write_all(descriptor, data)
    finally:
        os.close(descriptor)


def _descriptor(path: PathLike) -> int | None:
    match = _DESCRIPTOR.fullmatch(os.fspath(path))
    if match is None:
        return None
    return _STANDARD_STREAMS[match["name"]] if match["name"] else int(match["number"] or match["proc"])


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
