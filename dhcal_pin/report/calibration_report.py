"""Reports of a calibration: the document of a result, and its files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._typing import PathLike
from ..calibration import summary
from ..calibration.result import Result
from ..calibration.summary import STATISTIC_LABELS, Headline, statistic
from ..exceptions import InvalidArgumentError
from ..formatting import capitalized, format_count
from ..measurements.groups import ERROR_GROUPS
from ..saving import write_files
from .context import ReportContext
from .document import Document
from .html import html_page, is_html
from .markdown import markdown
from .provenance import Provenance
from .sections import Rendering, sections_of


def write_report(fit: Result, path: PathLike, source: Provenance | None = None) -> None:
    """Write the report of a calibration.

    Args:
        fit: Result of the calibration.
        path: File to write: `.html` (one file with figures and scene) or `.md`; another ending raises an
            error. An existing file is replaced.
        source: Files, hashes and settings, which a result does not contain.
    """
    write_files(report_files(fit, [path], source or Provenance()))


def report_files(fit: Result, paths: Sequence[PathLike], source: Provenance) -> dict[PathLike, str | bytes]:
    """Render the report for each path, as HTML or Markdown according to its ending."""
    for path in paths:
        if not (is_html(path) or os.fspath(path).lower().endswith(".md")):
            raise InvalidArgumentError(f"{os.fspath(path)}: unknown ending; write a report as .html or .md")
    context = ReportContext(fit, source)
    return {
        path: html_page(calibration_document(context, "html"))
        if is_html(path)
        else markdown(calibration_document(context, "markdown"))
        for path in paths
    }


def calibration_document(context: ReportContext, rendering: Rendering) -> Document:
    """Make the document of a calibration with the sections that a rendering shows."""
    head = summary.headline(context.comparisons)
    best, verdict = head.comparison, context.fit.verdict
    if best.title != "fitted":
        heading = f"{capitalized(ERROR_GROUPS[head.group].label)} {summary.describe_samples(best)}"
        note = summary.small_sample_note(best)
    else:
        heading = "No hold-out measurements"
        note = (
            f"The figures describe the {format_count(best.n_samples, 'fitted sample')} and say little about "
            "other measurements. Calibrate with --holdout 0.3, or validate with other measurements, to "
            "assess the robot."
        )
    values = [("before", "before, RMS", head.before), ("after", "after, RMS", head.after)]
    if best.before.groups[head.group].rms and not verdict.is_refused:
        change = "smaller" if head.percent_reduction >= 0 else "larger"
        values.append(("", change, f"{abs(head.percent_reduction):.0f} %"))
    regions = summary.generalization_lines(context.fit.generalization, context.comparisons)
    notes = [] if verdict.is_refused else summary.accuracy_notes(context.fit)
    title = f"Calibration of {context.robot_name}"
    return Document(
        title=title,
        sections=sections_of(context, rendering),
        heading=heading,
        eyebrow=f"{title}{_origin(context)}",
        status=verdict.status,
        reasons=verdict.reasons,
        headline=head.text,
        values=values,
        details=_details(head),
        remarks=[*context.source.remarks, *regions, *notes, *context.fit.rounding_notes],
        note=note,
        warnings=_warnings(context),
        samples=lambda: context.samples.page_data(),
    )


def _origin(context: ReportContext) -> str:
    """Return from which files the measurements come, as the end of a sentence."""
    names = sorted({*context.source.names, *context.source.holdout_names})
    if not names:
        return ""
    return f" from {names[0].rsplit('/', 1)[-1] if len(names) == 1 else f'{len(names)} files'}"


def _details(head: Headline) -> list[tuple[str, str, str]]:
    """Return state, name and text of further statistics: of the group, and the RMS of other groups."""
    details = []
    for name, after in head.comparison.after.groups.items():
        if name == head.group:
            for key in ("p95", "max"):
                details.append(("", f"after, {STATISTIC_LABELS[key]}", str(statistic(after, key))))
        else:
            # Both values have the same decimals.
            before = replace(statistic(after), value=head.comparison.before.groups[name].rms)
            text = f"{before} → {statistic(after)}"
            details.append(("", f"{ERROR_GROUPS[name].label}, {STATISTIC_LABELS['rms']}", text))
    return details


def _warnings(context: ReportContext) -> list[str]:
    """Return what a reader must know before relying on the report."""
    fit, texts = context.fit, []
    texts += summary.regressions(fit, context.comparisons)
    if not np.isfinite(fit.unit_weight_std):
        texts.append(
            f"{fit.sample_count} determine {fit.rank} directions in parameter space and leave no "
            "redundancy; the measurement noise and the parameter uncertainties cannot be estimated."
        )
    if context.outliers:
        count, n_rejected = len(context.outliers), fit.n_samples - fit.n_inliers
        texts.append(
            f"{format_count(count, 'outlier')} among the samples, in none of the figures; "
            f"{n_rejected or 'none'} rejected. See the section on outliers."
        )
    return texts
