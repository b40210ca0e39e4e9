"""`dhcal study`: simulate calibrations over a grid of settings; write medians as CSV and plot.

A study runs in blocks of calibrations. Each finished block is appended to a journal `OUT.part`. After an
interruption the same command resumes with the next block.
"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence

from ... import io, studies
from .. import screens
from ..options import JSON, Options, execution_options

EXAMPLE = "dhcal study ur10_poses --jobs 2 -o results.csv"

ARGUMENTS: Options = {
    "study STUDY.toml": "grid of settings, or the name of a study that is part of the package: "
    "{shipped_studies}",
    "-o --output results.csv": {"required": True, "help": "table to write, one row per setting"},
    **execution_options("processes on this computer (default: %(default)s)", jobs=1),
    "--json": JSON,
}


def run(args: Namespace) -> int:
    """Run a study, or the blocks that an interrupted run has left."""
    from ...parallel import open_executor  # lazy import, as the following: they load Pinocchio
    from ...saving import complete_interrupted_save
    from ..output_table import Output
    from ..outputs import checked_files, existing_sidecars, written_files

    is_file = os.path.exists(args.study) or args.study.endswith(".toml")
    path = args.study if is_file else io.shipped_file(f"{args.study}.study.toml")
    journal_path = f"{args.output}.part"
    study = studies.read_study(path)
    inputs = [os.fspath(path), *study.robots, *existing_sidecars(study.robots)]
    table = {"output": Output("a table of results", (".csv",)), "json": Output()}
    checked_files(args, table, inputs, [journal_path, _figure_path(args.output)])
    complete_interrupted_save(journal_path)
    total = len(study.tasks())
    n_done = 0
    try:
        with studies.open_journal(journal_path, study) as journal:
            if n_done := len(journal.blocks):
                screens.print_lines(f"{journal_path}: resuming after {n_done} of {total} blocks")
            with (
                open_executor(args.jobs, args.scheduler) as executor,
                screens.progress_bar(study.title or "study", total, n_done) as progress,
            ):
                for block in studies.run(study, n_done, executor):
                    journal.append(block)
                    n_done = len(journal.blocks)
                    progress(n_done)
            _write_results(study, journal, args, inputs)
    except KeyboardInterrupt:
        if written_files():
            raise
        screens.print_lines(
            f"dhcal: interrupted; {journal_path} contains {n_done} of {total} blocks; run the same command "
            "to resume"
        )
        return 130
    return 0


def _figure_path(output: str) -> str:
    return f"{os.path.splitext(output)[0]}.svg"


def _write_results(
    study: studies.StudyGrid, journal: studies.StudyJournal, args: Namespace, inputs: Sequence[str]
) -> None:
    """Write table and plot of a finished study, remove its journal, and show the table."""
    from dataclasses import fields  # lazy import, as the following: they load Pinocchio

    from ...plots import study_svg
    from ..outputs import write_with_json

    header, rows = studies.result_table(study, journal.blocks)
    drawing = study_svg(study.title or "study", header, rows, len(fields(studies.Setting)))
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    contents = {args.output: io.csv_text(columns)} | ({_figure_path(args.output): drawing} if drawing else {})
    named: dict[str, str] = dict(zip(("output", "figure"), contents, strict=False))
    settings = [dict(zip(header, row, strict=True)) for row in rows]
    facts = {"title": study.title, "settings": settings}
    write_with_json({**contents, journal.path: None}, args.json, named, inputs, **facts)
    screens.show(screens.study_screen(study, header, rows, contents), args.verbosity)
