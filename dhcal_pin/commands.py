"""What each command of `dhcal` does, once the command line is read.

Wrong input is found before anything is written or shown; JSON goes to stdout, all else to stderr.
"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from . import (
    calibration,
    compensate_command,
    demo,
    exports,
    extension,
    fleet_command,
    plan_command,
    report,
    study_command,
    terminal,
    ur_kinematics,
    view_command,
)
from .chain import Chain
from .check import crosscheck
from .configuration_files import map_text
from .configurations import joint_range
from .dh_files import dh_text, is_dh
from .dh_urdf import dh_to_urdf
from .errors import DhcalError
from .executors import HERE, Workers, workers
from .files import PathLike, parse_noise, save
from .fleet import is_fleet
from .jobs import Job
from .kinds import KINDS
from .measurement_files import measurement_text, read_readings
from .measurements import Measurement, Noise
from .outputs import STDOUT, check_outputs, emit, names, same, sidecars
from .parameters import EXTENSIONS, extract
from .plausibility import doubts
from .result import Result, accuracy
from .robot_files import (
    existing_sidecar,
    is_table,
    read_instrument,
    read_priors,
    read_robot,
    read_table,
    robot_name,
    sidecar_path,
    urdf_files,
)
from .screening import Finding, screen
from .solver import Progress
from .workspace import workspace_map

# --- calibrate -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Data:
    """What is fitted and held out, and by file the impossible rows left out of both, and doubts."""

    fit: dict[str, Measurement]
    holdout: list[Measurement]
    findings: dict[str, list[Finding]]
    doubts: dict[str, list[str]]


def _without(data: Measurement, findings: Sequence[Finding]) -> Measurement:
    return data.take(~np.isin(data.rows, [finding.row for finding in findings]))


def _read_data(chain: Chain, args: Job, held_file: str | None, known_frames: bool) -> _Data:
    """All measurements, split as the files' `set` columns and --holdout ask."""
    fit: list[Measurement] = []
    holdout: list[Measurement] = []
    findings: dict[str, list[Finding]] = {}
    doubtful: dict[str, list[str]] = {}
    for path in [*args.data, *([held_file] if held_file else [])]:
        readings = read_readings(path, chain, args.columns)
        doubtful[path] = doubts(chain, readings)
        # A row can only be called impossible where base and tool are known.
        findings[path] = screen(chain, readings) if known_frames else []
        if path == held_file:
            holdout.append(_without(readings.data, findings[path]))
        else:
            fit.append(_without(readings.fit, findings[path]))
            holdout.append(_without(readings.holdout, findings[path]))
    if args.holdout is not None and not held_file:
        try:
            fraction = float(args.holdout)
        except ValueError:
            raise DhcalError(f"--holdout {args.holdout}: neither a file nor a share such as 0.3") from None
        kept, parted = calibration.split(fit, fraction, args.seed)
        fit, holdout = list(kept), holdout + list(parted)
    fitted = {path: item for path, item in zip(args.data, fit, strict=True) if len(item.rows)}
    if not fitted:
        raise DhcalError(f"{', '.join(args.data)}: every row is held out; leave some to fit")
    return _Data(fitted, [item for item in holdout if len(item.rows)], findings, doubtful)


@dataclass(frozen=True, eq=False)
class Outcome:
    """A calibration whose files are written.

    Attributes:
        fit: what was found.
        document: the same as JSON.
        files: paths of what was written, by what it is.
        findings, gross, doubts: by file, the impossible rows, the numbers of gross ones, and what is hard
            to believe.
        trials: what each family of --extend brought.
    """

    fit: Result
    document: dict[str, Any]
    files: dict[str, str]
    findings: dict[str, list[Finding]]
    gross: dict[str, list[int]]
    doubts: dict[str, list[str]]
    trials: tuple[extension.Trial, ...]


