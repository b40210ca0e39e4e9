"""Table of the output files of a command: their endings and the functions that make their contents.

A row belongs to an option that names one file or several. Functions import what they need when they are
called, because help pages load no NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ..exceptions import InvalidArgumentError
from .options import STDOUT

if TYPE_CHECKING:
    from .._typing import PathLike

# What a command has done, from which its files are made.
Done = TypeVar("Done")


@dataclass(frozen=True)
class Output(Generic[Done]):
    """Output file of a command."""

    # Function that makes the content for a path; None for the JSON document, which is made last.
    content: Callable[[Done, str], str | bytes] | None
    noun: str = ""  # What the file is, in the message on an unknown ending
    endings: tuple[str, ...] = ()  # Endings of its name; any if there are none
    other_endings: tuple[str, ...] = ()  # Endings that are accepted, too
    is_written_if_refused: bool = False  # Whether the file is written for a refused calibration, too


@dataclass(frozen=True)
class OutputFile(Generic[Done]):
    """File that an option names."""

    option: str
    output: Output[Done]  # Its row of the table
    path: str  # Path of the file; `STDOUT` for a JSON document that is printed


def chosen_files(options: Mapping[str, Any], table: Mapping[str, Output[Done]]) -> list[OutputFile[Done]]:
    """List the files that options name, in the order of the table."""
    found: list[OutputFile[Done]] = []
    for option, output in table.items():
        value = options[option]
        paths = value if isinstance(value, (list, tuple)) else [value] if value else []
        found += [OutputFile(option, output, path) for path in paths]
    return found


def require_endings(files: Iterable[OutputFile[Any]]) -> None:
    """Require that the names of files have the endings of their rows."""
    for file in files:
        endings = file.output.endings
        if endings and not file.path.lower().endswith((*endings, *file.output.other_endings)):
            raise InvalidArgumentError(
                f"{file.path}: unknown ending; write {file.output.noun} as {' or '.join(endings)}"
            )


def file_contents(files: Iterable[OutputFile[Done]], done: Done) -> dict[PathLike, str | bytes]:
    """Make the contents of files by path, but for the JSON document."""
    return {file.path: file.output.content(done, file.path) for file in files if file.output.content}


def paths_by_name(files: Sequence[OutputFile[Any]]) -> dict[str, str]:
    """Return the paths of files by option, the second and later ones of an option with their numbers."""
    found: dict[str, str] = {}
    for option in dict.fromkeys(file.option for file in files):
        found |= numbered(option, [file.path for file in files if file.option == option])
    return {name: path for name, path in found.items() if path != STDOUT}


def numbered(name: str, paths: Iterable[str]) -> dict[str, str]:
    """Return paths by name, the second and later ones with their numbers."""
    return {name if number == 1 else f"{name}_{number}": path for number, path in enumerate(paths, 1)}
