"""Many robots to calibrate: a manifest, read before anything runs, and its jobs in parallel processes.

A manifest is a TOML file whose name ends with `.fleet.toml`. Its keys are the names of the options of
`dhcal calibrate`; at its top they hold for every robot. Paths are relative to the manifest:

    parameters = "minimal,base,tool"
    holdout = 0.3

    [[job]]
    name = "cell 1"                     # optional; the robot's file without it
    robot = "cell1/ur10.urdf"
    data = ["cell1/monday.csv", "cell1/friday.csv"]
    output = "cell1/ur10_calibrated.urdf"
    tip = "tool0"
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, get_args

from .._typing import PathLike
from ..calibration.procedure import Method
from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.robot import robot_name
from ..io.sidecar import sidecar_path
from ..io.tabular import csv_text, read_toml
from ..report.document import json_text
from . import console
from .job import Job
from .options import STDOUT, require_writable_outputs, write_json

OK, NOT_CONVERGED, FAILED = "ok", "not converged", "failed"


@dataclass(frozen=True)
class FleetJob:
    """One robot of a fleet: what it is called, and its job with paths relative to the manifest."""

    name: str
    job: Job


@dataclass(frozen=True)
class FleetJobOutcome:
    """How a robot of a fleet came out.

    Attributes:
        status: "ok", "not converged" (its files are written all the same) or "failed".
        message: why it failed, or what of its data is hard to believe.
        document: as the JSON of `dhcal calibrate`; empty where it failed.
    """

    status: str
    message: str = ""
    document: Mapping[str, Any] = field(default_factory=dict)


# Calibrates one robot, writes its files, and returns its document.
Run = Callable[[Job], Mapping[str, Any]]


def read_fleet(path: PathLike) -> list[FleetJob]:
    """The robots of a manifest.

    Raises:
        DhcalError: it is not a manifest, an option is unknown or of the wrong type, or two jobs would
            get into each other's way.
    """
    raw = read_toml(path)
    tables = raw.pop("job", [])
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise DhcalError(f"{path}: no robots; write a [[job]] table with robot, data and output for each")
    entries = []
    for number, table in enumerate(tables, 1):
        where = f"{path}: job {number}"
        given = {key.replace("-", "_"): value for key, value in (raw | table).items()}
        name = given.pop("name", None)
        options = {key: _option(key, value, where) for key, value in given.items()}
        for key in ("robot", "data", "output"):
            if not options.get(key):
                raise DhcalError(f"{where}: no {key}; every [[job]] needs robot, data and output")
        job = Job(**options)
        entries.append(FleetJob(str(name or robot_name(job.robot)), job))
    _require_distinct_files(entries, path)
    return entries


def _option(key: str, value: Any, where: str) -> Any:
    """An option's value as the command line would have it."""
    known = {option.name: option for option in fields(Job)}
    if key not in known:
        raise DhcalError(f"{where}: unknown key {key!r}; allowed: name, {', '.join(known)}")
    default = () if key == "data" else known[key].default
    wanted = str if default in (None, MISSING) else type(default)
    if wanted is tuple:
        value = (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value
        good = isinstance(value, tuple) and all(isinstance(item, str) for item in value)
        text = "a path, or a list of paths"
    elif wanted is str:
        # 0.3 may stand without quotes.
        value = str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value
        good, text = isinstance(value, str) and value != "", "a text in quotes"
    else:
        good, text = type(value) is wanted, {bool: "true or false", int: "a whole number"}[wanted]
    if key == "method":
        good, text = value in get_args(Method), " or ".join(get_args(Method))
    if key == "json" and value == STDOUT:
        good, text = False, "a file"
    if not good:
        raise DhcalError(f"{where}: {key} = {value!r}: write {text}")
    return value


def _require_distinct_files(entries: Sequence[FleetJob], path: PathLike) -> None:
    """Complains about a file that one job writes and another one writes or reads."""
    folder = os.path.dirname(os.path.abspath(path))
    jobs = [entry.job for entry in entries]
    written = [(i, p) for i, job in enumerate(jobs, 1) for p in _output_paths(job)]
    read = [(i, p) for i, job in enumerate(jobs, 1) for p in (job.robot, *job.data)]
    writer: dict[str, int] = {}

    def check(number: int, place: str, owner: int) -> None:
        if owner != number:
            raise DhcalError(
                f"{path}: job {number} writes or reads {place}, which job {owner} writes; "
                "give every robot an output of its own"
            )

    for number, place in written:
        check(number, place, writer.setdefault(_absolute(folder, place), number))
    for number, place in read:
        check(number, place, writer.get(_absolute(folder, place), number))


def _absolute(folder: str, place: str) -> str:
    return os.path.realpath(os.path.join(folder, place))


def _output_paths(job: Job) -> list[str]:
    kept = (job.output, sidecar_path(job.output), job.map, job.json, *job.report)
    return [place for place in kept if place]


def file_paths(entries: Sequence[FleetJob], path: PathLike) -> list[str]:
    """Paths of the files that a fleet reads or writes, seen from here."""
    folder = os.path.dirname(os.fspath(path))
    every = [place for e in entries for place in (e.job.robot, *e.job.data, *_output_paths(e.job))]
    return [os.path.join(folder, place) for place in every]


def run_fleet(
    entries: Sequence[FleetJob],
    path: PathLike,
    run: Run,
    workers: int,
    done: Callable[[int, FleetJobOutcome], None],
) -> list[FleetJobOutcome]:
    """Calibrates every robot, in processes that work in the manifest's folder; one failure stops no other.

    Args:
        entries: the robots.
        path: the manifest.
        run: a function that other processes can import.
        workers: how many processes at a time.
        done: called with a robot's number and outcome as soon as it is known.
    """
    folder = os.path.dirname(os.path.abspath(path))
    out: dict[int, FleetJobOutcome] = {}

    def gather(numbers: Sequence[int], count: int) -> list[int]:
        """Runs some robots; returns those whose process died, or that waited for one that did."""
        lost = []
        # A fresh interpreter each: forking a process with threads can hang.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, context, initializer=_initialize_process, initargs=(folder,))
        try:
            futures = {pool.submit(_work, run, entries[number].job): number for number in numbers}
            for future in as_completed(futures):
                number = futures[future]
                try:
                    out[number] = future.result()
                except BrokenProcessPool:
                    lost.append(number)
                else:
                    done(number, out[number])
        finally:
            pool.shutdown(cancel_futures=True)
        return lost

    for number in sorted(gather(range(len(entries)), min(workers, len(entries)))):
        # One of them brought its process down; alone, it cannot harm the others.
        if gather([number], 1):
            out[number] = FleetJobOutcome(FAILED, "its process was killed, perhaps for want of memory")
            done(number, out[number])
    return [out[number] for number in range(len(entries))]


def _initialize_process(folder: str) -> None:
    """Readies a process: paths are relative to the manifest, and an interrupt only ends a job."""
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(run: Run, job: Job) -> FleetJobOutcome:
    """One job in its process."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        document = run(job)
        doubts = [f"warning: {text}" for text in document.get("warnings", [])]
        return FleetJobOutcome(OK if document["converged"] else NOT_CONVERGED, "; ".join(doubts), document)
    except DhcalError as error:
        return FleetJobOutcome(FAILED, " ".join(str(error).split()))
    except KeyboardInterrupt:
        return FleetJobOutcome(FAILED, "interrupted; nothing written")
    except Exception as error:  # A defect in one robot's run must not lose the others'.
        return FleetJobOutcome(
            FAILED, f"{type(error).__name__}: {' '.join(str(error).split())}; please report it"
        )
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


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
    told = Job.from_args(args)
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
    require_writable_outputs([args.output, args.json], [args.robot, *file_paths(entries, args.robot)])
    width = max(len(entry.name) for entry in entries)
    total, count = len(entries), 0

    def done(number: int, outcome: FleetJobOutcome) -> None:
        nonlocal count
        count += 1
        style = "" if outcome.status == "ok" else "red" if outcome.status == FAILED else "yellow"
        line = f"{count:{len(str(total))}} of {total}  {entries[number].name:{width}}  {_line(outcome)}"
        console.print_lines(line, style=style)
        if outcome.status != FAILED and outcome.message:
            console.print_lines(f"        {outcome.message}", style="yellow")

    try:
        found = run_fleet(entries, args.robot, calibrate, args.jobs or os.cpu_count() or 1, done)
    except KeyboardInterrupt:
        console.print_lines(f"dhcal: interrupted; {count} of {total} robots are done; no summary written")
        return 130
    contents: dict[PathLike, str | bytes] = {args.output: summary_text(entries, found)}
    document = _document(entries, found)
    if args.json and args.json != STDOUT:
        contents[args.json] = json_text(document)
    write_files(contents)
    if args.json == STDOUT:
        write_json(args.json, document)
    failed = sum(outcome.status == FAILED for outcome in found)
    console.print_lines(f"{total - failed} of {total} robots calibrated", f"wrote {args.output}")
    return 1 if failed else 0


def _line(outcome: FleetJobOutcome) -> str:
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


def summary_text(entries: Sequence[FleetJob], found: Sequence[FleetJobOutcome]) -> str:
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


def _document(entries: Sequence[FleetJob], found: Sequence[FleetJobOutcome]) -> dict[str, Any]:
    """The fleet as JSON: every robot's document, or why it failed."""
    jobs = [
        {"name": entry.name, "robot": entry.job.robot, "output": entry.job.output}
        | {"status": outcome.status, "message": outcome.message, "result": outcome.document or None}
        for entry, outcome in zip(entries, found, strict=True)
    ]
    return {"robots": len(jobs), "failed": sum(job["status"] == FAILED for job in jobs), "jobs": jobs}
