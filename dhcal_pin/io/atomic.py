"""Atomic writing: several files are written together, or none of them.

Each content goes to a temporary file in the folder of its target first. Then the temporary files are renamed
to the targets, one by one. Before that, an existing target is hard-linked to a backup name. If anything
fails, the targets that were renamed already are restored. A rename is atomic (POSIX), so that a reader sees
the old or the new content of a file, never a part of it.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Mapping
from contextlib import suppress

from .._typing import PathLike
from ..exceptions import FileFormatError, InvalidArgumentError


def require_writable(path: PathLike) -> None:
    """Require that a file can be created at a path.

    Args:
        path: Path of the file to write.

    Raises:
        InvalidArgumentError: The folder of the path does not exist, or the path is a folder itself.
    """
    folder = os.path.dirname(path) or os.curdir
    if os.path.isdir(path):
        raise InvalidArgumentError(f"{path}: is a folder; name a file in it")
    if not os.path.isdir(folder):
        raise InvalidArgumentError(f"{path}: there is no folder {folder}; make it first, or write elsewhere")


def write_files(contents: Mapping[PathLike, str | bytes]) -> None:
    """Write all files or none.

    A symbolic link stays a link, and its target is written. An existing file keeps its permissions.

    Args:
        contents: Text, written as UTF-8, or bytes by path.

    Raises:
        FileFormatError: A file cannot be written, for example because the disk is full.
    """
    staged: list[tuple[str, PathLike]] = []  # temporary file and target
    renamed: list[tuple[str, PathLike]] = []
    path: PathLike = ""
    try:
        for path, content in contents.items():
            require_writable(path)
            target = os.path.realpath(path)
            handle, temporary = tempfile.mkstemp(prefix=".dhcal-", dir=os.path.dirname(target))
            staged.append((temporary, target))
            with os.fdopen(handle, "wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
            os.chmod(temporary, _permissions(target))
        for temporary, path in staged:
            _make_backup(path, _backup_path(temporary))
            os.replace(temporary, path)
            renamed.append((temporary, path))
    except BaseException as error:
        for temporary, target in reversed(renamed):
            if os.path.exists(_backup_path(temporary)):
                os.replace(_backup_path(temporary), target)
            else:
                os.unlink(target)
        if isinstance(error, OSError):
            raise FileFormatError(
                f"{path}: cannot write there: {error.strerror}; choose another place"
            ) from error
        raise
    finally:
        for temporary, _ in staged:
            for leftover in (temporary, _backup_path(temporary)):
                with suppress(FileNotFoundError):
                    os.unlink(leftover)


def _permissions(path: str) -> int:
    """Return the permissions of an existing file, or those that a new file gets."""
    try:
        return stat.S_IMODE(os.stat(path).st_mode)
    except FileNotFoundError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def _backup_path(temporary: str) -> str:
    return f"{temporary}-old"


def _make_backup(path: PathLike, backup: str) -> None:
    """Give the file at a path a second name, if the file exists."""
    try:
        os.link(path, backup)
    except FileNotFoundError:
        pass
    except OSError:
        shutil.copy2(path, backup)  # the file system has no hard links
