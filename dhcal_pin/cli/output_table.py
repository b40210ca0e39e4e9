"""Table of the output files of a command: a row belongs to an option that names one file or several."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .._frozen import frozen
from ..exceptions import InvalidArgumentError
from .options import STDOUT

if TYPE_CHECKING:
    from .._typing import PathLike

# Functions that make the content of a file for its path, by the name of the option.
Makers = Mapping[str, Callable[[str], str | bytes]]


@frozen
class Output:
    """Output file of a command."""

    noun: str = ""  # What the file is, in the message on an unknown ending
    endings: tuple[str, ...] = ()  # Endings of its name; any if there are none
    other_endings: tuple[str, ...] = ()  # Endings that are accepted, too
    is_written_if_refused: bool = False  # Whether the file is written for a refused calibration, too


@frozen
class OutputFile:
    """File that an option names."""

    option: str
    output: Output  # Its row of the table
    path: str  # Path of the file; `STDOUT` for a JSON document that is printed


def chosen_files(options: Mapping[str, Any], table: Mapping[str, Output]) -> list[OutputFile]:
    """List the files that options name, in the order of the table."""
    found: list[OutputFile] = []
    for option, output in table.items():
        value = options[option]
        paths = value if isinstance(value, (list, tuple)) else [value] if value else []
        found += [OutputFile(option, output, path) for path in paths]
    return found


def require_endings(files: Iterable[OutputFile]) -> None:
    """Require that the names of files have the endings of their rows; a device may hold the only format."""
    from ..saving import is_stream  # lazy import: loads NumPy

    for file in files:
        endings = file.output.endings
        has_format = len(endings) == 1 and is_stream(file.path)
        has_format = has_format or file.path.lower().endswith((*endings, *file.output.other_endings))
        if endings and not has_format:
            raise InvalidArgumentError(
                f"{file.path}: unknown ending; write {file.output.noun} as {' or '.join(endings)}"
            )


def file_contents(files: Iterable[OutputFile], makers: Makers) -> dict[PathLike, str | bytes]:
    """Make the contents of files by path; those of options without a function are made elsewhere."""
    return {file.path: makers[file.option](file.path) for file in files if file.option in makers}


def paths_by_name(files: Sequence[OutputFile]) -> dict[str, str]:
    """Return the paths of files by option, the second and later ones of an option with their numbers."""
    found: dict[str, str] = {}
    for option in dict.fromkeys(file.option for file in files):
        found |= numbered(option, [file.path for file in files if file.option == option])
    return {name: path for name, path in found.items() if path != STDOUT}


def numbered(name: str, paths: Iterable[str]) -> dict[str, str]:
    """Return paths by name, the second and later ones with their numbers."""
    return {name if number == 1 else f"{name}_{number}": path for number, path in enumerate(paths, 1)}