def run_job(args: Job, progress: Progress | None = None, where: Workers = HERE) -> Outcome:
    """Calibrates one robot and writes its files, in this process or another; shows nothing.

    Raises:
        DhcalError: the input is wrong or a file cannot be written; then none is.
    """
    held_file = args.holdout if args.holdout is not None and os.path.exists(args.holdout) else None
    measured = [*args.data, *([held_file] if held_file else [])]
    for number, path in enumerate(measured):
        if any(same(path, other) for other in measured[:number]):
            raise DhcalError(f"{path}: is given twice; each measurement counts once, to fit or to hold out")
    robot = [args.robot, *sidecars([args.robot])]
    priors = [args.priors] if args.priors not in (None, "default", "none") else []
    priors += [args.instrument] if args.instrument else []
    maps = [args.columns] if args.columns else []
    inputs = [*robot, *measured, *priors, *maps]
    _urdf_ending(args.output)
    check_outputs([args.json], inputs)
    kept = [*measured, *priors, *maps] if args.in_place else inputs
    check_outputs([args.output, sidecar_path(args.output), args.map, args.json], kept)

    chain = read_robot(args.robot, args.tip)
    sets = args.parameters or chain.parameters
    data = _read_data(chain, args, held_file, known_frames=not {"base", "tool"} & set(names(sets)))
    fit, trials = extension.extend(
        chain,
        list(data.fit.values()),
        sets,
        _families(args.extend),
        method=args.method,
        priors=read_priors(args.priors),
        fix=names(args.fix),
        free=names(args.free),
        holdout=data.holdout,
        known=read_instrument(args.instrument) if args.instrument else None,
        loss=args.loss,
        max_iterations=args.max_iterations,
        progress=progress,
        where=where,
    )
    contents = _written(fit, args)
    files: dict[str, str] = dict(zip(("urdf", "sidecar"), map(str, contents), strict=False))
    if args.map:
        contents[args.map], files["map"] = map_text(workspace_map(fit)), args.map
    if args.json and args.json != STDOUT:
        files["json"] = args.json
    gross = dict(zip(data.fit, (rows.tolist() for rows in fit.outliers), strict=True))
    impossible = {path: [finding.row for finding in found] for path, found in data.findings.items()}
    rows = {
        path: sorted(impossible[path] + gross.get(path, []))
        for path in impossible
        if impossible[path] + gross.get(path, [])
    }
    document = report.document(
        fit, files, report.fingerprints(inputs), [row for found in rows.values() for row in found]
    ) | {"outliers_by_file": rows, "extension": [asdict(trial) for trial in trials]}
    if args.json and args.json != STDOUT:
        contents[args.json] = report.json_text(document)
    save(contents)
    return Outcome(fit, document, files, data.findings, gross, data.doubts, trials)


def _calibrate_one(job: Job) -> dict[str, Any]:
    """A robot of a fleet, in a process of its own."""
    return run_job(job).document


def _calibrate(args: Namespace) -> int:
    if is_fleet(args.robot):
        if args.scheduler:
            raise DhcalError("--scheduler: goes with one robot; a manifest takes --jobs")
        return fleet_command.run(args, _calibrate_one)
    if not args.data:
        raise DhcalError(f"DATA is required: name at least one measurement file behind {args.robot}")
    with workers(args.jobs or 1, args.scheduler) as where, terminal.progress("fitting") as progress:
        outcome = run_job(Job.of(args), progress, where)
    if args.json == STDOUT:
        emit(args.json, outcome.document)
    for path, found in outcome.findings.items():
        terminal.findings(path, found)
        terminal.gross(path, outcome.gross.get(path, []), args.loss)
    for path, texts in outcome.doubts.items():
        terminal.doubts(path, texts)
    terminal.trials(outcome.trials)
    terminal.summary(outcome.fit, outcome.files)
    return 0


def _families(extend: str) -> tuple[str, ...]:
    """The families that --extend may add."""
    return {"none": (), "auto": EXTENSIONS}.get(extend, tuple(names(extend)))


def _written(fit: Result, args: Job) -> dict[PathLike, str | bytes]:
    """The calibrated URDF and its sidecar, base and tool moved into the URDF where that was asked for."""
    chain = fit.chain
    # A base that the URDF holds must not stand in the sidecar too.
    bare = replace(chain, base=np.eye(4)) if args.world_joint else chain
    contents = urdf_files(bare, args.output, fit.portable)
    data = contents[args.output]
    assert isinstance(data, bytes)
    if args.world_joint and chain.transmission is not None and chain.transmission.yields:
        raise DhcalError(
            "--world-joint: gravity's torques on the joints count on the robot's own root, z up; leave it out"
        )
    if args.world_joint:
        data = exports.with_world(data, chain.base)
    if args.tool_frame:
        data = exports.with_tool_frame(data, chain.tip, args.tool_frame, chain.tool)
    return contents | {args.output: data}


# --- the other commands ----------------------------------------------------------------------------


def _validate(args: Namespace) -> int:
    sidecar = args.sidecar or existing_sidecar(args.robot)
    inputs = [args.robot, *args.data, *filter(None, (sidecar, args.columns))]
    check_outputs([args.json], inputs)
    chain = read_robot(args.robot, args.tip, sidecar)
    readings = [read_readings(path, chain, args.columns) for path in args.data]
    data = [item.data for item in readings]
    surveyed = read_instrument(sidecar) if sidecar else {}
    there = {unknown.name for item in data for unknown in item.unknowns}
    known = {name: value for name, value in surveyed.items() if name in there}
    if args.fit_frames:
        fit = calibration.calibrate(chain, data, "base,tool", known=known)
        document = report.document(fit, {}, report.fingerprints(inputs))
    else:
        document = report.plain_document(chain, data, report.fingerprints(inputs), known)
    document["before"] = accuracy(chain, data, known)
    document["files"] = {"json": args.json} if args.json and args.json != STDOUT else {}
    emit(args.json, document)
    for item in readings:
        terminal.doubts(item.source, doubts(chain, item))
    terminal.validation(args.robot, document, args.fit_frames)
    return 0


