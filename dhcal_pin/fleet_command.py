"""`dhcal calibrate MANIFEST.fleet.toml`: many robots, one line each, and a summary."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from . import report, terminal
from .errors import DhcalError
from .files import PathLike, csv_text
from .fleet import FAILED, Entry, Outcome, Run, places, read_fleet, run_fleet
from .jobs import Job
from .outputs import STDOUT, check_outputs, emit
from .saving import save

_STAGES = ("before", "after", "holdout_before", "holdout_after")
# Columns of the summary: a key of the accuracy, its name there, and the factor from SI.
_ERRORS = (
    ("position_rms_m", "position_rms[mm]", 1e3),
    ("orientation_rms_rad", "orientation_rms[mrad]", 1e3),
    ("residual_rms", "residual_rms[mm]", 1e3),
)
_FIGURES = ("iterations", "samples", "samples_holdout", "rank", "parameters_total")


def run(args: Namespace, calibrate: Run) -> int:
    """Calibrates the robots of a manifest; 0 all done, 1 some failed. `calibrate` does one of them."""
    plain = Job(args.robot, (), args.output, json=args.json)
    told = Job.of(args)
    if args.data:
        raise DhcalError(f"{args.data[0]}: beside a manifest; the data stand in its [[job]] tables")
    for option in fields(Job):
        if getattr(told, option.name) != getattr(plain, option.name):
            raise DhcalError(
                f"--{option.name.replace('_', '-')}: beside a manifest; write it at the top of {args.robot}, "
                "for all robots, or into a [[job]]"
            )
    if not args.output.lower().endswith(".csv"):
        raise DhcalError(f"{args.output}: the summary of a fleet is a table; name a .csv file")
    entries = read_fleet(args.robot)
    check_outputs([args.output, args.json], [args.robot, *places(entries, args.robot)])
    width = max(len(entry.name) for entry in entries)
    total, count = len(entries), 0

    def done(number: int, outcome: Outcome) -> None:
        nonlocal count
        count += 1
        style = "" if outcome.status == "ok" else "red" if outcome.status == FAILED else "yellow"
        line = f"{count:{len(str(total))}} of {total}  {entries[number].name:{width}}  {_line(outcome)}"
        terminal.lines(line, style=style)
        if outcome.status != FAILED and outcome.message:
            terminal.lines(f"        {outcome.message}", style="yellow")

    try:
        found = run_fleet(entries, args.robot, calibrate, args.jobs or os.cpu_count() or 1, done)
    except KeyboardInterrupt:
        terminal.lines(f"dhcal: interrupted; {count} of {total} robots are done; no summary written")
        return 130
    contents: dict[PathLike, str | bytes] = {args.output: summary_text(entries, found)}
    document = _document(entries, found)
    if args.json and args.json != STDOUT:
        contents[args.json] = report.json_text(document)
    save(contents)
    if args.json == STDOUT:
        emit(args.json, document)
    failed = sum(outcome.status == FAILED for outcome in found)
    terminal.lines(f"{total - failed} of {total} robots calibrated", f"wrote {args.output}")
    return 1 if failed else 0


def _line(outcome: Outcome) -> str:
    """A robot's outcome for people: the error held out, or that of the fit where nothing is."""
    if outcome.status == FAILED:
        return f"failed: {outcome.message}"
    document = outcome.document
    held = bool(document["holdout_after"])
    stages = _STAGES[2:] if held else _STAGES[:2]
    parts = []
    for key, name, factor in _ERRORS:
        before, after = (document[stage].get(key) for stage in stages)
        if after is not None:
            what, unit = name.rstrip("]").split("[")
            parts.append(f"{what.replace('_', ' ')} {factor * before:.3g} → {factor * after:.3g} {unit}")
    return f"{', '.join(parts)} {'held out' if held else 'as fitted'}; {outcome.status}"


def summary_text(entries: Sequence[Entry], found: Sequence[Outcome]) -> str:
    """The CSV of a fleet, a row a robot; empty where a robot failed or has no such figure."""
    rows = []
    for entry, outcome in zip(entries, found, strict=True):
        row: dict[str, Any] = {"name": entry.name, "robot": entry.job.robot, "output": entry.job.output}
        row |= {"status": outcome.status, "converged": str(outcome.document.get("converged", "")).lower()}
        row |= {key: outcome.document.get(key, "") for key in _FIGURES}
        for stage in _STAGES:
            accuracy: Mapping[str, float] = outcome.document.get(stage) or {}
            for key, name, factor in _ERRORS:
                row[f"{stage}_{name}"] = repr(factor * accuracy[key]) if key in accuracy else ""
        rows.append(row | {"message": outcome.message})
    return csv_text({name: [row[name] for row in rows] for name in rows[0]})


def _document(entries: Sequence[Entry], found: Sequence[Outcome]) -> dict[str, Any]:
    """The fleet as JSON: every robot's document, or why it failed."""
    jobs = [
        {"name": entry.name, "robot": entry.job.robot, "output": entry.job.output}
        | {"status": outcome.status, "message": outcome.message, "result": outcome.document or None}
        for entry, outcome in zip(entries, found, strict=True)
    ]
    return {"robots": len(jobs), "failed": sum(job["status"] == FAILED for job in jobs), "jobs": jobs}
