"""Record of a commit: which temporary files are renamed to which targets.

A record lies in every folder of a commit and names only files of its own folder. The record of the first
folder, the primary one, is written last: with it the run is committed. Whoever finds a record completes the
commit if the primary record exists, and removes the record otherwise.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from .._frozen import frozen
from .._typing import PathLike
from ..exceptions import FileFormatError
from .folder_locks import lock_folders
from .signals import defer_signals

RECORD_NAME = ".dhcal-save.json"
_TEMPORARY = re.compile(r"\.dhcal-[0-9a-f]{16}-\d+\.(?:new|old)")


@frozen
class CommitRecord:
    """What a commit does in one folder."""

    token: str  # Random text that all records of a commit share
    folders: Sequence[str]  # All folders of the commit, the primary one first
    renames: Sequence[Sequence[str]]  # Pairs of the name of a temporary file and the name of its target
    removals: Sequence[str]  # Names of files to remove

    @classmethod
    def read(cls, folder: str) -> CommitRecord | None:
        """Read the record in a folder."""
        path = os.path.join(folder, RECORD_NAME)
        if not os.path.isfile(path):
            return None
        try:
            with open(path, encoding="utf-8") as file:
                content = json.load(file)
        except FileNotFoundError:  # another run has just completed the commit
            return None
        except (OSError, ValueError, RecursionError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is damaged"
            raise FileFormatError(f"{path}: cannot be read: {reason}; remove this file") from error
        no_record = FileFormatError(f"{path}: is not a record of saved files; remove this file")
        try:
            record = cls(**content)
            names = [name for pair in record.renames for name in pair]
            is_valid = all(_is_name(name) for name in (*names, *record.removals))
            is_valid &= all(_TEMPORARY.fullmatch(temporary) for temporary, _ in record.renames)
            is_valid &= len(record.folders) > 0 and all(map(os.path.isabs, record.folders))
        except (TypeError, ValueError) as error:
            raise no_record from error
        if not is_valid:
            raise no_record
        return record

    def text(self) -> str:
        """Return the content of the file."""
        return json.dumps(asdict(self))


def _is_name(name: Any) -> bool:
    """Return whether a value is the name of a file in its folder, and not a path to elsewhere."""
    return isinstance(name, str) and name not in ("", os.curdir, os.pardir) and os.path.basename(name) == name


def temporary_name(token: str, number: int, kind: str) -> str:
    """Return the name of a temporary file."""
    return f".dhcal-{token}-{number}.{kind}"


def remove_stale(folder: str) -> None:
    """Remove the temporary files of runs that were killed before their commit."""
    with os.scandir(folder) as entries:
        stale = [entry.path for entry in entries if _TEMPORARY.fullmatch(entry.name)]
    for path in stale:
        Path(path).unlink(missing_ok=True)


def complete(folder: str) -> None:
    """Complete the commit whose record lies in a folder, or discard a record that was not committed."""
    record = CommitRecord.read(folder)
    if record is None:
        return
    primary = record.folders[0]
    committed = CommitRecord.read(primary)
    if committed is None or committed.token != record.token:
        Path(folder, RECORD_NAME).unlink(missing_ok=True)
        return
    parts = {other: CommitRecord.read(other) for other in committed.folders}
    own = {other: part for other, part in parts.items() if part is not None and part.token == record.token}
    for other, part in own.items():
        _apply(other, part)
    # All records stay until all folders are complete, so that the commit is found in each of them.
    for other in reversed(own):
        Path(other, RECORD_NAME).unlink(missing_ok=True)


def _apply(folder: str, record: CommitRecord) -> None:
    """Rename and remove the files of one folder."""
    for temporary, name in record.renames:
        # A file that is missing was renamed before an interruption.
        with suppress(FileNotFoundError):
            os.replace(os.path.join(folder, temporary), os.path.join(folder, name))
    for name in record.removals:
        Path(folder, name).unlink(missing_ok=True)
    flush_folder(folder)


def flush_folder(folder: str) -> None:
    """Flush the names of a folder to the disk, where the file system can do so."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def complete_interrupted_save(path: PathLike) -> None:
    """Complete the commit of a run that was killed while it saved files beside a file."""
    folder = os.path.dirname(os.path.realpath(path))
    if not os.path.exists(os.path.join(folder, RECORD_NAME)):
        return
    with defer_signals() as signals, lock_folders([folder], signals):
        complete_or_explain(folder)


def complete_or_explain(folder: str) -> None:
    """Complete the commit whose record lies in a folder."""
    try:
        complete(folder)
    except OSError as error:
        record = CommitRecord.read(folder)
        names = [name for _, name in record.renames] if record else []
        raise FileFormatError(
            f"{folder}: a run was killed while it saved {', '.join(names)}, and this cannot be completed: "
            f"{error.strerror}; these files do not belong together: save them again, and remove {RECORD_NAME}"
        ) from error
