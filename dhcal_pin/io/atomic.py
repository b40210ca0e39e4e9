"""Files written all or none, whatever comes in between."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Mapping
from contextlib import suppress

from .._typing import PathLike
from ..exceptions import DhcalError


def require_writable(path: PathLike) -> None:
    """Complains unless a file can stand at a path.

    Raises:
        DhcalError: its folder is missing, or it is a folder itself.
    """
    folder = os.path.dirname(path) or os.curdir
    if os.path.isdir(path):
        raise DhcalError(f"{path}: is a folder; name a file in it")
    if not os.path.isdir(folder):
        raise DhcalError(f"{path}: there is no folder {folder}; make it first, or write elsewhere")


def write_files(contents: Mapping[PathLike, str | bytes]) -> None:
    """Writes all files or none: each beside its place first, then renamed over.

    A link stays a link and what it leads to is written; a file that was there keeps its permissions.

    Raises:
        DhcalError: a folder is missing or not writable, a disk is full.
    """
    staged: list[tuple[str, PathLike]] = []
    placed: list[tuple[str, PathLike]] = []
    path: PathLike = ""
    try:
        for path, content in contents.items():
            require_writable(path)
            real = os.path.realpath(path)
            handle, name = tempfile.mkstemp(prefix=".dhcal-", dir=os.path.dirname(real))
            staged.append((name, real))
            with os.fdopen(handle, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
            os.chmod(name, _permissions(real))
        for name, path in staged:
            _make_backup(path, _backup_path(name))
            os.replace(name, path)
            placed.append((name, path))
    except BaseException as error:
        for name, done in reversed(placed):
            if os.path.exists(_backup_path(name)):
                os.replace(_backup_path(name), done)
            else:
                os.unlink(done)
        if isinstance(error, OSError):
            raise DhcalError(f"{path}: cannot write there: {error.strerror}; choose another place") from error
        raise
    finally:
        for name, _ in staged:
            for rest in (name, _backup_path(name)):
                with suppress(FileNotFoundError):
                    os.unlink(rest)


def _permissions(path: str) -> int:
    """Those of the file at a path, or those that a new one gets."""
    try:
        return stat.S_IMODE(os.stat(path).st_mode)
    except FileNotFoundError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def _backup_path(name: str) -> str:
    return f"{name}-old"


def _make_backup(path: PathLike, backup: str) -> None:
    """A second name for what stands at a path, if anything does."""
    try:
        os.link(path, backup)
    except FileNotFoundError:
        pass
    except OSError:
        shutil.copy2(path, backup)  # a file system without links
