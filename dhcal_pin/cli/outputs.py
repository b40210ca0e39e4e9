"""Output files of a command: paths checked before any work, contents written all or none."""

from __future__ import annotations

import json
import os
from argparse import Namespace
from collections.abc import Mapping, Sequence

from .._typing import PathLike
from ..exceptions import InvalidArgumentError
from ..io.sidecar import existing_sidecar
from ..io.tables import WORKBOOK_ENDINGS
from ..report.json_document import json_text
from ..report.provenance import file_digests, versions
from ..saving import defer_signals, is_stream, require_writable, write_files
from .options import STDOUT
from .output_table import Output, OutputFile, chosen_files, require_endings
from .screens.streams import print_result


def is_same_file(a: str, b: str) -> bool:
    """Compare two paths, whether the files exist or not."""
    if os.path.exists(a) and os.path.exists(b):
        return os.path.samefile(a, b)
    return os.path.realpath(a) == os.path.realpath(b)


def require_writable_outputs(outputs: Sequence[str | None], inputs: Sequence[str]) -> None:
    """Require that outputs can be written and overwrite neither an input nor each other."""
    paths = [path for path in outputs if path and path != STDOUT]
    for number, path in enumerate(paths):
        if any(is_same_file(path, other) for other in inputs):
            raise InvalidArgumentError(f"{path}: is an input file; choose another output path")
        # Several outputs may go to one device, such as /dev/null.
        if not is_stream(path) and any(is_same_file(path, other) for other in paths[:number]):
            raise InvalidArgumentError(f"{path}: is another output already; choose a different path for each")
        require_writable(path)


def require_workbook(sheet: str, inputs: Sequence[str]) -> None:
    """Require an Excel file among the inputs if a sheet is named."""
    if sheet and not any(path.lower().endswith(WORKBOOK_ENDINGS) for path in inputs):
        endings = " or ".join(WORKBOOK_ENDINGS)
        raise InvalidArgumentError(
            f"--sheet {sheet}: no input is an Excel file; expected {endings}, or leave out --sheet"
        )


def checked_files(
    args: Namespace, table: Mapping[str, Output], inputs: Sequence[str], beside: Sequence[str] = ()
) -> list[OutputFile]:
    """List the files that options name; check their paths and endings, and the paths of files beside them."""
    files = chosen_files(vars(args), table)
    require_writable_outputs([*(file.path for file in files), *beside], inputs)
    require_endings(files)
    return files


def existing_sidecars(robots: Sequence[str]) -> list[str]:
    """List the sidecars that exist beside robot files."""
    return [path for path in map(existing_sidecar, robots) if path]


# Files that this process has written for the current command, for the message after an interrupt.
_written: list[str] = []


def forget_written_files() -> None:
    """Start a new command in this process."""
    _written.clear()


def written_files() -> list[str]:
    """Return the paths of the files that the current command has written."""
    return list(_written)


def write_outputs(
    contents: Mapping[PathLike, str | bytes | None],
    json_target: str | None,
    document: object,
) -> None:
    """Write all outputs of a command, all or none."""
    is_printed = json_target == STDOUT
    if json_target and not is_printed:
        contents = {**contents, json_target: json_text(document)}
    # An interrupt waits until the files are noted as written.
    with defer_signals():
        write_files(contents, (lambda: print_json(json_text(document))) if is_printed else None)
        _written.extend(os.fspath(path) for path, content in contents.items() if content is not None)


def write_with_json(
    contents: Mapping[PathLike, str | bytes | None],
    json_target: str | None,
    files: Mapping[str, str],
    inputs: Sequence[str],
    **facts: object,
) -> None:
    """Write all outputs of a command, and a JSON document with files, inputs and facts on the result."""
    document = None
    if json_target:
        digests = file_digests([path for path in inputs if os.path.isfile(path)])
        document = {**facts, "files": files, "inputs": digests, "versions": versions()}
    write_outputs(contents, json_target, document)


def print_json(text: str) -> None:
    """Print a JSON text on standard output."""
    remedy = "no file is written; name a file with --json"
    try:
        print_result(text, "JSON", remedy)
    except UnicodeEncodeError:
        # Standard output has another encoding; JSON can escape all characters.
        print_result(json.dumps(json.loads(text), indent=2) + "\n", "JSON", remedy)
