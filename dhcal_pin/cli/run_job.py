"""Work of one calibration job: read files, calibrate, write files; used for one robot and for many.

A job runs in these steps. Invalid input is found before anything is written.

1. Check that all outputs can be written and overwrite no input.
2. Read the robot and the measurements. Rows that the robot cannot reach are excluded if base and tool are
   known; the rest is split into data to fit and hold-out data.
3. Calibrate, with additional joint error families if requested.
4. Collect warnings about the data and the choice of parameters, and a hint on error families.
5. Write URDF, sidecar, report, map and JSON, all or none; of a refused calibration only report and JSON.
"""

from __future__ import annotations

import os
import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from .. import io, plausibility, report, visualization
from .._frozen import frozen
from .._typing import PathLike, Progress
from ..calibration import model_selection, partition, procedure
from ..calibration.cameras import MIXED_SETS, default_sets, describe_configurations, has_images
from ..calibration.evidence import diagnose
from ..calibration.presentation.curves import find_lattices
from ..calibration.result import Result
from ..calibration.session_check import ASSUMED_ORDER, has_assumed_directions
from ..calibration.verdict import suggest_full_set
from ..diagnostics.input_checks import (
    find_payload_warnings,
    find_value_warnings,
    poorly_fitted_files,
    require_joint_units,
)
from ..diagnostics.reachability import UnreachableRow, find_unreachable_rows
from ..diagnostics.robot_checks import find_robot_warnings
from ..estimation.parameters import LOW_COST
from ..estimation.robust import ZERO_WEIGHT
from ..exceptions import FileFormatError, InvalidArgumentError, NotObservableError, UnknownNameError
from ..formatting import texts_by_file
from ..io.measurement_files import MeasurementFile
from ..io.rig_file import read_rig
from ..io.robot import read_robot
from ..io.settings import parse_payload, read_bounds, read_priors
from ..io.sidecar import read_instrument, robots_of_sidecar
from ..measurements.base import Measurement
from ..measurements.mounting import mount_rig
from ..measurements.position import require_common_reference_target
from ..parallel import TaskExecutor
from ..report.json_document import result_to_dict
from ..report.provenance import Provenance, content_digests, file_digests, short_names
from ..robot.chain import Chain
from ..robot.correction_table import correction_columns, joint_corrections
from .arm_types import with_arm_type
from .bundle_content import bundle_content
from .job import REGION, Job
from .job_outputs import (
    ROBOT_FORMATS,
    SERVO_ENDING,
    companion_paths,
    name_robot_files,
    require_servos,
    robot_ending,
    robot_of_table,
    robot_stem,
)
from .options import read_data, split_commas
from .output_table import Makers, file_contents, paths_by_name, require_endings
from .outputs import (
    existing_sidecars,
    is_same_file,
    require_workbook,
    require_writable_outputs,
    write_outputs,
)
from .servo_zeros import describe_moves, move_zeros

# Warning about an empty table of --curves.
NO_CORRECTIONS = (
    "the table of --curves has no rows, because no joint has harmonics; estimate them with --parameters or "
    "--extend"
)

# Largest number of rows of a file that are used. The standard deviations of parameters are then far below all
# other errors; a calibration takes about 15 s and 0.6 GB.
MAX_FILE_ROWS = 200_000


@frozen
class JobData:
    """Measurements of a job, and what was found when they were read."""

    fitted: dict[str, Measurement]  # Measurements that are fitted, by file
    held_out: list[tuple[str, Measurement]]  # Hold-out measurements, each with its file
    n_rows: dict[str, int]  # Number of rows that were read, by file
    # Rows that the robot cannot reach, by file; excluded from everything.
    unreachable: dict[str, list[UnreachableRow]]
    warnings: dict[str, list[str]]  # Warnings about the input, by file
    notes: dict[str, list[str]]  # What of the input is not used, by file
    changes: dict[str, list[str]]  # What --mend changed, by file


