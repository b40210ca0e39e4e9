"""`dhcal study`: a grid of simulated calibrations, shared out, resumed after a kill, as CSV and plot."""

from __future__ import annotations

import json
import os
from argparse import Namespace
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from typing import Any, TextIO

import numpy as np

from ..exceptions import DhcalError
from ..formatting import Table
from ..io.atomic import write_files
from ..io.shipped_files import shipped_file
from ..io.tabular import csv_text, read_text
from ..parallel import open_executor
from ..studies.grid import Setting, StudyGrid, read_study
from ..studies.runner import run, table
from ..visualization.plots import study_svg
from . import console
from .options import require_writable_outputs, sidecars


def study(args: Namespace) -> int:
    """Runs a study, or what is left of it."""
    given = os.path.exists(args.study) or args.study.endswith(".toml")
    path = args.study if given else shipped_file(f"{args.study}.study.toml")
    journal = f"{args.output}.part"
    picture = f"{os.path.splitext(args.output)[0]}.svg"
    wanted = read_study(path)
    inputs = [os.fspath(path), *wanted.robots, *sidecars(wanted.robots)]
    require_writable_outputs([args.output, journal, picture], inputs)
    blocks = _resumed(journal, wanted)
    total = len(wanted.tasks())
    if blocks:
        console.print_lines(f"{journal}: goes on after {len(blocks)} of {total} blocks")
    try:
        with (
            open_executor(args.jobs, args.scheduler) as where,
            console.progress_bar(wanted.title or "study", total, len(blocks)) as progress,
            _opened(journal, wanted, blocks) as file,
        ):
            for block in run(wanted, len(blocks), where):
                # One line a block and each at once, so that a kill costs no more than the blocks under way.
                file.write(json.dumps(block) + "\n")
                file.flush()
                blocks.append(block)
                progress(len(blocks))
    except KeyboardInterrupt:
        kept = f"{journal} keeps {len(blocks)} of {total} blocks, and the same command goes on from there"
        console.print_lines(f"dhcal: interrupted; {kept}")
        return 130
    header, rows = table(wanted, blocks)
    drawn = study_svg(wanted.title or "study", header, rows, len(fields(Setting)))
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    contents = {args.output: csv_text(columns)} | ({picture: drawn} if drawn else {})
    write_files(contents)
    os.unlink(journal)
    _shown(wanted, header, rows)
    console.print_lines(*(f"wrote {path}" for path in contents))
    return 0


def _resumed(journal: str, wanted: StudyGrid) -> list[list[list[float]]]:
    """The blocks that a run before this one finished."""
    if not os.path.exists(journal):
        return []
    head, *lines = read_text(journal).split("\n")
    if head != wanted.digest:
        raise DhcalError(
            f"{journal}: belongs to another study, or to other robots; finish that one, or remove the file"
        )
    blocks = []
    # The last line is empty, or was cut by the kill.
    with suppress(ValueError):
        for line in lines[:-1]:
            blocks.append(json.loads(line))
    return blocks


def _opened(journal: str, wanted: StudyGrid, blocks: Sequence[list[list[float]]]) -> TextIO:
    """The journal with its whole lines, to be written on."""
    write_files({journal: "".join(f"{line}\n" for line in (wanted.digest, *map(json.dumps, blocks)))})
    return open(journal, "a", encoding="utf-8")


def _shown(wanted: StudyGrid, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """The settings that differ, and the figures, in mm and degrees."""
    count = len(fields(Setting))
    varied = [i for i in range(count) if len({row[i] for row in rows}) > 1]
    names = [name.replace("[m]", " mm").replace("[rad]", " °").replace("_", " ") for name in header]
    scale = [1e3 if "[m]" in name else np.rad2deg(1.0) if "[rad]" in name else 1.0 for name in header]
    told = [i for i in range(count + 1, len(header)) if any(row[i] is not None for row in rows)]
    lines = [
        [str(row[i]) for i in varied] + ["" if row[i] is None else f"{row[i] * scale[i]:.3g}" for i in told]
        for row in rows
    ]
    title = f"{wanted.title or 'study'}: medians of {wanted.seeds} calibrations a line"
    console.print_table(title, Table([names[i] for i in (*varied, *told)], lines, n_text_columns=len(varied)))
