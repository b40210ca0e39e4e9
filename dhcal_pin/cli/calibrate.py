"""`dhcal calibrate`: files in, a fit, files out; any process can do one robot of many."""

from __future__ import annotations

import fnmatch
import os
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from .._typing import PathLike
from ..calibration import model_selection, partition, procedure, summary
from ..calibration.model_selection import FULL_SET, is_restricted
from ..calibration.result import Result
from ..diagnostics.input_checks import find_input_warnings, poorly_fitted_files
from ..diagnostics.reachability import UnreachableRow, find_unreachable_rows
from ..estimation.parameters import EXTENSIONS, select_parameters
from ..estimation.robust import ZERO_WEIGHT
from ..estimation.solver import Progress
from ..exceptions import DhcalError
from ..io.atomic import write_files
from ..io.measurement_csv import read_measurement_file
from ..io.robot import read_robot, urdf_files
from ..io.settings import parse_payload, read_bounds, read_priors
from ..io.sidecar import read_instrument, sidecar_path
from ..measurements.base import Measurement
from ..measurements.position import require_common_reference_target
from ..parallel import SERIAL, TaskExecutor, open_executor
from ..report.document import (
    Provenance,
    file_digests,
    json_text,
    result_to_dict,
    short_names,
)
from ..robot import urdf_edit
from ..robot.chain import Chain
from . import console
from .job import Job, is_manifest
from .options import (
    STDOUT,
    is_same_file,
    require_urdf_ending,
    require_writable_outputs,
    sidecars,
    split_commas,
    write_json,
)


@dataclass(frozen=True)
class _Data:
    """What is fitted and held out by file, and the impossible rows left out of both, and doubts."""

    fit: dict[str, Measurement]
    holdout: list[tuple[str, Measurement]]
    findings: dict[str, list[UnreachableRow]]
    warnings: dict[str, list[str]]


def _without(data: Measurement, findings: Sequence[UnreachableRow]) -> Measurement:
    return data.take(~np.isin(data.rows, [finding.row for finding in findings]))


def _read_data(chain: Chain, args: Job, held_file: str | None, known_frames: bool) -> _Data:
    """All measurements, split as the files' `set` columns and --holdout ask."""
    fit: list[Measurement] = []
    holdout: list[tuple[str, Measurement]] = []
    findings: dict[str, list[UnreachableRow]] = {}
    doubtful: dict[str, list[str]] = {}
    every: dict[str, Measurement] = {}
    for path in [*args.data, *([held_file] if held_file else [])]:
        readings = read_measurement_file(path, chain, args.columns)
        every[path] = readings.data
        doubtful[path] = find_input_warnings(chain, readings)
        # A row can only be called impossible where base and tool are known.
        findings[path] = find_unreachable_rows(chain, readings) if known_frames else []
        if path == held_file:
            holdout.append((path, _without(readings.data, findings[path])))
        else:
            fit.append(_without(readings.fit, findings[path]))
            holdout.append((path, _without(readings.holdout, findings[path])))
    require_common_reference_target(every)
    if args.holdout is not None and not held_file:
        try:
            fraction = float(args.holdout)
        except ValueError:
            raise DhcalError(f"--holdout {args.holdout}: neither a file nor a share such as 0.3") from None
        kept, parted = partition.split(fit, fraction, args.seed)
        drawn = [path for path, a, b in zip(args.data, fit, kept, strict=True) if len(b.rows) < len(a.rows)]
        fit, holdout = list(kept), [*holdout, *zip(drawn, parted, strict=True)]
    fitted = {path: item for path, item in zip(args.data, fit, strict=True) if len(item.rows)}
    if not fitted:
        raise DhcalError(f"{', '.join(args.data)}: every row is held out; leave some to fit")
    return _Data(fitted, [(path, item) for path, item in holdout if len(item.rows)], findings, doubtful)


@dataclass(frozen=True, eq=False)
class CalibrationOutcome:
    """A calibration whose files are written.

    Attributes:
        fit: what was found.
        document: the same as JSON.
        files: paths of what was written, by what it is.
        findings, outliers, rejected, warnings: by file, the impossible rows, the numbers of gross ones and of those
            that take no part in the fit, and what is hard to believe.
        trials: what each family of --extend brought.
        hint: what --extend might bring, where it was not asked for.
    """

    fit: Result
    document: dict[str, Any]
    files: dict[str, str]
    findings: dict[str, list[UnreachableRow]]
    outliers: dict[str, list[int]]
    rejected: dict[str, list[int]]
    warnings: dict[str, list[str]]
    trials: tuple[model_selection.FamilyTrial, ...]
    hint: str