@frozen(eq=False)
class CalibrationOutcome:
    """Result of a calibration job whose files are written."""

    fit: Result
    data: JobData
    source: Provenance  # Files, command and settings
    robot: str  # Path of the robot; with a bundle, the names of all inputs are those in the bundle
    files: dict[str, str]  # Paths of the files written, by what they are
    outliers: dict[str, list[int]]  # Lines of fitted outliers, by measurement file
    rejected: dict[str, list[int]]  # Lines with zero weight in the fit, by measurement file
    held_out_outliers: dict[str, list[int]]  # Lines of outliers that were held out, by measurement file
    moved_zeros: list[str]  # How the zeros of servos move

    @cached_property
    def document(self) -> dict[str, Any]:
        """Result as a JSON document, collected on first use."""
        data, source = self.data, self.source
        rows = {
            path: sorted(
                [
                    *(item.row for item in unreachable),
                    *self.outliers.get(path, []),
                    *self.held_out_outliers.get(path, []),
                ]
            )
            for path, unreachable in data.unreachable.items()
        }
        rows = {path: numbers for path, numbers in rows.items() if numbers}
        # Without the bundle, which holds the document: a repetition without one gives an equal document.
        files = {name: path for name, path in self.files.items() if name != "bundle"}
        document = result_to_dict(
            self.fit, files, source.inputs, [row for numbers in rows.values() for row in numbers]
        )
        return document | {
            "outliers_by_file": rows,
            "warnings": [
                text for each in (data.changes, data.notes, data.warnings) for text in texts_by_file(each)
            ],
            "command": source.command,
            "settings": source.settings,
            "hint": source.hint,
        }


def run_job(
    job: Job,
    progress: Progress | None,
    executor: TaskExecutor,
    shown: Mapping[str, str] | None = None,
) -> CalibrationOutcome:
    """Calibrate one robot and write its outputs, which are listed with the paths `shown`; print nothing."""
    servos = io.read_servos(job.servos) if job.servos else None
    inputs = checked_inputs(job)
    chain = read_robot(job.robot, job.tip, package_dirs=job.package_dir, root=job.root)
    ROBOT_FORMATS[robot_ending(job.output)].require(chain, job.output, vars(job))
    chain = with_arm_type(chain, job.arm, job.servos, job.parameters)
    if job.payload:
        chain = chain.with_payload(parse_payload(job.payload))
    sets = job.parameters if job.parameters is not None else MIXED_SETS if job.rig else chain.parameters
    data = _read_data(chain, job, servos, has_known_frames=not {"base", "tool"} & set(split_commas(sets)))
    data.warnings[job.robot] = find_robot_warnings(chain)
    if job.parameters is None:
        sets = default_sets(chain, list(data.fitted.values()))
    settings: dict[str, Any] = {
        "method": job.method,
        "extend": None if job.extend == "auto" else job.extend,
        "bounds": read_bounds(job.bounds),
        "fix": split_commas(job.fix),
        "free": split_commas(job.free),
        "priors": read_priors(job.priors),
        "holdout": [item for _, item in data.held_out],
        "known": read_instrument(job.instrument) if job.instrument else None,
        "loss": job.loss,
        "max_iterations": job.max_iterations,
        "turned": job.turned,
        "session": "unordered" if job.unordered and job.session == "auto" else job.session,
        "executor": executor,
    }
    _require_cameras(job, list(data.fitted.values()))
    fit = _calibrate(job, chain, data, settings, progress)
    on_images = fit.input_warnings
    fit = replace(
        fit,
        input_warnings=fit.input_warnings + tuple(texts_by_file(data.warnings)),
    )
    fit = fit.accepted
    # More parameters are not suggested if the columns may be mixed up, or if the verdict names a mistake, as
    # they do not explain it either. The verdict judges default ones.
    if not (fit.has_default_sets or any(data.warnings.values()) or fit.diagnosis.hypotheses):
        text = suggest_full_set(fit)
        warning = f"{text}: the chosen parameters cannot represent the errors"
        data.warnings[job.robot] = [warning] if text else []
    hint = _add_warnings(job, fit, data, sets, on_images)
    return _write_job(job, fit, sets, data, inputs, hint, servos, shown or {})


# --- input -----------------------------------------------------------------------------------------


def _holdout_file(job: Job) -> str | None:
    """Return the measurement file that --holdout names, if it names one."""
    if job.holdout is None or job.holdout == REGION or not os.path.exists(job.holdout):
        return None
    return job.holdout


