"""Where a command's files go: places checked before any work, JSON to a file or to stdout."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from ..exceptions import DhcalError
from ..io.atomic import require_writable, write_files
from ..io.sidecar import existing_sidecar
from ..report import document

STDOUT = "-"


def split_commas(text: str) -> list[str]:
    """The entries of a comma-separated option."""
    return [name.strip() for name in text.split(",") if name.strip()]


def is_same_file(a: str, b: str) -> bool:
    """Whether two paths are one file, there or not."""
    if os.path.exists(a) and os.path.exists(b):
        return os.path.samefile(a, b)
    return os.path.realpath(a) == os.path.realpath(b)


def require_writable_outputs(outputs: Sequence[str | None], inputs: Sequence[str]) -> None:
    """Complains about an output that cannot be written, or would write over an input or another output."""
    paths = [path for path in outputs if path and path != STDOUT]
    for number, path in enumerate(paths):
        if any(is_same_file(path, other) for other in inputs):
            raise DhcalError(f"{path}: is an input; name another output")
        if any(is_same_file(path, other) for other in paths[:number]):
            raise DhcalError(f"{path}: is another output already; name a second file")
        require_writable(path)


def require_urdf_ending(path: str) -> None:
    """Raise DhcalError unless the path of a URDF to write ends with .urdf."""
    if not path.lower().endswith(".urdf"):
        raise DhcalError(f"{path}: unknown ending; write a URDF as .urdf")


def write_json(target: str | None, content: object) -> None:
    """JSON to a file, or alone on stdout for `-`."""
    if target == STDOUT:
        sys.stdout.write(document.json_text(content))
    elif target:
        write_files({target: document.json_text(content)})


def sidecars(robots: Sequence[str]) -> list[str]:
    """The sidecars that lie beside robots' files."""
    return [path for path in map(existing_sidecar, robots) if path]
