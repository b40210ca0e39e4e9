"""`dhcal study`: simulate calibrations over a grid of settings; write medians as CSV and plot.

A study runs in blocks of calibrations. Each finished block is appended to a journal `OUT.part`, whose first
line identifies the study. After an interruption the same command resumes with the next block.
"""

from __future__ import annotations

import json
import os
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, TextIO

from ..exceptions import FileFormatError
from .options import add_execution_options

if TYPE_CHECKING:
    from ..studies import StudyGrid

EXAMPLE = "dhcal study ur10_poses --jobs 2 -o results.csv"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments of `dhcal study`.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "study",
        metavar="STUDY.toml",
        help="grid of settings, or the name of a study that is part of the package: {shipped_studies}",
    )
    parser.add_argument(
        "-o", "--output", metavar="results.csv", required=True, help="table to write, one row per setting"
    )
    add_execution_options(parser, "processes on this computer (default: %(default)s)", jobs=1)


def run(args: Namespace) -> int:
    """Run a study, or the blocks that an interrupted run has left.

    Args:
        args: Parsed arguments.

    Returns:
        Exit status: 0 done, 130 interrupted.
    """
    from dataclasses import fields  # lazy import, as the following: they load Pinocchio

    from .. import studies
    from ..io import shipped_file
    from ..io.tabular import csv_text
    from ..parallel import open_executor
    from ..visualization.plots import study_svg
    from . import console
    from .outputs import existing_sidecars, require_writable_outputs, write_outputs

    is_file = os.path.exists(args.study) or args.study.endswith(".toml")
    path = args.study if is_file else shipped_file(f"{args.study}.study.toml")
    journal = f"{args.output}.part"
    figure = f"{os.path.splitext(args.output)[0]}.svg"
    study = studies.read_study(path)
    inputs = [os.fspath(path), *study.robots, *existing_sidecars(study.robots)]
    require_writable_outputs([args.output, journal, figure], inputs)
    blocks = _read_journal(journal, study)
    total = len(study.tasks())
    if blocks:
        console.print_lines(f"{journal}: resuming after {len(blocks)} of {total} blocks")
    try:
        with (
            open_executor(args.jobs, args.scheduler) as executor,
            console.progress_bar(study.title or "study", total, len(blocks)) as progress,
            _open_journal(journal, study, blocks) as file,
        ):
            for block in studies.run(study, len(blocks), executor):
                # Flush each line at once: if the process is killed, only unfinished blocks are lost.
                file.write(json.dumps(block) + "\n")
                file.flush()
                blocks.append(block)
                progress(len(blocks))
    except KeyboardInterrupt:
        console.print_lines(
            f"dhcal: interrupted; {journal} contains {len(blocks)} of {total} blocks; run the same command "
            "to resume"
        )
        return 130
    header, rows = studies.result_table(study, blocks)
    drawing = study_svg(study.title or "study", header, rows, len(fields(studies.Setting)))
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    contents = {args.output: csv_text(columns)} | ({figure: drawing} if drawing else {})
    write_outputs(contents)
    os.unlink(journal)
    console.print_study(study, header, rows)
    console.print_lines(*(f"wrote {path}" for path in contents))
    return 0


def _read_journal(journal: str, study: StudyGrid) -> list[list[list[float]]]:
    """Read the blocks that an interrupted run of this study has finished."""
    from ..io.tabular import read_text  # lazy import: loads Pinocchio

    if not os.path.exists(journal):
        return []
    digest, *lines = read_text(journal).split("\n")
    if digest != study.digest:
        raise FileFormatError(
            f"{journal}: belongs to another study or to other robots; finish that study, or remove the file"
        )
    blocks = []
    # The last line is empty, or incomplete if the process was killed.
    with suppress(ValueError):
        for line in lines[:-1]:
            blocks.append(json.loads(line))
    return blocks


def _open_journal(journal: str, study: StudyGrid, blocks: Sequence[list[list[float]]]) -> TextIO:
    """Write the journal with its complete lines only, and open it to append more."""
    from .outputs import write_outputs  # lazy import: loads Pinocchio

    lines = (study.digest, *map(json.dumps, blocks))
    write_outputs({journal: "".join(f"{line}\n" for line in lines)})
    return open(journal, "a", encoding="utf-8")
