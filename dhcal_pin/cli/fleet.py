"""Calibration of many robots: a manifest of jobs, run in parallel processes, and their summary.

A manifest is a TOML file whose name ends with `.fleet.toml`, see docs/howto/fleet.md. Its keys are the names
of the options of `dhcal calibrate`; those at the top apply to every job. Paths are relative to the manifest.

The whole manifest is checked before the first job runs. A job that fails does not stop the others.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import Field, field, fields
from typing import Any

from .._frozen import frozen
from .._typing import PathLike
from ..exceptions import DhcalError, FileFormatError, InvalidArgumentError
from ..io import toml_table as toml
from ..io.robot import robot_name
from ..io.sidecar import sidecar_path
from ..io.tabular import csv_text
from ..io.toml_table import Key, TomlTable
from ..messages import message_line
from ..parallel import end_with_parent
from .bundled_job import run_any_job
from .job import DOUBTFUL, Job, option_flags
from .job_outputs import ROBOT_FORMATS, companion_paths
from .options import STDOUT, IntegerType, find_robot
from .outputs import forget_written_files, require_writable_outputs, write_outputs, written_files
from .screens import console
from .screens.screen import Block, Screen

OK, CAUTION, REFUSED, FAILED = "ok", "caution", "refused", "failed"


@frozen
class FleetJob:
    """One job of a manifest."""

    name: str  # Name shown for the robot
    job: Job  # Its options, with paths relative to the manifest


@frozen
class FleetJobOutcome:
    """Outcome of one job of a manifest."""

    status: str  # "failed", or the verdict on the calibration: "ok", "caution" or "refused"
    message: str  # Reason of the failure, or reasons of the verdict and warnings about the input
    # JSON document as of `dhcal calibrate`; empty if the job failed.
    document: Mapping[str, Any] = field(default_factory=dict)


# Function that calibrates one robot, writes its files and returns its JSON document.
JobRunner = Callable[[Job], Mapping[str, Any]]


# --- manifest --------------------------------------------------------------------------------------


def read_fleet(path: PathLike) -> list[FleetJob]:
    """Read and check a manifest."""
    document = TomlTable.read(path)
    tables = document.tables("job", expected="one for each robot, with robot, data and output")
    shared = {key: document.get(key) for key in document.keys() if key != "job"}
    entries = []
    for table in tables:
        values = shared | {key: table.get(key) for key in table.keys()}
        # The keys may be written as on the command line, with hyphens.
        job_table = TomlTable(
            path, {key.replace("-", "_"): value for key, value in values.items()}, table.name
        )
        name = job_table.get("name", "")
        options = {
            option.name: option_key(option).read(job_table, option.name)
            for option in fields(Job)
            if option.name in job_table
        }
        job_table.finish()
        for key in ("robot", "data", "output"):
            if not options.get(key):
                raise FileFormatError(
                    f"{job_table.where}: {key} is missing; every [[job]] needs robot, data and output"
                )
        options["robot"] = find_robot(options["robot"])
        job = Job(**options)
        entries.append(FleetJob(str(name or robot_name(job.robot)), job))
    _require_distinct_files(entries, path)
    return entries


def option_key(option: Field[Any]) -> Key:
    """Declare the key of a manifest for an option."""
    default = () if option.name == "data" else option.default
    if isinstance(default, bool):
        return toml.flag(default)
    if isinstance(default, int):
        integer: IntegerType = option.metadata["type"]
        return toml.whole(integer.minimum, description=integer.description)
    if isinstance(default, tuple):
        return Key(
            "a path or a list of paths",
            {"type": ["string", "array"], "items": {"type": "string"}},
            lambda value: all(
                isinstance(path, str) for path in (value if isinstance(value, list) else [value])
            ),
            lambda value: (value,) if isinstance(value, str) else tuple(value),
        )
    if choices := option.metadata.get("choices"):
        return Key(" or ".join(choices), {"enum": list(choices)}, choices.__contains__)
    if option.name == "json":
        return Key(
            "the path of a file",
            {"type": "string"},
            lambda value: isinstance(value, str) and value not in ("", STDOUT),
        )
    # A number such as the fraction 0.3 may be written without quotes.
    return Key(
        "a text in quotes",
        {"type": ["string", "number"]},
        lambda value: isinstance(value, str | int | float) and not isinstance(value, bool) and value != "",
        str,
    )


def _require_distinct_files(entries: Sequence[FleetJob], path: PathLike) -> None:
    """Require that no job writes a file that another job reads or writes."""
    folder = os.path.dirname(os.path.abspath(path))
    writers: dict[str, int] = {}
    uses: list[tuple[int, str, int]] = []
    for number, entry in enumerate(entries, 1):
        for file in _output_paths(entry.job):
            uses.append((number, file, writers.setdefault(_real_path(folder, file), number)))
    for number, entry in enumerate(entries, 1):
        for file in (entry.job.robot, *entry.job.data):
            uses.append((number, file, writers.get(_real_path(folder, file), number)))
    for number, file, writer in uses:
        if writer != number:
            raise FileFormatError(
                f"{path}: job {number} uses {file}, which job {writer} writes; every job needs its own output"
            )


def _real_path(folder: str, path: str) -> str:
    """Return the absolute path of a file of a manifest in `folder`, links resolved."""
    return os.path.realpath(os.path.join(folder, path))


def _output_paths(job: Job) -> list[str]:
    """List the files that a job writes."""
    has_more = job.servos or job.curves
    companions = (
        companion_paths(job.output, job.curves, bool(job.servos)) if has_more else [sidecar_path(job.output)]
    )
    return [path for path in (*companions, *job.output_paths) if path]


def file_paths(entries: Sequence[FleetJob], path: PathLike) -> list[str]:
    """List the files that the jobs of a manifest read or write."""
    folder = os.path.dirname(os.fspath(path))
    files = [file for e in entries for file in (e.job.robot, *e.job.data, *_output_paths(e.job))]
    return [os.path.join(folder, file) for file in files]


# --- processes -------------------------------------------------------------------------------------


def run_fleet(
    entries: Sequence[FleetJob],
    path: PathLike,
    runner: JobRunner,
    n_processes: int,
    on_done: Callable[[int, FleetJobOutcome], None],
) -> list[FleetJobOutcome]:
    """Run every job in processes that work in the folder of the manifest."""
    folder = os.path.dirname(os.path.abspath(path))
    outcomes: dict[int, FleetJobOutcome] = {}

    def run_in_pool(indices: Sequence[int], count: int) -> list[int]:
        # Returns the jobs without an outcome, because a process of their pool died.
        lost = []
        # Spawn instead of fork: forking a process that has threads can block forever.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, context, initializer=_initialize_process, initargs=(folder,))
        futures: dict[Future[FleetJobOutcome], int] = {}
        try:
            futures |= {pool.submit(_run_in_process, runner, entries[index].job): index for index in indices}
            for future in as_completed(futures):
                index = futures[future]
                try:
                    outcomes[index] = future.result()
                except BrokenProcessPool:
                    lost.append(index)
                else:
                    on_done(index, outcomes[index])
        finally:
            pool.shutdown(cancel_futures=True)
            # After an interrupt, the jobs that were running have still ended and may have written files.
            for future, index in futures.items():
                if index not in outcomes and not future.cancelled() and future.exception() is None:
                    outcomes[index] = future.result()
                    on_done(index, outcomes[index])
        return lost

    for index in sorted(run_in_pool(range(len(entries)), min(n_processes, len(entries)))):
        # One of these jobs killed its process and the pool with it. Run each of them in its own pool.
        if run_in_pool([index], 1):
            outcomes[index] = FleetJobOutcome(FAILED, "the process was killed; it may have run out of memory")
            on_done(index, outcomes[index])
    return [outcomes[index] for index in range(len(entries))]


def _initialize_process(folder: str) -> None:
    """Change to the folder of the manifest; between jobs the process ignores interrupts."""
    end_with_parent()
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run_in_process(runner: JobRunner, job: Job) -> FleetJobOutcome:
    """Run one job and convert its errors to an outcome; an interrupt ends only this job."""
    forget_written_files()
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        document = runner(job)
        verdict = document["verdict"]
        notes = [*verdict["reasons"], *(f"warning: {text}" for text in document.get("warnings", []))]
        return FleetJobOutcome(verdict["status"], "; ".join(notes), document)
    except DhcalError as error:
        return FleetJobOutcome(FAILED, message_line(error))
    except KeyboardInterrupt:
        written = ", ".join(written_files())
        what = f"these files are written: {written}" if written else "nothing written"
        return FleetJobOutcome(FAILED, f"interrupted; {what}")
    except Exception as error:  # A defect that one job reveals must not lose the results of the others.
        return FleetJobOutcome(
            FAILED, f"{type(error).__name__}: {message_line(error)}; please report this error"
        )
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run_one(job: Job) -> Mapping[str, Any]:
    """Run one job; return its JSON document."""
    return run_any_job(job).document


# --- command ---------------------------------------------------------------------------------------

_STAGES = ("before", "after", "holdout_before", "holdout_after")

# Columns of the summary: key of the accuracy, name of the column with its unit, and factor from SI.
_ERRORS = (
    ("position_rms_m", "position_rms[mm]", 1e3),
    ("orientation_rms_rad", "orientation_rms[mrad]", 1e3),
    ("residual_rms", "residual_rms[mm]", 1e3),
)

# Numbers of a document that the summary repeats.
_FIGURES = ("iterations", "samples", "samples_holdout", "rank", "parameters_total")


def run_manifest(args: Namespace) -> int:
    """Calibrate the robots of a manifest and write their summary."""
    _require_manifest_arguments(args)
    entries = read_fleet(args.robot)
    require_writable_outputs([args.output, args.json], [args.robot, *file_paths(entries, args.robot)])
    total, n_done = len(entries), 0

    try:
        with console.progress_bar("calibrating robots", total) as progress:

            def show(index: int, outcome: FleetJobOutcome) -> None:
                nonlocal n_done
                n_done += 1
                progress(n_done)
                if args.verbosity == "verbose":
                    line = f"{n_done} of {total}: {_robot_text(entries[index], outcome)}"
                    console.print_lines(line, style=_STYLES.get(outcome.status, "yellow"))

            outcomes = run_fleet(entries, args.robot, _run_one, args.jobs or os.cpu_count() or 1, show)
        contents: dict[PathLike, str | bytes | None] = {args.output: summary_text(entries, outcomes)}
        write_outputs(contents, args.json, _fleet_document(entries, outcomes))
    except KeyboardInterrupt:
        if written_files():
            raise
        console.print_lines(f"dhcal: interrupted; {n_done} of {total} robots are done; no summary written")
        return 130
    n_written = sum(map(_is_written, outcomes))
    console.show(_fleet_screen(entries, outcomes, args), args.verbosity)
    if n_written < total or (args.strict and any(outcome.status == REFUSED for outcome in outcomes)):
        return 1
    return DOUBTFUL if args.strict and any(outcome.status != OK for outcome in outcomes) else 0


# Styles of robots by status, the most severe first.
_STYLES = {FAILED: "red", REFUSED: "red", CAUTION: "yellow", OK: ""}


def _fleet_screen(
    entries: Sequence[FleetJob], outcomes: Sequence[FleetJobOutcome], args: Namespace
) -> Screen:
    """Describe the outcomes; robots that need attention come first."""
    blocks = []
    for rank, (status, style) in enumerate(reversed(_STYLES.items())):
        pairs = zip(entries, outcomes, strict=True)
        texts = [_robot_text(entry, outcome) for entry, outcome in pairs if outcome.status == status]
        blocks.append(Block(texts, style, noun=f"robot with status {status}", rank=rank))
    n_written = sum(map(_is_written, outcomes))
    text = f"{n_written} of {len(entries)} robots calibrated"
    return Screen(
        [*reversed(blocks), Block([f"wrote {args.output}"]), Block([text], "bold", is_verdict=True)]
    )


def _robot_text(entry: FleetJob, outcome: FleetJobOutcome) -> str:
    """Describe the outcome of one robot, with the reasons and warnings."""
    text = f"{entry.name}: {_outcome_text(outcome)}"
    has_notes = outcome.status != FAILED and outcome.message
    return f"{text}; {outcome.message}" if has_notes else text


def _is_written(outcome: FleetJobOutcome) -> bool:
    """Return whether a corrected robot was written: neither failed nor refused, or refused but forced."""
    files = outcome.document.get("files", {})
    return any(ending[1:] in files for ending in ROBOT_FORMATS)


def _require_manifest_arguments(args: Namespace) -> None:
    """Raise an error if the command line has options that belong into the manifest."""
    if args.data:
        raise InvalidArgumentError(
            f"{args.data[0]}: not allowed beside a manifest; name the data in its [[job]] tables"
        )
    given, allowed = Job.from_args(args), Job(args.robot, (), args.output, json=args.json)
    for option in fields(Job):
        if getattr(given, option.name) != getattr(allowed, option.name):
            raise InvalidArgumentError(
                f"{option_flags(option)[-1]}: not allowed beside a manifest; write it into {args.robot}, at "
                "the top for all robots or into a [[job]]"
            )
    if not args.output.lower().endswith(".csv"):
        raise InvalidArgumentError(
            f"{args.output}: the summary of a manifest is a table; expected a .csv file"
        )


def _outcome_text(outcome: FleetJobOutcome) -> str:
    """Describe an outcome by its hold-out errors, or by those of the fit if nothing is held out."""
    if outcome.status == FAILED:
        return f"failed: {outcome.message}"
    document = outcome.document
    has_holdout = bool(document["holdout_after"])
    parts = []
    for key, column, factor in _ERRORS:
        before, after = (document[stage].get(key) for stage in (_STAGES[2:] if has_holdout else _STAGES[:2]))
        if after is not None:
            name, unit = column.rstrip("]").split("[")
            label = name.replace("_rms", " RMS")
            parts.append(f"{label} {factor * before:.3g} → {factor * after:.3g} {unit}")
    return f"{', '.join(parts)} ({'hold-out' if has_holdout else 'fitted'}); {outcome.status}"


def summary_text(entries: Sequence[FleetJob], outcomes: Sequence[FleetJobOutcome]) -> str:
    """Format the summary of a manifest."""
    rows = []
    for entry, outcome in zip(entries, outcomes, strict=True):
        row: dict[str, Any] = {"name": entry.name, "robot": entry.job.robot, "output": entry.job.output}
        row |= {"status": outcome.status, "converged": str(outcome.document.get("converged", "")).lower()}
        row |= {key: outcome.document.get(key, "") for key in _FIGURES}
        for stage in _STAGES:
            accuracy: Mapping[str, float] = outcome.document.get(stage) or {}
            for key, name, factor in _ERRORS:
                row[f"{stage}_{name}"] = repr(factor * accuracy[key]) if key in accuracy else ""
        rows.append(row | {"message": outcome.message})
    return csv_text({name: [row[name] for row in rows] for name in rows[0]})


def _fleet_document(entries: Sequence[FleetJob], outcomes: Sequence[FleetJobOutcome]) -> dict[str, Any]:
    """Create the JSON document of a manifest."""
    jobs = [
        {"name": entry.name, "robot": entry.job.robot, "output": entry.job.output}
        | {"status": outcome.status, "message": outcome.message, "result": outcome.document or None}
        for entry, outcome in zip(entries, outcomes, strict=True)
    ]
    count = {status: sum(job["status"] == status for job in jobs) for status in (FAILED, REFUSED)}
    return {"robots": len(jobs), **count, "jobs": jobs}