def checked_inputs(job: Job) -> list[str]:
    """Check the paths of a job; return those of its input files."""
    servos = io.read_servos(job.servos) if job.servos else None
    joint_changes = plausibility.JOINT_CHANGES if servos else ()
    if changes := [key for key in job.mend if key.partition(":")[0] in joint_changes]:
        raise InvalidArgumentError(
            f"--mend {changes[0]}: not allowed with --servos; expected a corrected servo file, or --turned "
            "JOINT for a wrong sign"
        )
    measured = [*job.data, *filter(None, [_holdout_file(job)])]
    for number, path in enumerate(measured):
        if any(is_same_file(path, other) for other in measured[:number]):
            raise InvalidArgumentError(
                f"{path}: is given twice; name each measurement file once, to fit or as hold-out"
            )
    settings = [job.priors] if job.priors not in (None, "default", "none") else []
    settings += [path for path in (job.bounds, job.instrument, job.columns, job.rig) if path]
    settings += dict.fromkeys(filter(None, (servos.path, servos.lerobot))) if servos else []
    inputs = [job.robot, *existing_sidecars([job.robot]), *measured, *settings]
    require_servos(job.output, servos)
    require_workbook(job.sheet, measured)
    require_writable_outputs([file.path for file in job.outputs], inputs)
    protected = [*measured, *settings] if job.in_place else inputs
    companions = companion_paths(job.output, job.curves, servos is not None)
    require_writable_outputs([*job.output_paths, *companions], protected)
    _require_own_sidecar([path for path in (job.output, *companions) if path])
    require_endings(job.outputs)
    if job.meta:
        if not job.certificate:
            raise InvalidArgumentError("--meta: needs --certificate, the file that shows it")
        report.parse_meta(job.meta)
    return inputs


def _require_own_sidecar(paths: Sequence[str]) -> None:
    """Require that no sidecar of another robot, such as one of another ending, is replaced."""
    for path in paths:
        for robot in robots_of_sidecar(path):
            if not any(is_same_file(robot, other) for other in paths):
                raise InvalidArgumentError(
                    f"{path}: is the sidecar of {robot}; choose another name for the output"
                )


def _without(data: Measurement, unreachable: Sequence[UnreachableRow]) -> Measurement:
    """Return the measurement without some rows."""
    return data.take(~np.isin(data.rows, [item.row for item in unreachable]))


def _mended(
    chain: Chain, files: list[MeasurementFile], changes: Sequence[str]
) -> tuple[list[MeasurementFile], list[list[str]]]:
    """Return measurement files after the changes of --mend, and what these changed in each of them."""
    data = [file.data for file in files]
    texts: list[list[str]] = [[] for _ in files]
    known = dict.fromkeys(file.source for file in files)
    for key, _, target in (change.partition("@") for change in changes):
        # `KEY@FILE` changes one file only, `KEY@FILE:FIRST-LAST` some of its lines, other keys all files to
        # which they apply.
        source, lines = target, None
        if target not in known and (found := re.fullmatch(r"(.+):(\d+)-(\d+)", target)):
            source, lines = found[1], (int(found[2]), int(found[3]))
        chosen = [i for i, file in enumerate(files) if source in ("", file.source)]
        if not chosen:
            raise InvalidArgumentError(f"--mend {key}@{target}: unknown file; choose from {', '.join(known)}")
        chosen_data = [data[i] for i in chosen]
        mended = (
            plausibility.mend_files(chain, chosen_data, key)
            if lines is None
            else plausibility.mend_lines(chain, chosen_data, key, lines)
        )
        for i, item in zip(chosen, mended, strict=True):
            if item is not data[i]:
                texts[i].append(_describe_change(data[i], item, key, target))
            data[i] = item
    files = [
        file if item is file.data else _with_data(file, item) for file, item in zip(files, data, strict=True)
    ]
    return files, texts


def _describe_change(before: Measurement, after: Measurement, key: str, target: str) -> str:
    """Describe what a change of --mend changed in a file, or in a target that is a part of the files."""
    has_same_joints = np.array_equal(before.configurations(), after.configurations())
    what = "measured values" if has_same_joints else describe_configurations([before])
    option = f"--mend {key}@{target}" if target else f"--mend {key}"
    kinds = {part.partition(":")[0] for part in key.split("+")}
    is_lasting = not kinds.isdisjoint(plausibility.LASTING_CHANGES) and not target
    lasting = "; the robot is for joint values with this change" if is_lasting else ""
    return f"{what} changed by {option}{lasting}"