def run_job(
    args: Job, progress: Progress | None = None, executor: TaskExecutor = SERIAL
) -> CalibrationOutcome:
    """Calibrates one robot and writes its files, in this process or another; shows nothing.

    Raises:
        DhcalError: the input is wrong or a file cannot be written; then none is.
    """
    held_file = args.holdout if args.holdout is not None and os.path.exists(args.holdout) else None
    measured = [*args.data, *([held_file] if held_file else [])]
    for number, path in enumerate(measured):
        if any(is_same_file(path, other) for other in measured[:number]):
            raise DhcalError(f"{path}: is given twice; each measurement counts once, to fit or to hold out")
    robot = [args.robot, *sidecars([args.robot])]
    priors = [args.priors] if args.priors not in (None, "default", "none") else []
    priors += [path for path in (args.bounds, args.instrument) if path]
    maps = [args.columns] if args.columns else []
    inputs = [*robot, *measured, *priors, *maps]
    require_urdf_ending(args.output)
    require_writable_outputs([args.json, *args.report], inputs)
    kept = [*measured, *priors, *maps] if args.in_place else inputs
    require_writable_outputs(
        [args.output, sidecar_path(args.output), args.map, args.json, *args.report], kept
    )
    if args.report:
        from ..report import html  # its figures are a good part of the start-up

        for path in args.report:
            html.check_ending(path)
    if args.map:
        from ..report import workspace_map  # and so are the map's

        workspace_map.check_map_ending(args.map)

    chain = read_robot(args.robot, args.tip)
    if args.payload:
        chain = chain.with_payload(parse_payload(args.payload))
    sets = chain.parameters if args.parameters is None else args.parameters
    data = _read_data(chain, args, held_file, known_frames=not {"base", "tool"} & set(split_commas(sets)))
    options: dict[str, Any] = {
        "priors": read_priors(args.priors),
        "holdout": [item for _, item in data.holdout],
        "known": read_instrument(args.instrument) if args.instrument else None,
        "loss": args.loss,
        "max_iterations": args.max_iterations,
        "progress": progress,
        "executor": executor,
    }
    held = {
        "bounds": read_bounds(args.bounds),
        "fix": split_commas(args.fix),
        "free": split_commas(args.free),
    }
    fit, trials = model_selection.extend(
        chain,
        list(data.fit.values()),
        sets,
        _families(args.extend),
        method=args.method,
        **held,
        **options,
    )
    # Who holds something, or asks for the paper's loop, knows what is unknown; who mixed columns up does not.
    chosen = args.method != "lm" or any(held.values()) or any(data.warnings.values())
    if not chosen and is_restricted(split_commas(sets)):
        data.warnings[args.robot] = [
            *filter(None, [improvement_hint(fit, chain, list(data.fit.values()), **options)])
        ]
    for path, texts in poorly_fitted_files(fit.chain, data.fit, fit.instruments).items():
        # What a file's columns tell already is not told again.
        data.warnings[path] += texts if not data.warnings[path] else []
    # Who has doubts about the data or the sets, or the frames alone to find, is not to look at gears yet.
    early = any(data.warnings.values()) or set(split_commas(sets)) <= {"base", "tool"}
    plain = args.method == "lm" and args.priors != "none" and args.extend == "none"
    hint = model_selection.family_hint(fit) if plain and not early else ""
    contents = _written(fit, args)
    files: dict[str, str] = dict(zip(("urdf", "sidecar"), map(str, contents), strict=False))
    if args.map:
        from ..report import workspace_map

        contents[args.map] = workspace_map.map_content(args.map, fit, fit.holdout, fit.instruments)
        files["map"] = args.map
    if args.json and args.json != STDOUT:
        files["json"] = args.json
    gross = dict(zip(data.fit, (rows.tolist() for rows in fit.outliers), strict=True))
    unheard = (item.rows[weight <= ZERO_WEIGHT] for item, weight in zip(fit.data, fit.weights, strict=True))
    aside = dict(zip(data.fit, (rows.tolist() for rows in unheard), strict=True))
    impossible = {path: [finding.row for finding in found] for path, found in data.findings.items()}
    rows = {
        path: sorted(impossible[path] + gross.get(path, []))
        for path in impossible
        if impossible[path] + gross.get(path, [])
    }
    files |= {
        "report" if number == 1 else f"report_{number}": path for number, path in enumerate(args.report, 1)
    }
    source = _provenance(args, sets, data, inputs, trials, hint)
    if args.report:
        from ..report import html

        contents |= html.report_files(fit, args.report, source)
    document = result_to_dict(fit, files, source.inputs, [row for found in rows.values() for row in found])
    document |= {
        "outliers_by_file": rows,
        "warnings": [f"{path}: {text}" for path, texts in data.warnings.items() for text in texts],
        "command": source.command,
        "settings": source.settings,
        "extension": [asdict(trial) for trial in trials],
        "hint": hint,
    }
    if args.json and args.json != STDOUT:
        contents[args.json] = json_text(document)
    write_files(contents)
    return CalibrationOutcome(fit, document, files, data.findings, gross, aside, data.warnings, trials, hint)


