"""Report as one HTML page with figures, tables and the 3-D scene, which needs no network.

`page/report.html` is the Jinja template of the page; style sheet and scripts are beside it. All texts are
escaped when they are inserted; only figures, style and scripts are inserted unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from .. import formatting
from .._typing import PathLike
from ..calibration import summary
from ..calibration.evaluation import Comparison
from ..calibration.result import Result
from ..calibration.summary import STATISTIC_LABELS
from ..calibration.verdict import Verdict
from ..exceptions import InvalidArgumentError
from ..formatting import format_quantity
from ..measurements.groups import ERROR_GROUPS
from ..saving import write_files
from ..visualization.plots import svg_panels
from . import sections
from .context import ReportContext
from .document import Provenance
from .figures import Panel
from .samples import Samples
from .sections import Section


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
    if not paths:
        return {}
    for path in paths:
        check_ending(path)
    context = ReportContext.from_result(fit, source)
    return {path: html_page(context) if _is_html(path) else sections.markdown(context) for path in paths}


def check_ending(path: PathLike) -> None:
    """Raise an error if a path is neither that of an HTML nor that of a Markdown file."""
    if not (_is_html(path) or os.fspath(path).lower().endswith(".md")):
        raise InvalidArgumentError(f"{os.fspath(path)}: unknown ending; write a report as .html or .md")


def check_html_ending(path: PathLike, content: str) -> None:
    """Raise an error if a path is not that of an HTML file."""
    if not _is_html(path):
        raise InvalidArgumentError(f"{os.fspath(path)}: unknown ending; write {content} as .html")


def _is_html(path: PathLike) -> bool:
    return os.fspath(path).lower().endswith((".html", ".htm"))


@dataclass(frozen=True, eq=False)
class Page:
    """Content of a page: headline, sections and samples.

    Attributes:
        title: Title of the window.
        heading: Heading above all sections.
        sections: Sections; one without content is left out.
        eyebrow: Line above the heading.
        verdict: Verdict above the heading, if there is one.
        values: CSS class, name and text of the most important figures.
        details: CSS class, name and text of further figures.
        remarks: Paragraphs below the figures.
        warnings: What a reader must know before relying on the page.
        samples: Samples that a reader can select, if there are any.
    """

    title: str
    heading: str
    sections: Sequence[Section]
    eyebrow: str = ""
    verdict: Verdict | None = None
    values: Sequence[tuple[str, str, str]] = ()
    details: Sequence[tuple[str, str, str]] = ()
    remarks: Sequence[str] = ()
    warnings: Sequence[str] = ()
    samples: Samples | None = None


def html_page(context: ReportContext) -> str:
    """Render the report as an HTML page."""
    head = summary.headline(context.comparisons)
    best = head.comparison
    if best.title != "fitted":
        heading = f"{_capitalized(ERROR_GROUPS[head.group].label)} {summary.describe_samples(best)}"
        note = summary.small_sample_note(best)
    else:
        heading = "No hold-out measurements"
        note = (
            f"The figures describe the {best.n_samples} fitted "
            f"{'sample' if best.n_samples == 1 else 'samples'} and say little about other measurements. "
            "Calibrate with --holdout 0.3, or validate with other measurements, to assess the robot."
        )
    values = [("before", "before, RMS", head.before), ("after", "after, RMS", head.after)]
    if best.before.groups[head.group].rms:
        change = "smaller" if head.percent_reduction >= 0 else "larger"
        values.append(("", change, f"{abs(head.percent_reduction):.0f} %"))
    title = f"Calibration of {context.robot_name}"
    return render_page(
        Page(
            title=title,
            heading=heading,
            sections=sections.report_sections(context),
            eyebrow=f"{title}{_origin(context)}",
            verdict=context.fit.verdict,
            values=values,
            details=_details(best, head.group),
            remarks=[*context.source.remarks, *context.generalization_lines],
            warnings=[*([note] if note else []), *sections.warnings(context)],
            samples=context.samples,
        )
    )


def render_page(page: Page) -> str:
    """Render a page that contains everything it shows: style, scripts, figures and data."""
    shown = []
    for section in page.sections:
        groups = section.figures() if section.figures else ()
        if section.sentences or section.items or section.tables or groups:
            shown.append((section, groups))
    data = formatting.json_for_html(page.samples.page_data()) if page.samples else ""
    template = formatting.html_templates().get_template("report/page/report.html")
    with svg_panels() as svg:

        def draw(panel: Panel) -> str:
            return svg.draw(panel.plot, panel.key, panel.caption, panel.description, panel.size)

        return template.render(page=page, sections=shown, draw=draw, data=data)


def _origin(context: ReportContext) -> str:
    """Return from which files the measurements come, as the end of a sentence."""
    names = sorted({*context.source.names, *context.source.holdout_names})
    if not names:
        return ""
    return f" from {names[0].rsplit('/', 1)[-1] if len(names) == 1 else f'{len(names)} files'}"


def _details(best: Comparison, group: str) -> list[tuple[str, str, str]]:
    """Return CSS class, name and value of further statistics: of the group, and the RMS of other groups."""
    details = []
    for name, after in best.after.groups.items():
        if name == group:
            for key in ("p95", "max"):
                value = format_quantity(getattr(after, key), after.unit, after.rms_std, small=True)
                details.append(("", f"after, {STATISTIC_LABELS[key]}", value))
        else:
            before, value = (
                format_quantity(side.rms, after.unit, after.rms_std, small=True)
                for side in (best.before.groups[name], after)
            )
            details.append(
                ("", f"{ERROR_GROUPS[name].label}, {STATISTIC_LABELS['rms']}", f"{before} → {value}")
            )
    return details


def _capitalized(text: str) -> str:
    return text[:1].upper() + text[1:]
