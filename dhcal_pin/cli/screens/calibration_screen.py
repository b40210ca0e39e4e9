"""What `dhcal calibrate` shows: verdict, input, accuracy, largest corrections, warnings and files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from ...calibration import summary
from ...calibration.cameras import split_sets
from ...calibration.evaluation import Comparison
from ...calibration.result import Result
from ...calibration.verdict import Verdict
from ...formatting import Quantity, Table, format_count, list_first, texts_by_file
from ...identifiability import EXPECTED
from ...measurements.base import Measurement
from ...measurements.groups import ERROR_GROUPS
from ...measurements.images.names import list_images
from ...report.provenance import Provenance, short_names
from ..job import Job
from ..run_job import CalibrationOutcome
from .screen import Block, Screen, robot_line, section_blocks

# Number of corrections that are shown.
N_CORRECTIONS = 5
# Residuals this many times as large as the stated standard deviations are mentioned.
MIN_SIGMA_RATIO = 2.0

_VERDICT_STYLES = {"ok": "green", "caution": "yellow", "refused": "red"}


def calibration_screen(outcome: CalibrationOutcome, job: Job) -> Screen:
    """Describe the result of a calibration."""
    fit, data, source = outcome.fit, outcome.data, outcome.source
    names = short_names([outcome.robot, *data.n_rows])
    is_refused = fit.verdict.is_refused
    # The parameters of a refused robot have no meaning.
    unidentified = [] if is_refused else summary.parameter_notes(fit.unobservable, fit.weakly_observable)
    unidentified = [text for text in unidentified if not text.startswith(EXPECTED)]

    def named(by_file: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str]]:
        return {names[path]: texts for path, texts in by_file.items()}

    all_warnings = texts_by_file(named(data.warnings), "warning: ")
    signs = fit.signs
    turned = [f"{names[outcome.robot]}: warning: {signs.note}"] if signs and signs.turned else []
    warnings = [text for text in all_warnings if text not in turned]
    moved = [f"warning: {text}" for text in outcome.moved_zeros]
    kept = {
        path: [text for text in texts if text not in outcome.moved_zeros]
        for path, texts in data.notes.items()
    }
    notes = [f"note: {text}" for text in texts_by_file(named(kept))]
    hints = [f"hint: {source.hint}"] if source.hint else []
    files = [f"wrote {name}: {path}" for name, path in outcome.files.items()]
    by_file = summary.file_table([names[path] for path in data.fitted], fit.file_comparisons)
    blocks = [
        Block(_robot_lines(fit, names[outcome.robot], source.settings["parameters"])),
        Block(_data_lines(outcome, names), noun="file", rank=7),
        *_accuracy_blocks(fit),
        Block([] if is_refused else fit.rounding_notes, "yellow", noun="note on joint values", rank=7),
        Block(by_file if by_file else [], noun="error by file", rank=6, n_kept=4, has_space=True),
        Block(
            fit.hand_eye.table if fit.hand_eye else [],
            noun="row of tried causes",
            rank=2,
            n_kept=4,
            has_space=True,
        ),
        _correction_block(fit),
        Block(unidentified, "yellow", noun="note on parameters", rank=0, n_kept=0, has_space=True),
        Block(notes, noun="note on the files", rank=1),
        Block(hints, "yellow", noun="hint", rank=2, n_kept=0),
        Block(list(_row_lines(outcome, names)), "yellow", noun="note on rows", rank=3),
        Block([*turned, *moved], "yellow"),
        Block(warnings, "yellow", noun="warning", rank=4),
        Block(files, noun="file written", rank=6),
        Block([] if is_refused else [summary.headline(fit.comparisons).text], "bold", has_space=True),
        Block(texts_by_file(named(data.changes)), "yellow", is_verdict=True, has_space=is_refused),
        *verdict_blocks(fit.verdict, job.force),
    ]
    return Screen(blocks, partial(_details, fit))


def verdict_blocks(verdict: Verdict, is_forced: bool) -> list[Block]:
    """Describe a verdict and its reasons."""
    style = _VERDICT_STYLES[verdict.status]
    text = f"verdict: {verdict.status}"
    if verdict.is_refused:
        text += f" ({'written because of --force' if is_forced else 'no robot written; --force overrides'})"
    reasons = [f"  {reason}" for reason in verdict.reasons]
    return [
        Block([text], style, is_verdict=True, has_space=verdict.is_refused),
        Block(reasons, style, noun="reason", rank=8, is_verdict=True),
    ]


# --- input -----------------------------------------------------------------------------------------


def _robot_lines(fit: Result, robot: str, sets: str) -> list[str]:
    """Describe the robot, its tip and its joints, and what was estimated."""
    supported, families = (fit.extension.supported, fit.extension.families) if fit.extension else ((), ())
    others = [name for name in families if name not in supported]
    added = f"; joint errors added: {', '.join(supported)}" if families else ""
    added += f" (and {', '.join(others)}, shrunk by priors)" if others else ""
    if any(stage.name == "arm" and not stage.is_kept for stage in fit.camera_stages):
        sets, added = ",".join(split_sets(sets)[1]), "; the arm is kept"
    elif fit.is_kept_nominal:
        added = "; the nominal robot is kept"
    return [
        robot_line(robot, fit.chain),
        f"estimated: {sets.replace(',', ', ')} ({len(fit.parameters)} parameters){added}",
    ]


def _data_lines(outcome: CalibrationOutcome, names: Mapping[str, str]) -> list[str]:
    """Describe each measurement file: rows, kind and standard deviations, and how the rows were used."""
    lines = []
    ratios = dict(zip(outcome.data.fitted, outcome.fit.sigma_ratios, strict=True))
    for path, n_rows in outcome.data.n_rows.items():
        fitted = [outcome.data.fitted[path]] if path in outcome.data.fitted else []
        held_out = [item for name, item in outcome.data.held_out if name == path]
        facts = [f"{n_rows} rows", *_describe_data([*fitted, *held_out])]
        if (ratio := ratios.get(path)) and ratio >= MIN_SIGMA_RATIO:
            facts.append(f"residuals {ratio:.2g} times as large")
        uses = f"; {_describe_use(fitted, held_out)}" if held_out else ""
        lines.append(f"{names[path]}: {', '.join(facts)}{uses}")
    return lines


def _describe_data(items: Sequence[Measurement]) -> list[str]:
    """Return the kind, the number of all images, and the standard deviations of measurements."""
    if not items:
        return []
    texts = items[0].description()
    if n_images := _count_images(items):
        texts = [format_count(n_images, "image"), texts[-1]]
    return [items[0].kind, *texts]


def _describe_use(fitted: Sequence[Measurement], held_out: Sequence[Measurement]) -> str:
    """Return how many samples of a file are fitted and held out, and of how many images they are."""
    counts = [sum(len(item.rows) for item in items) for items in (fitted, held_out)]
    images = [_count_images(items) for items in (fitted, held_out)]
    if any(images):
        return f"{counts[0]} corners of {images[0]} images fitted, {counts[1]} of {images[1]} held out"
    return f"{counts[0]} fitted, {counts[1]} held out"


def _count_images(items: Sequence[Measurement]) -> int:
    """Return the number of images in measurements."""
    return sum(item.n_images for item in items)


def _row_lines(outcome: CalibrationOutcome, names: Mapping[str, str]) -> Iterator[str]:
    """Describe the rows that are not used, and the outliers."""
    for path, unreachable in outcome.data.unreachable.items():
        for item in unreachable:
            yield f"{names[path]}: line {item.row} is excluded: {item.reason}"
    for path, rows in outcome.outliers.items():
        rejected = outcome.rejected[path]
        item = outcome.data.fitted[path]
        if excluded := [row for row in rows if row in rejected]:
            yield f"{names[path]}: {_count_outliers(excluded, item)} excluded from the fit"
        if included := [row for row in rows if row not in rejected]:
            count, method = _count_outliers(included, item), outcome.fit.method
            option = summary.AUTO_OPTIONS[method]
            yield (
                f"{names[path]}: {count} kept in the fit, not far from the other samples: a few do no harm; "
                "--loss tukey down-weights them"
                if method == "lm" and outcome.source.settings["loss"] == "auto"
                else f"{names[path]}: {count} kept in the fit; {option} excludes those far from the others"
            )
    for path, item in outcome.data.held_out:
        if rows := [row for row in outcome.held_out_outliers[path] if row in item.rows]:
            yield f"{names[path]}: {_count_outliers(rows, item)} among the hold-out samples"


def _count_outliers(rows: list[int], item: Measurement) -> str:
    """Count outliers, and name their lines and the images whose corners they all are."""
    plural = "s" if len(rows) > 1 else ""
    text = f"{len(rows)} outlier{plural} (line{plural} {list_first(rows)})"
    images = item.images_within(np.isin(item.rows, rows))
    if not images:
        return text
    count = f"{len(images)} images" if len(images) > 1 else "an image"
    return f"{text}, among them all corners of {count}{list_images(images)},"


# --- accuracy and corrections ----------------------------------------------------------------------


def _accuracy_blocks(fit: Result) -> list[Block]:
    """Describe the accuracy within the measured region and outside it, before and after."""
    covered, reached = fit.generalization.covered_share, fit.generalization.reached_share
    labels, places = ("inside", "outside"), ("in the measured region", "outside of it")
    if covered is None or reached is None:
        labels = places = ("among the measured poses", "outside of them")
    rows, sentences = [], []
    for label, place, (comparison, reason) in zip(
        labels, places, summary.judged_regions(fit.generalization, fit.comparisons), strict=True
    ):
        if comparison:
            rows += _accuracy_rows(comparison, label)
        else:
            sentences.append(f"Accuracy {place}: cannot be said, {reason}.")
    if rows and covered is not None and reached is not None:
        sentences.append(
            f"Inside: measured region, {summary.format_share(covered)} of joint space. "
            f"Accuracy unknown: {summary.format_share(1 - reached)}."
        )
    header = ["RMS error", "judged on", "before", "after", *(["URDF alone"] if fit.bare else [])]
    table = Table(header, rows, 2)
    return [
        Block(table, noun="figure", rank=7, n_kept=len(rows), has_space=True),
        Block(sentences),
        Block(summary.position_notes(fit.hand_eye_std)),
        Block(summary.position_error_notes(fit)),
        Block([] if fit.verdict.is_refused else summary.accuracy_notes(fit), "yellow"),
        Block(summary.regressions(fit, fit.comparisons), "yellow"),
    ]


def _accuracy_rows(comparison: Comparison, place: str) -> Iterator[list[str | Quantity]]:
    """Make the rows of one comparison, one per group of errors."""
    for group, after in comparison.after.groups.items():
        is_region = comparison.title == "region hold-out"
        judged = "left-out regions" if is_region else f"{after.samples} {comparison.title}"
        errors = ERROR_GROUPS[group]
        name = errors.name if errors.is_vector else errors.label
        alone = summary.urdf_alone(comparison, group)
        sides = (*summary.before_and_after(comparison, group), *([alone] if alone else []))
        yield [f"{name} {place}", judged, *sides]


def _correction_block(fit: Result) -> Block:
    """Describe the largest corrections of the robot."""
    is_shown = fit.shrinkage_factor and not fit.verdict.is_refused
    corrections = summary.largest_corrections(fit.estimates, fit.x, fit.solution.system)[:N_CORRECTIONS]
    rows = [
        [e.name, *(Quantity(v, e.unit, e.std, is_small=True) for v in (e.change, e.std))]
        for e in (corrections if is_shown else ())
    ]
    table = Table(["largest corrections", "change", "std"], rows)
    return Block(table, noun="correction", rank=5, n_kept=min(3, len(rows)), has_space=True)


def _details(fit: Result) -> list[Block]:
    """Return the sections of the document of a calibration that a terminal shows."""
    from ...report.context import ReportContext  # lazy import, as the following: only for --verbose
    from ...report.sections import sections_of

    return [*section_blocks(sections_of(ReportContext(fit, Provenance()), "terminal")), Block([""])]