def _with_data(file: MeasurementFile, data: Measurement) -> MeasurementFile:
    """Return a measurement file with other data of the same rows."""
    is_held_out = np.isin(data.rows, file.holdout.rows)
    return replace(file, data=data, fit=data.take(~is_held_out), holdout=data.take(is_held_out))


def _read_data(chain: Chain, job: Job, servos: io.ServoFile | None, has_known_frames: bool) -> JobData:
    """Read all measurements and split them by their `set` columns and by --holdout."""
    holdout_file = _holdout_file(job)
    fit: list[Measurement] = []
    holdout: list[tuple[str, Measurement]] = []
    unreachable: dict[str, list[UnreachableRow]] = {}
    warnings: dict[str, list[str]] = {}
    notes: dict[str, list[str]] = {}
    by_file: dict[str, Measurement] = {}
    rig = mount_rig(read_rig(job.rig), chain) if job.rig else None
    limited = plausibility.with_wide_limits(chain) if LOW_COST in chain.parameters else chain
    further = [holdout_file] if holdout_file else []
    paths = [*job.data, *further]
    files, changes = _mended(
        chain, read_data(Namespace(**vars(job)), chain, servos, rig, further, MAX_FILE_ROWS), job.mend
    )
    for path, measured in zip(paths, files, strict=True):
        if not job.mend:
            require_joint_units(chain, measured)
        by_file[path] = measured.data
        notes[path] = list(measured.notes)
        # The values of a mended file are not those of its columns. The verdict looks for mixed-up columns.
        warnings[path] = [
            *([] if job.mend else find_value_warnings(limited, measured)),
            *find_payload_warnings(limited, measured),
        ]
        # Without base and tool it is not known where the robot can place the measured point.
        unreachable[path] = find_unreachable_rows(chain, measured) if has_known_frames else []
        if path == holdout_file:
            holdout.append((path, _without(measured.data, unreachable[path])))
        else:
            fit.append(_without(measured.fit, unreachable[path]))
            holdout.append((path, _without(measured.holdout, unreachable[path])))
    require_common_reference_target(by_file)
    if job.holdout not in (None, REGION) and not holdout_file:
        try:
            fraction = float(job.holdout)
        except ValueError:
            raise InvalidArgumentError(
                f"--holdout {job.holdout}: neither a file nor a number; expected a measurement file, a "
                "fraction such as 0.3, or region"
            ) from None
        remaining, drawn = partition.split(fit, fraction, job.seed)
        _require_both_parts(job.holdout, fraction, remaining, drawn)
        split_files = [
            path for path, a, b in zip(job.data, fit, remaining, strict=True) if len(b.rows) < len(a.rows)
        ]
        fit, holdout = list(remaining), [*holdout, *zip(split_files, drawn, strict=True)]
    fitted = {path: item for path, item in zip(job.data, fit, strict=True) if len(item.rows)}
    if not fitted:
        raise InvalidArgumentError(
            f"{', '.join(job.data)}: every row is held out; leave some rows for the fit"
        )
    held_out = [(path, item) for path, item in holdout if len(item.rows)]
    n_rows = {path: len(item.rows) for path, item in by_file.items()}
    changed = dict(zip(paths, changes, strict=True))
    return JobData(fitted, held_out, n_rows, unreachable, warnings, notes, changed)


def _require_both_parts(
    option: str, fraction: float, fitted: Sequence[Measurement], held_out: Sequence[Measurement]
) -> None:
    """Raise an error if a fraction leaves nothing to fit, or nothing to judge."""
    n_fitted, n_held_out = (len(partition.different_configurations(part)[0]) for part in (fitted, held_out))
    if n_held_out > 1 >= n_fitted:
        raise InvalidArgumentError(
            f"--holdout {option}: leaves {n_fitted} of {n_fitted + n_held_out} configurations for the fit; "
            "expected a smaller fraction"
        )
    if fraction and not n_held_out and n_fitted:
        raise InvalidArgumentError(
            f"--holdout {option}: holds out none of {n_fitted} configurations; expected a larger fraction"
        )


