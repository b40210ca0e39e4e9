"""What the commands other than `dhcal calibrate` show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...calibration.evaluation import Accuracy
from ...calibration.summary import STATISTIC_LABELS, statistic
from ...diagnostics.inspection import FileInspection, column_table
from ...formatting import Quantity, Table, format_count, format_lines, list_first, texts_by_file
from ...measurements.groups import ERROR_GROUPS, in_order
from ...planning.views import views_table
from ...report.provenance import short_names
from .screen import Block, Screen, robot_line

if TYPE_CHECKING:
    from ..._typing import Array
    from ...compensation import Compensation
    from ...detection import BoardDetection
    from ...diagnostics import Difference
    from ...io import TargetPoses
    from ...paper.jacobian_check import Agreement
    from ...planning import Plan
    from ...robot import Chain
    from ...session import Recheck
    from ...studies import StudyGrid


# Columns of a study that fit on a screen; --verbose shows the others.
MAIN_STUDY_COLUMNS = (
    "converged",
    "iterations",
    "position_rms[m]",
    "position_rms_p90[m]",
    "orientation_rms[rad]",
)


def notes_block(texts: Sequence[str]) -> Block:
    """Describe notes on a result."""
    return Block([f"note: {text}" for text in texts], noun="note", rank=1)


def warnings_block(warnings: Mapping[str, Sequence[str]]) -> Block:
    """Describe warnings about files."""
    return Block(texts_by_file(warnings, "warning: "), "yellow", noun="warning", rank=2)


def files_block(paths: Iterable[object]) -> Block:
    """Describe the files that were written."""
    return Block([f"wrote {path}" for path in paths], noun="file written", rank=3)


def simulation_screen(robot: str, paths: Iterable[object]) -> Screen:
    """Describe the robot that was measured in a simulation, and the files that were written."""
    return Screen([Block([robot], rank=1), files_block(paths)])


def files_screen(
    paths: Iterable[object], notes: Sequence[str] = (), warnings: Mapping[str, Sequence[str]] | None = None
) -> Screen:
    """Describe the files that were written, below notes and warnings."""
    return Screen([notes_block(notes), warnings_block(warnings or {}), files_block(paths)])


def validation_screen(
    title: str,
    accuracies: Mapping[str, Accuracy],
    remarks: Sequence[str],
    notes: Sequence[str],
    warnings: Mapping[str, Sequence[str]],
    files: Mapping[str, str],
    tables: Sequence[Table] = (),
) -> Screen:
    """Describe the accuracy of a model on measurements, and further tables."""
    rows = []
    for group in in_order({group for each in accuracies.values() for group in each.groups}):
        columns = [each.groups[group] for each in accuracies.values() if group in each.groups]
        for key, label in STATISTIC_LABELS.items():
            rows.append(
                [f"{ERROR_GROUPS[group].label}, {label}", *(statistic(each, key) for each in columns)]
            )
    blocks = [
        Block(Table(["error", *accuracies], rows), title=title, is_verdict=True),
        *(Block(table, title=table.caption, is_verdict=True, has_space=True) for table in tables),
        Block(remarks, noun="remark", rank=1, has_space=True),
        notes_block(notes),
        warnings_block(warnings),
        files_block(f"{kind}: {path}" for kind, path in files.items()),
    ]
    return Screen(blocks)


def detection_screen(
    detections: Sequence[BoardDetection], notes: Sequence[str], files: Sequence[str]
) -> Screen:
    """Describe which corners were found in images."""
    from ...detection import unused_images  # lazy import: only this command needs it

    found = []
    for detection in detections:
        n_corners = sum(len(image.corner) for image in detection.used)
        found.append(
            f"board {detection.board.name}: {n_corners} corners in {len(detection.used)} of "
            f"{len(detection.images)} images"
        )
    unused = [f"{path}: not used, {problem}" for path, problem in unused_images(detections)]
    return Screen(
        [
            Block(found, is_verdict=True),
            Block([f"warning: {text}" for text in (*notes, *unused)], "yellow", noun="warning", rank=2),
            files_block(files),
        ]
    )


# --- inspect ---------------------------------------------------------------------------------------


# Samples of the accuracies of a document, by the beginning of their keys.
_ACCURACIES = {
    "": "fitted",
    "holdout_": "hold-out",
    "cross_validated_": "cross-validated",
    "holdout_region_": "left-out regions",
}


def bundle_screen(document: Mapping[str, Any], result: Mapping[str, Any]) -> Screen:
    """Describe a bundle: robot, data, options, versions, accuracy and verdict."""
    robot, verdict = document["robot"], result.get("verdict") or {}
    options = [
        f"{name}: {', '.join(map(str, value)) if isinstance(value, list) else value}"
        for name, value in document["options"].items()
        if name not in ("robot", "data")
    ]
    return Screen(
        [
            Block([f"{robot['path']}: tip {robot['tip']}, {len(robot['joints'])} joints"]),
            Block([f"data: {name}" for name in document["data"]], noun="file", rank=3),
            Block(options, noun="option", rank=2),
            Block(
                [f"{name} {version}" for name, version in document["versions"].items()],
                rank=1,
                noun="version",
            ),
            Block(_bundled_accuracy(document["accuracy"]), noun="figure", rank=4, has_space=True),
            Block([f"{result.get('command', '')}"]),
            Block([f"verdict: {verdict.get('status', 'unknown')}"], "bold", is_verdict=True),
        ]
    )


def _bundled_accuracy(accuracy: Mapping[str, Any]) -> Table:
    """Make a table of the RMS errors that the document of a calibration states."""
    rows = []
    for prefix, label in _ACCURACIES.items():
        before, after = (accuracy.get(f"{prefix}{side}", {}) for side in ("before", "after"))
        for key, value in after.items():
            name, is_rms, unit = key.partition("_rms")
            if is_rms and key in before:
                sides = (Quantity.error(each, unit[1:] or after["unit"]) for each in (before[key], value))
                rows.append([f"{name}, {label}", *sides])
    return Table(["RMS error", "before", "after"], rows)


def inspection_screen(
    robot: str, warnings: Mapping[str, Sequence[str]], inspections: Sequence[FileInspection]
) -> Screen:
    """Describe what measurement files contain, after the robot and the warnings about it."""
    first = [Block([robot] if robot else []), replace(warnings_block(warnings), is_verdict=True)]
    blocks = [block for inspection in inspections for block in _inspection_blocks(inspection)]
    if len(inspections) == 1:
        return Screen([*first, *blocks])
    return Screen([*first, *_overview(inspections)], lambda: blocks)


def robot_screen(path: str, chain: Chain, warnings: Mapping[str, Sequence[str]]) -> Screen:
    """Describe a robot: the joints to its tip, and the links that can be chosen as a tip."""
    rows = []
    for j, name in enumerate(chain.joint_names):
        factor, unit = (1e3, "mm") if chain.is_prismatic[j] else (180 / np.pi, "deg")
        ends = float(chain.lower[j]), float(chain.upper[j])
        limits = [f"{factor * end:.6g}" if np.isfinite(end) else "–" for end in ends]
        rows.append([name, chain.urdf.joint(name).type, unit, *limits])
    tips = []
    for link in chain.urdf.leaves():
        count = sum(joint.type != "fixed" for joint in chain.urdf.path(link))
        tips.append(f"  {link}, {format_count(count, 'joint')}{' (chosen)' * (link == chain.tip)}")
    joints = Table(["joint", "type", "unit", "lower", "upper"], rows, n_text_columns=3)
    title = "Tips (--tip), or any other link behind a joint:"
    return Screen(
        [
            Block([robot_line(path, chain)], is_verdict=True),
            replace(warnings_block(warnings), is_verdict=True),
            Block(joints, noun="joint", rank=1),
            Block(tips, title=title, noun="tip", rank=0, n_kept=5),
        ]
    )


def _overview(inspections: Sequence[FileInspection]) -> list[Block]:
    """Describe each of several files in a sentence; those that cannot be read come first."""
    names = short_names([inspection.path for inspection in inspections])
    problems, doubtful, others = [], [], []
    for inspection in inspections:
        name = names[inspection.path]
        title = _inspection_title(inspection).replace(inspection.path, name, 1)
        count = len(inspection.warnings) + len(inspection.bad_rows)
        if inspection.problem:
            problems.append(f"{name}: problem: {inspection.problem}")
        elif count:
            doubtful.append(f"{title}; {format_count(count, 'warning')}, see --verbose")
        else:
            others.append(title)
    return [
        Block(problems, "red", noun="file with a problem", rank=2, is_verdict=True, has_space=True),
        Block(doubtful, "yellow", noun="file with warnings", rank=1, is_verdict=True),
        Block(others, noun="file without problems", rank=0, is_verdict=True),
    ]


def _inspection_blocks(inspection: FileInspection) -> list[Block]:
    """Describe what a measurement file contains."""
    texts = []
    for column in inspection.columns:
        if column.counts and column.role != "ignored":
            counts = [f"{text} ({count} rows)" for text, count in column.counts.items()]
            texts.append(f"{column.name}: {list_first(counts)}")
    conditions = [column.name for column in inspection.columns if column.role == "condition"]
    if conditions:
        texts.append(f"conditions: {', '.join(conditions)}")
    ignored = [column.name for column in inspection.columns if column.role == "ignored"]
    if len(ignored) == len(inspection.columns) and not inspection.problem:
        texts.append("No column is known. With --robot a column map is proposed.")
    elif ignored and not inspection.column_map:
        texts.append(f"not used: {', '.join(ignored)}")
    doubtful = []
    # With a robot, a warning names them.
    if inspection.repeated_lines and inspection.configurations is None:
        doubtful.append(f"lines equal to earlier ones: {format_lines(inspection.repeated_lines)}")
    reasons = []
    if bad := inspection.bad_rows:
        plural = "s" if len(bad) > 1 else ""
        doubtful.append(f"{len(bad)} row{plural} cannot be used, line{plural} {format_lines(bad)}:")
        reasons = [f"  line {line}: {reason}" for line, reason in bad.items()]
    warnings = [f"warning: {text}" for text in inspection.warnings]
    problems = [f"problem: {inspection.problem}"] if inspection.problem else []
    is_good = not (bad or warnings or problems or inspection.column_map or inspection.notes)
    verdict = ["No problems found."] if is_good and inspection.configurations is not None else []
    return [
        Block([_inspection_title(inspection)], "bold", is_verdict=True, has_space=True),
        Block(column_table(inspection.columns), noun="column", rank=2, n_kept=3),
        Block(texts, noun="remark on columns", rank=0),
        notes_block(inspection.notes),
        Block(doubtful, "yellow", is_verdict=True),
        Block(reasons, "yellow", noun="reason", rank=3),
        Block(warnings, "yellow", noun="warning", rank=4, is_verdict=True),
        Block(problems, "red", is_verdict=True),
        Block(
            inspection.column_map,
            title="Lines of a column map (--columns); check columns and units:",
            has_space=True,
            is_verbatim=True,
        ),
        Block(verdict, "green", is_verdict=True),
    ]


def _inspection_title(inspection: FileInspection) -> str:
    """Return the most important facts on a file in one line."""
    facts = [
        inspection.kind or "unknown kind",
        f"{inspection.rows} rows (lines {inspection.first_line}-{inspection.last_line})",
    ]
    if inspection.configurations is not None:
        facts.append(f"{inspection.configurations} configurations")
    return f"{inspection.path}: {', '.join([*facts, inspection.form])}"


# --- check, plan, compensate, study ----------------------------------------------------------------


def crosscheck_screen(robot: str, agreements: Sequence[Agreement]) -> Screen:
    """Describe how well other computations agree with the error factors of the paper."""
    rows = [
        [
            agreement.route,
            str(agreement.columns) if agreement.columns else "",
            f"{agreement.difference:.1e}",
            f"{agreement.tolerance:.0e}",
            "agrees" if agreement.agrees else "DISAGREES",
        ]
        for agreement in agreements
    ]
    table = Table(["computation", "columns", "difference", "tolerance", "verdict"], rows)
    title = f"{robot}: largest difference from the error factors of the paper [m, rad]"
    n_agree = sum(agreement.agrees for agreement in agreements)
    text = f"{n_agree} of {len(agreements)} computations agree."
    style = "green" if n_agree == len(agreements) else "red"
    return Screen([Block(table, title=title), Block([text], style, is_verdict=True)])


def plan_screen(plan: Plan, moves: Sequence[str], files: Iterable[object]) -> Screen:
    """Describe the predicted error over the number of poses, and compare a plan with random poses."""
    from ...report.plan import size_sentence  # lazy import: only this command needs it

    # Without the repetitions of poses.
    sizes, count = plan.sizes.tolist(), int(plan.random_sizes[-1])
    random_errors = dict(zip(plan.random_sizes.tolist(), plan.random_errors.tolist(), strict=True))
    selected = {*random_errors, count, sizes[-1]}
    selected |= {plan.recommended_size} if plan.recommended_size else set()
    rows = [
        [
            str(size),
            f"{1e3 * error:.4f}",
            f"{1e3 * random_errors[size]:.4f}" if size in random_errors else "",
        ]
        for size, error in zip(sizes, plan.errors.tolist(), strict=True)
        if size in selected
    ]
    table = Table(["poses", "planned, mm", "random, mm"], rows, n_text_columns=0)
    percent = round(100 * (1 - plan.relative_error))
    change = f"{abs(percent)} % {'lower' if percent > 0 else 'higher'}" if percent else "About the same"
    comparison = f"{change} predicted error {'than' if percent else 'as'} {count} random poses."
    curves = [
        [str(one.n_poses), f"{100 * one.filled_share:.0f} %", f"{1e6 * one.curve_std:.0f}"]
        for one in plan.curves
    ]
    curve_table = Table(["poses", "bins filled", "curve std, µrad"], curves, n_text_columns=0)
    is_free = all(plan.is_way_free)
    return Screen(
        [
            Block(
                table,
                title="predicted RMS error between camera and board"
                if plan.views
                else "predicted RMS position error over the task",
                noun="number of poses",
                rank=4,
                n_kept=4,
            ),
            Block(
                curve_table,
                title="joint correction curves, RMS of all joints",
                noun="number of poses",
                rank=4,
                n_kept=2,
                has_space=True,
            ),
            Block(
                views_table(plan.views),
                title="images of the boards",
                noun="camera",
                rank=4,
                n_kept=2,
                has_space=True,
            ),
            notes_block(plan.notes),
            Block(moves, "" if is_free else "yellow", noun="remark on moves", rank=2),
            files_block(files),
            Block([size_sentence(plan)], has_space=True),
            Block([comparison], "bold", is_verdict=True),
        ]
    )


def difference_screen(difference: Difference, files: Iterable[object]) -> Screen:
    """Describe the difference of two calibrations."""
    from ...report.changes import difference_table  # lazy import: slow, and only this command needs it

    style = {"equal": "green", "different": "red"}.get(difference.verdict, "yellow")
    first, *others = difference.sentences
    return Screen(
        [
            Block(difference_table(difference), title="distance of the tools, with the best base and tool"),
            files_block(files),
            Block(others, noun="remark", rank=1, has_space=True),
            Block([f"{difference.verdict}: {first}"], style, is_verdict=True),
        ]
    )


# Styles of the verdicts of a check. Smallest share of the evidence of a sample that is shown, and of another
# change whose size is shown: the samples do not determine the size of what did not happen.
MIN_SHOWN_SHARE = 0.01
VERDICT_STYLES = {"ok": "green", "changed": "red", "cannot say": "yellow"}


def recheck_screen(
    result: Recheck, notes: Sequence[str], warnings: Mapping[str, Sequence[str]], files: Iterable[object]
) -> Screen:
    """Describe whether a robot is still calibrated."""
    rows = [
        [
            each.name,
            f"{100 * each.share:.0f} %",
            *(
                (Quantity(each.size, each.unit, each.std, is_small=True), Quantity.error(each.std, each.unit))
                if each.std and each.share >= MIN_SHOWN_SHARE
                else ("", "")
            ),
        ]
        for each in result.hypotheses
        if each.kind != "sample" or each.share >= MIN_SHOWN_SHARE
    ]
    table = Table(["change", "share", "size", "std"], rows)
    expected = f"; expected {Quantity.error(result.expected_rms, 'm')}" if result.expected_rms > 0 else ""
    residual = f"distance of the measured positions: {Quantity.error(result.residual_rms, 'm')} RMS{expected}"
    return Screen(
        [
            Block(
                table,
                title=f"what {result.samples} samples say if something changed",
                noun="change",
                n_kept=4,
            ),
            Block([residual]),
            notes_block(notes),
            warnings_block(warnings),
            files_block(files),
            Block(
                [f"{result.verdict}: {result.reasons[0]}", *result.reasons[1:]],
                VERDICT_STYLES[result.verdict],
                is_verdict=True,
                has_space=True,
            ),
        ]
    )


def compensation_screen(
    frame: str,
    result: Compensation,
    chain: Chain,
    targets: TargetPoses,
    unstated: Sequence[str],
    warnings: Mapping[str, Sequence[str]],
    hint: str,
    files: Iterable[object],
) -> Screen:
    """Describe how many targets have which status, and the lines of those that are not corrected exactly."""
    counts, lines = [], []
    for status in dict.fromkeys(result.status):
        rows = [row for row, other in enumerate(result.status) if other == status]
        counts.append(
            Block(
                [f"{targets.source}: {len(rows)} of {len(result.status)} {status}"],
                "" if status == "ok" else "yellow",
                is_verdict=True,
            )
        )
        if status == "ok":
            continue
        items = [
            f"  line {targets.lines[row]}"
            if result.reached[row]
            else f"  line {targets.lines[row]} ({_distance(result.residual_error[row])} away)"
            for row in rows
        ]
        lines.append(Block(items, "yellow", title=f"{status}:", noun=f"target {status}", rank=1, n_kept=3))
    notes = [*(f"{targets.source}: {text}" for text in targets.notes), *unstated]
    if chain.n_joints > 6:
        notes.append(
            f"{chain.n_joints} joints reach a target in many ways, and the corrected targets hold only "
            "for these joint values; send the joint values to the controller"
        )
    elif chain.n_joints < 6 and targets.values.ndim == 3 and result.reached.any():
        angle = np.rad2deg(result.residual_error[result.reached, 1].max())
        notes.append(
            f"{chain.n_joints} joints cannot reach every orientation: positions are exact, and orientations "
            f"as near as possible, within {angle:.2g}°; see miss_rotation"
        )
    hints = [f"hint: {hint}"] if hint else []
    return Screen(
        [
            Block([frame]),
            *lines,
            notes_block(notes),
            warnings_block(warnings),
            Block(hints, "yellow"),
            files_block(files),
            *counts,
        ]
    )


def _distance(error: Array) -> str:
    """Format a position and an orientation error, shape (2,) [m, rad]."""
    angle = np.rad2deg(error[1])
    return f"{1e3 * error[0]:.3g} mm" + (f", {angle:.3g}°" if angle > 0 else "")


def study_screen(
    study: StudyGrid, header: Sequence[str], rows: Sequence[Sequence[Any]], files: Iterable[object]
) -> Screen:
    """Describe the results of a study in mm and degrees, with the settings that differ."""
    from ...studies import Setting  # lazy import: only this command needs it

    n_settings = len(fields(Setting))
    varied = [i for i in range(n_settings) if len({row[i] for row in rows}) > 1]
    # The column behind the settings is the number of calibrations, which is in the title.
    known = [i for i in range(n_settings + 1, len(header)) if any(row[i] is not None for row in rows)]
    names = [name.replace("[m]", ", mm").replace("[rad]", ", °").replace("_", " ") for name in header]
    scales = [1e3 if "[m]" in name else np.rad2deg(1.0) if "[rad]" in name else 1.0 for name in header]

    def table(columns: Sequence[int]) -> Table:
        cells = [
            [str(row[i]) for i in varied]
            + ["" if row[i] is None else f"{row[i] * scales[i]:.3g}" for i in columns]
            for row in rows
        ]
        return Table([names[i] for i in (*varied, *columns)], cells, n_text_columns=len(varied))

    title = f"{study.title or 'study'}: medians over {study.seeds} calibrations per setting"
    main = [i for i in known if header[i] in MAIN_STUDY_COLUMNS] or known
    return Screen(
        [
            Block(table(main), title=title, noun="setting", rank=0),
            files_block(files),
        ],
        lambda: [Block(table(known), title=title)] if main != known else [],
    )