def _convert(args: Namespace) -> int:
    check_outputs([args.output], [args.input])
    low = args.output.lower()
    if low.endswith(".origins.csv"):
        text, notes = exports.origins_text(read_robot(args.input, args.tip)), ()
    elif low.endswith((".yaml", ".yml")):
        text, notes = ur_kinematics.ur_kinematics_text(read_robot(args.input, args.tip)), ()
    elif is_dh(args.output):
        text, notes = _to_dh(args)
    elif is_table(args.input):
        text, notes = _to_urdf(args)
    else:
        raise DhcalError(
            f"{args.output}: unknown ending; "
            "a URDF converts to .dh.toml, .dh.csv, .origins.csv, or UR's .yaml"
        )
    save({args.output: text})
    terminal.lines(f"wrote {args.output}")
    terminal.notes(notes)
    return 0


def _to_dh(args: Namespace) -> tuple[str, Sequence[str]]:
    chain = read_robot(args.input, args.tip)
    if is_table(args.input):
        table = read_table(args.input)
        if args.convention in (None, table.convention):
            return dh_text(table, args.output), ()
    found = extract(chain, args.convention or "standard")
    left = [f"base, tool and joints in {path} do not go to the table" for path in sidecars([args.input])]
    return dh_text(found.table, args.output), [*found.notes, *left]


def _to_urdf(args: Namespace) -> tuple[str, Sequence[str]]:
    _urdf_ending(args.output, "or a DH table as .dh.toml or .dh.csv")
    if args.tip is not None or args.convention is not None:
        raise DhcalError(f"{args.input}: a table has one tip and one URDF; leave out --tip and --convention")
    beside = [f"{path} lies beside it and is read with it" for path in sidecars([args.output])]
    return dh_to_urdf(read_table(args.input), robot_name(args.input)), beside


def _urdf_ending(path: str, other: str = "") -> None:
    if not path.lower().endswith(".urdf"):
        raise DhcalError(f"{path}: unknown ending; write a URDF as .urdf {other}".rstrip())


def _check(args: Namespace) -> int:
    check_outputs([args.json], [args.robot])
    rows = crosscheck(read_robot(args.robot, args.tip))
    agree = all(row.holds for row in rows)
    emit(args.json, {"agree": agree, "routes": [asdict(row) | {"holds": row.holds} for row in rows]})
    terminal.agreement(args.robot, rows)
    return 0 if agree else 1


def _simulate(args: Namespace) -> int:
    robots = [args.robot, *([args.truth] if args.truth else [])]
    check_outputs([args.output], [*robots, *sidecars(robots)])
    noise = Noise(*parse_noise(args.noise))
    if args.kind not in KINDS:
        raise DhcalError(f"--kind {args.kind}: choose from {', '.join(KINDS)}")
    chain = truth = read_robot(args.robot, args.tip)
    if args.truth:
        truth = read_robot(args.truth, None if is_table(args.truth) else args.tip)
        if truth.joint_names != chain.joint_names:
            raise DhcalError(
                f"{args.truth}: its joints are {', '.join(truth.joint_names)}; "
                f"they must be those of {args.robot}: {', '.join(chain.joint_names)}"
            )
    rng = np.random.default_rng(args.seed)
    q = rng.uniform(*joint_range(chain), (args.samples, chain.size))
    data = KINDS[args.kind].simulate(truth, q, noise, rng)
    comments = [f"simulated {args.kind} of {args.truth or args.robot}, noise {args.noise}, seed {args.seed}"]
    save({args.output: measurement_text(data, chain, comments)})
    terminal.lines(f"wrote {args.output}")
    return 0


def _demo(args: Namespace) -> int:
    check_outputs([args.json], [])
    document = demo.run(args.out)
    emit(args.json, document)
    if args.open:
        terminal.open_page(document["files"]["scene"])
    return 0


COMMANDS: dict[str, Callable[[Namespace], int]] = {
    "demo": _demo,
    "calibrate": _calibrate,
    "validate": _validate,
    "convert": _convert,
    "view": view_command.view,
    "check": _check,
    "plan": plan_command.run,
    "simulate": _simulate,
    "compensate": compensate_command.run,
    "study": study_command.study,
}