def _require_cameras(job: Job, data: Sequence[Measurement]) -> None:
    """Check that there is a camera if files or a frame of it are to be written."""
    if has_images(data):
        return
    if job.camera_frame:
        raise InvalidArgumentError(
            "--camera-frame: the measurements have no camera; expected image coordinates and --rig, or "
            "--tool-frame NAME for the measured tool pose"
        )
    if job.camera_files:
        raise InvalidArgumentError(
            "--camera-files: the measurements have no camera; expected image coordinates and --rig"
        )


def _held_out_images(data: JobData) -> str:
    """Say how many images are held out and cannot determine anything; empty without images among them."""
    fitted, held_out = (
        len(partition.different_configurations([each for each in items if each.kind == "camera"])[0])
        for items in (data.fitted.values(), [item for _, item in data.held_out])
    )
    if not held_out:
        return ""
    return f"; the hold-out has {held_out} of {fitted + held_out} images: take more, or hold out fewer"


# --- calibration -----------------------------------------------------------------------------------


def _calibrate(
    job: Job,
    chain: Chain,
    data: JobData,
    settings: Mapping[str, Any],
    progress: Progress | None,
) -> Result:
    """Calibrate the robot, and repeat it without each region of joint space on request."""
    try:
        fit = procedure.calibrate(
            chain, list(data.fitted.values()), job.parameters, progress=progress, **settings
        )
    except UnknownNameError as error:
        sources = {"bounds": job.bounds, "priors": job.priors, "known": job.instrument}
        path = sources.get(error.argument)
        raise FileFormatError(f"{path}: {error}") if path else error from None
    except NotObservableError as error:
        raise NotObservableError(f"{error}{_held_out_images(data)}") from None
    if job.holdout == REGION:
        fit = procedure.with_left_out_regions(fit, progress)
    fit = replace(fit, earlier_diagnosis=diagnose(fit, progress))
    if progress:
        progress("accuracy and verdict", 1, 1)
    return fit


def _add_warnings(job: Job, fit: Result, data: JobData, sets: str, on_images: Sequence[str]) -> str:
    """Add warnings about the fit to those about the data; return the hint on joint error families."""
    fitted = dict(zip(data.fitted, fit.data, strict=True))
    for path, texts in poorly_fitted_files(fit.chain, fitted, fit.instruments).items():
        # A warning about the columns of a file already explains a poor fit.
        data.warnings[path] += texts if not data.warnings[path] else []
    hint = _family_hint(fit, data, sets, job)
    turned = [fit.signs.note] if fit.signs and fit.signs.turned else []
    assumed = [ASSUMED_ORDER] if has_assumed_directions(tuple(data.fitted.values()), fit.data) else []
    data.warnings.setdefault(job.robot, []).extend([*turned, *assumed, *on_images, *find_lattices(fit)])
    if job.curves and _is_kept(job, fit):
        robot = robot_of_table(job.curves, job.output)
        text = f"use the table of --curves with {robot}: {job.output} is best without it"
        text = text if joint_corrections(fit.chain) else NO_CORRECTIONS
        data.warnings.setdefault(job.robot, []).append(text)
    return hint


def _family_hint(fit: Result, data: JobData, sets: str, job: Job) -> str:
    """Suggest --extend only if there are no warnings and parameters of the robot itself are estimated."""
    is_default = job.method == "lm" and job.priors != "none" and job.extend == "none"
    if not is_default or any(data.warnings.values()) or set(split_commas(sets)) <= {"base", "tool"}:
        return ""
    return model_selection.family_hint(fit.problem, fit.x, fit.weights)


# --- output ----------------------------------------------------------------------------------------


def _is_kept(job: Job, fit: Result) -> bool:
    """Return whether the robot is written; a refused one must not reach a controller."""
    return job.force or not fit.verdict.is_refused


