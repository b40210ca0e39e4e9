"""Writing of several files, all or none; the package describes the steps."""

from __future__ import annotations

import os
import secrets
import shutil
import stat
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from .._frozen import frozen
from .._typing import PathLike
from ..exceptions import FileFormatError, InvalidArgumentError
from .commit_record import (
    RECORD_NAME,
    CommitRecord,
    complete,
    complete_or_explain,
    flush_folder,
    remove_stale,
    temporary_name,
)
from .folder_locks import lock_folders
from .signals import DeferredSignals, defer_signals
from .targets import is_stream, require_writable, write_stream


def write_files(
    contents: Mapping[PathLike, str | bytes | None], before_commit: Callable[[], None] | None = None
) -> None:
    """Write all files or none.

    A symbolic link stays a link, and its target is written. An existing file keeps its permissions and its
    owner. A device or a pipe is written to before the commit. SIGINT, SIGTERM and SIGHUP take effect when all
    files are saved, or when nothing is changed.
    """
    with defer_signals() as signals:
        _save(contents, before_commit, signals)


@frozen
class _Change:
    """Change of one file."""

    path: PathLike  # Path for messages
    folder: str  # Absolute path of the folder, without symbolic links
    name: str  # Name of the file in it
    data: bytes | None  # New content; None to remove the file
    temporary: str  # Path of the temporary file with the new content
    backup: str  # Path of the backup of the old content

    @property
    def target(self) -> str:
        """Path of the file."""
        return os.path.join(self.folder, self.name)


def _save(
    contents: Mapping[PathLike, str | bytes | None],
    before_commit: Callable[[], None] | None,
    signals: DeferredSignals,
) -> None:
    token = secrets.token_hex(8)
    streams: dict[PathLike, bytes] = {}
    changes: list[_Change] = []
    for number, (path, content) in enumerate(contents.items()):
        require_writable(path)
        # A path that is not UTF-8 has characters in Python that UTF-8 cannot encode.
        data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
        if is_stream(path):
            streams[path] = data or b""
            continue
        folder, name = os.path.split(os.path.realpath(path))
        if any((change.folder, change.name) == (folder, name) for change in changes):
            raise InvalidArgumentError(f"{path}: is another output already; choose a different path for each")
        new, old = (os.path.join(folder, temporary_name(token, number, kind)) for kind in ("new", "old"))
        changes.append(_Change(path, folder, name, data, new, old))
    folders = list(dict.fromkeys(change.folder for change in changes))
    with lock_folders(folders, signals) as is_locked:
        for folder in folders:
            complete_or_explain(folder)
            if is_locked:
                remove_stale(folder)
        try:
            for change in changes:
                _prepare(change, needs_backup=len(changes) > 1)
            with signals.interruptible():
                for path, data in streams.items():
                    _write_to_stream(path, data)
                if before_commit is not None:
                    before_commit()
            _commit(changes, folders, token)
        finally:
            for change in changes:
                for path in (change.temporary, change.backup):
                    Path(path).unlink(missing_ok=True)


def _prepare(change: _Change, needs_backup: bool) -> None:
    """Write the temporary file of a change and flush it to the disk; give the old file a second name."""
    try:
        if change.data is not None:
            _write_temporary(change)
        if needs_backup and os.path.exists(change.target):
            try:
                os.link(change.target, change.backup)
            except OSError:
                shutil.copy2(change.target, change.backup)  # the file system has no hard links
    except OSError as error:
        raise _write_error(change.path, error) from error


def _write_temporary(change: _Change) -> None:
    assert change.data is not None
    # A new file gets the permissions that the user's mask allows.
    descriptor = os.open(change.temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    with os.fdopen(descriptor, "wb") as file:
        file.write(change.data)
        file.flush()
        with suppress(FileNotFoundError):
            old = os.stat(change.target)
            os.fchmod(descriptor, stat.S_IMODE(old.st_mode))
            with suppress(PermissionError):
                os.fchown(descriptor, old.st_uid, old.st_gid)
        os.fsync(descriptor)


def _write_to_stream(path: PathLike, data: bytes) -> None:
    try:
        write_stream(path, data)
    except OSError as error:
        raise _write_error(path, error) from error


def _commit(changes: Sequence[_Change], folders: Sequence[str], token: str) -> None:
    """Rename all temporary files to their targets; restore the old files if that fails."""
    for folder in folders:
        flush_folder(folder)
    try:
        if len(changes) == 1 and changes[0].data is not None:
            os.replace(changes[0].temporary, changes[0].target)
            flush_folder(folders[0])
        elif changes:
            # The record of the first folder is the last one: with it the run is committed.
            for number, folder in reversed(list(enumerate(folders))):
                _write_record(folder, folders, changes, token, len(changes) + number)
            complete(folders[0])
    except BaseException as error:
        path = next((change.path for change in changes if os.path.exists(change.temporary)), changes[-1].path)
        try:
            _roll_back(changes, folders)
        except OSError as failure:
            raise FileFormatError(
                f"{path}: cannot write there; the files before it are written and cannot be restored: "
                f"{failure.strerror}; the outputs do not belong together"
            ) from error
        if isinstance(error, OSError):
            raise _write_error(path, error) from error
        raise


def _write_record(
    folder: str, folders: Sequence[str], changes: Sequence[_Change], token: str, number: int
) -> None:
    """Write the record of a folder, which appears as a whole."""
    here = [change for change in changes if change.folder == folder]
    renames = [
        (os.path.basename(change.temporary), change.name) for change in here if change.data is not None
    ]
    removals = [change.name for change in here if change.data is None]
    text = CommitRecord(token, folders, renames, removals).text()
    temporary = os.path.join(folder, temporary_name(token, number, "new"))
    try:
        with open(temporary, "x", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, os.path.join(folder, RECORD_NAME))
    finally:
        Path(temporary).unlink(missing_ok=True)
    flush_folder(folder)


def _roll_back(changes: Sequence[_Change], folders: Sequence[str]) -> None:
    """Restore all old files. The records go first: nobody must complete the commit any more."""
    for folder in folders:
        Path(folder, RECORD_NAME).unlink(missing_ok=True)
    for change in changes:
        if os.path.exists(change.backup):
            # Does nothing if the target is still the same file.
            os.replace(change.backup, change.target)
        elif change.data is not None and not os.path.exists(change.temporary):
            os.unlink(change.target)


def _write_error(path: PathLike, error: OSError) -> FileFormatError:
    return FileFormatError(
        f"{path}: cannot write there: {error.strerror}; no file is changed; choose another place"
    )