def _provenance(
    args: Job,
    sets: str,
    data: _Data,
    inputs: Sequence[str],
    trials: Sequence[model_selection.FamilyTrial],
    hint: str,
) -> Provenance:
    """What the report says of the files, the command and its choices."""
    short = short_names(inputs)
    settings = {
        "parameters": sets,
        "loss": args.loss,
        "seed": str(args.seed),
    }
    if args.payload:
        settings["payload"] = args.payload
    if args.holdout is not None:
        settings["hold-out"] = short.get(args.holdout, f"{args.holdout} of each file, at random by the seed")
    left_out = {
        short[path]: {finding.row: finding.reason for finding in found}
        for path, found in data.findings.items()
    }
    doubtful = {short[path]: texts for path, texts in data.warnings.items()}
    return Provenance(
        command=args.command(short),
        inputs=file_digests(inputs),
        names=list(data.fit),
        holdout_names=[path for path, _ in data.holdout],
        settings=settings,
        excluded_rows=left_out,
        warnings=doubtful,
        trials=trials,
        hint=hint,
    )


def _families(extend: str) -> tuple[str, ...]:
    """The families that --extend may add."""
    return {"none": (), "auto": EXTENSIONS}.get(extend, tuple(split_commas(extend)))


def _written(fit: Result, args: Job) -> dict[PathLike, str | bytes]:
    """The calibrated URDF and its sidecar, base and tool moved into the URDF where that was asked for."""
    chain = fit.chain
    # A base that the URDF holds must not stand in the sidecar too.
    bare = replace(chain, base=np.eye(4)) if args.world_joint else chain
    contents = urdf_files(bare, args.output, fit.transferable_instruments, fit.uncertainty)
    data = contents[args.output]
    assert isinstance(data, bytes)
    if args.world_joint and chain.transmission is not None and chain.transmission.has_compliance:
        raise DhcalError(
            "--world-joint: gravity's torques on the joints count on the robot's own root, z up; leave it out"
        )
    if args.world_joint:
        data = urdf_edit.with_world(data, chain.base)
    if args.tool_frame:
        data = urdf_edit.with_tool_frame(data, chain.tip, args.tool_frame, chain.tool)
    return contents | {args.output: data}


def _calibrate_one(job: Job) -> dict[str, Any]:
    """A robot of a fleet, in a process of its own."""
    return run_job(job).document


def calibrate(args: Namespace) -> int:
    """One robot, or all of a manifest."""
    if is_manifest(args.robot):
        if args.scheduler:
            raise DhcalError("--scheduler: goes with one robot; a manifest takes --jobs")
        from . import (
            fleet,  # a good part of the start-up, and one robot needs none of it
        )

        return fleet.run(args, _calibrate_one)
    if not args.data:
        raise DhcalError(f"DATA is required: name at least one measurement file behind {args.robot}")
    with open_executor(args.jobs or 1, args.scheduler) as where, console.show_progress("fitting") as progress:
        outcome = run_job(Job.from_args(args), progress, where)
    if args.json == STDOUT:
        write_json(args.json, outcome.document)
    console.print_trials(outcome.trials)
    console.print_summary(outcome.fit, outcome.files)
    for path, found in outcome.findings.items():
        console.print_unreachable_rows(path, found)
        console.print_outliers(path, outcome.outliers.get(path, []), outcome.rejected.get(path, []))
    for path, texts in outcome.warnings.items():
        console.print_warnings(path, texts)
    console.print_hint(outcome.hint)
    console.print_verdict(outcome.fit)
    return 0


# What leaves more than this share of the error is not worth a word; nor is what is left of exact readings.
MAX_ERROR_RATIO = 0.8


EXACT_FIT_RATIO = 1e-6


def improvement_hint(fit: Result, chain: Chain, data: Sequence[Measurement], **options: Any) -> str:
    """A sentence on what EVERYTHING would bring on the samples that were not fitted; "" if little.

    Args:
        fit: as it is.
        chain: the nominal robot.
        data: what was fitted.
        options: of `calibrate`, as for the fit.
    """
    now = fit.comparisons[0]
    group, after = next(iter(now.after.groups.items()))
    if after.rms < EXACT_FIT_RATIO * now.before.groups[group].rms:
        return ""
    if isinstance(priors := options.get("priors"), Mapping):
        # The user's priors are for the chosen sets; drop those without a parameter in the full set.
        names = [p.name for p in select_parameters(chain, FULL_SET).parameters]
        options["priors"] = {key: std for key, std in priors.items() if fnmatch.filter(names, key)}
    wider = procedure.calibrate(chain, data, FULL_SET, **options)
    then = wider.comparisons[0]
    is_worse = then.after.groups[group].rms > MAX_ERROR_RATIO * after.rms
    if now.title == "fitted" or not wider.converged or is_worse:
        return ""
    left, of = summary.headline([then]), summary.headline([now])
    return (
        f"--parameters {FULL_SET} would leave {left.after} RMS {summary.GROUP_LABELS[group]} on samples left out, "
        f"and not {of.after}: the unknowns that were chosen cannot take up what was measured"
    )