def _write_job(
    job: Job,
    fit: Result,
    sets: str,
    data: JobData,
    inputs: Sequence[str],
    hint: str,
    servos: io.ServoFile | None,
    shown: Mapping[str, str],
) -> CalibrationOutcome:
    """Write the outputs of a job, all or none; JSON and report explain why a robot was refused."""
    is_kept = _is_kept(job, fit)
    ending = robot_ending(job.output)
    written, corrected = move_zeros(fit, servos) if servos and is_kept else (fit, None)
    options = {**vars(job), "servo_file": corrected}
    contents = ROBOT_FORMATS[ending].files(written, job.output, options) if is_kept else {}
    moved_zeros = describe_moves(servos, corrected) if servos and corrected else []
    if corrected:
        contents[robot_stem(job.output) + SERVO_ENDING] = corrected.toml_content()
        data.notes.setdefault(job.robot, []).extend(moved_zeros)
    source = _provenance(job, sets, data, inputs, contents, hint)
    files = name_robot_files(map(str, contents), job.output)
    outputs = [file for file in job.outputs if is_kept or file.output.is_written_if_refused]
    files |= paths_by_name(outputs)
    if job.curves and is_kept:
        files["curves_robot"] = robot_of_table(job.curves, job.output)
        contents[files["curves_robot"]] = io.complete_geometry(written.chain, files["curves_robot"])
    files = {name: shown.get(path, path) for name, path in files.items()}
    contents |= file_contents(outputs, _content_makers(job, fit, written, source))
    outliers = dict(zip(data.fitted, (rows.tolist() for rows in fit.outliers), strict=True))
    zero_weight = (
        item.rows[weight <= ZERO_WEIGHT] for item, weight in zip(fit.data, fit.weights, strict=True)
    )
    rejected = dict(zip(data.fitted, (rows.tolist() for rows in zero_weight), strict=True))
    held_out: dict[str, list[int]] = {}
    for (path, _), rows in zip(data.held_out, fit.holdout_outliers, strict=True):
        held_out.setdefault(path, []).extend(rows.tolist())
    outcome = CalibrationOutcome(
        fit, data, source, job.robot, files, outliers, rejected, held_out, moved_zeros
    )
    if job.bundle:
        contents[job.bundle] = bundle_content(job, fit.chain, inputs, contents, outcome.document)
    write_outputs(contents, job.json, outcome.document if job.json else None)
    return outcome


def _content_makers(job: Job, fit: Result, written: Result, source: Provenance) -> Makers:
    """Return the functions that make the other output files; `written` has corrected zeros of servos."""

    @cache
    def reports() -> dict[PathLike, str | bytes]:
        # They have their figures in common.
        return report.report_files(fit, job.report, source)

    return {
        "map": lambda path: report.map_content(path, fit, fit.holdout, fit.instruments),
        "scene": lambda path: visualization.scene_html(
            fit.nominal_refitted, fit, title=io.robot_name(job.robot)
        ),
        "curves": lambda path: io.csv_text(correction_columns(joint_corrections(written.chain))),
        "residuals": lambda path: io.csv_text(fit.residuals.file_columns()),
        "report": lambda path: reports()[path],
        "certificate": lambda path: report.certificate_page(fit, report.parse_meta(job.meta), source),
    }


def _provenance(
    job: Job,
    sets: str,
    data: JobData,
    inputs: Sequence[str],
    robot_contents: Mapping[PathLike, str | bytes],
    hint: str,
) -> Provenance:
    """Describe files, command and settings for the report."""
    names = short_names(inputs)
    settings = {"parameters": sets, "loss": job.loss, "seed": str(job.seed)}
    if job.payload:
        settings["payload"] = job.payload
    if job.holdout == REGION:
        settings["hold-out"] = "regions of joint space in turn; all samples are fitted"
    elif job.holdout is not None:
        settings["hold-out"] = names.get(
            job.holdout, f"fraction {job.holdout} of each file, drawn with the seed"
        )
    return Provenance(
        command=job.command(names),
        inputs=file_digests(inputs),
        outputs=content_digests(robot_contents),
        names=list(data.fitted),
        holdout_names=[path for path, _ in data.held_out],
        settings=settings,
        excluded_rows={
            names[path]: {item.row: item.reason for item in rows} for path, rows in data.unreachable.items()
        },
        warnings={names[path]: texts for path, texts in data.warnings.items()},
        notes={names[path]: texts for path, texts in data.notes.items()},
        remarks=[f"{names[path]}: {text}." for path, texts in data.changes.items() for text in texts],
        hint=hint,
    )
