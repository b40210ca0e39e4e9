"""Output files of a command: paths checked before any work, contents written all or none."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence

from .._typing import PathLike
from ..exceptions import InvalidArgumentError
from ..io.atomic import require_writable, write_files
from ..io.sidecar import existing_sidecar
from ..report.document import json_text
from .options import STDOUT


def is_same_file(a: str, b: str) -> bool:
    """Compare two paths, whether the files exist or not.

    Args:
        a: Path.
        b: Path.

    Returns:
        Whether both paths lead to one file.
    """
    if os.path.exists(a) and os.path.exists(b):
        return os.path.samefile(a, b)
    return os.path.realpath(a) == os.path.realpath(b)


def require_writable_outputs(outputs: Sequence[str | None], inputs: Sequence[str]) -> None:
    """Require that outputs can be written and overwrite neither an input nor each other.

    Args:
        outputs: Paths to write; None and standard output are ignored.
        inputs: Paths that are read.

    Raises:
        InvalidArgumentError: An output is also an input or another output.
    """
    paths = [path for path in outputs if path and path != STDOUT]
    for number, path in enumerate(paths):
        if any(is_same_file(path, other) for other in inputs):
            raise InvalidArgumentError(f"{path}: is an input file; choose another output path")
        if any(is_same_file(path, other) for other in paths[:number]):
            raise InvalidArgumentError(f"{path}: is another output already; choose a different path for each")
        require_writable(path)


def require_urdf_ending(path: str) -> None:
    """Require the file extension of a URDF.

    Args:
        path: Path of a URDF to write.

    Raises:
        InvalidArgumentError: The path has another extension.
    """
    if not path.lower().endswith(".urdf"):
        raise InvalidArgumentError(f"{path}: unknown file extension; expected .urdf")


def existing_sidecars(robots: Sequence[str]) -> list[str]:
    """List the sidecars that exist beside robot files.

    Args:
        robots: Paths of robot files.

    Returns:
        Paths of their sidecars.
    """
    return [path for path in map(existing_sidecar, robots) if path]


def json_path(target: str | None) -> str | None:
    """Return the file that an option --json names, if it names one.

    Args:
        target: Value of the option.

    Returns:
        Path of the file; None without the option and for standard output.
    """
    return target if target != STDOUT else None


def write_outputs(
    contents: Mapping[PathLike, str | bytes], json_target: str | None = None, document: object = None
) -> None:
    """Write the files of a command, all or none, and its JSON.

    Args:
        contents: Content of each file, by path.
        json_target: Path of the JSON file, or `-` to print it alone on stdout; none by default.
        document: Content of the JSON.
    """
    path = json_path(json_target)
    write_files({**contents, path: json_text(document)} if path else contents)
    if json_target == STDOUT:
        sys.stdout.write(json_text(document))
