"""The report as one HTML page that holds figures, tables and the scene, and asks no host for anything."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Sequence
from pathlib import Path

from .. import formatting
from .._typing import PathLike
from ..calibration import summary
from ..calibration.evaluation import Comparison
from ..calibration.result import Result
from ..calibration.summary import GROUP_LABELS, STATISTIC_LABELS
from ..diagnostics.residuals import Workspace
from ..exceptions import DhcalError
from ..formatting import Table, format_quantity
from ..io.atomic import write_files
from ..visualization import scene
from . import figures, maps, sections
from .document import Provenance
from .sections import ReportContext, Section

PAGE = Path(__file__).with_name("report.html")


BEFORE_AFTER = [("steps before", "before"), ("steps after", "after")]


def report_files(fit: Result, paths: Sequence[PathLike], source: Provenance) -> dict[PathLike, str | bytes]:
    """The report as text by path, HTML or Markdown as the path ends; not yet written.

    Raises:
        DhcalError: another ending.
    """
    if not paths:
        return {}
    for path in paths:
        check_ending(path)
    found = sections.report_context(fit, source)
    return {path: page(found) if _is_page(path) else sections.markdown(found) for path in paths}


def check_ending(path: PathLike) -> None:
    """Complains about a report's path that is neither HTML nor Markdown."""
    if not (_is_page(path) or os.fspath(path).lower().endswith(".md")):
        raise DhcalError(f"{os.fspath(path)}: unknown ending; write a report as .html or .md")


def _is_page(path: PathLike) -> bool:
    return os.fspath(path).lower().endswith((".html", ".htm"))


def write_report(fit: Result, path: PathLike, source: Provenance | None = None) -> None:
    """Writes the report of a calibration, as `.html` (one file with figures and scene) or `.md`.

    Args:
        fit: the result.
        path: where to; replaced if it is there.
        source: files, hashes and settings, which a result does not know itself.

    Raises:
        DhcalError: another ending, or a place that cannot be written.
    """
    write_files(report_files(fit, [path], source or Provenance()))


def page(found: ReportContext) -> str:
    """The HTML page; the same text for the same input."""
    body = [_head(found), *(_section(found, section) for section in sections.sections(found))]
    return _filled(f"Calibration of {found.robot}", body)


def map_page(title: str, found: Workspace, sentences: Sequence[str]) -> str:
    """The HTML page of a map of the predicted accuracy; the same text for the same input."""
    drawn, legend = maps.map_panels(found)
    body = [f"<header><h1>{html.escape(title)}</h1></header>", "<section>"]
    body += [f"<p>{html.escape(text)}</p>" for text in sentences]
    return _filled(title, [*body, _panels(drawn, legend, look="panels two"), "</section>"])


def _filled(title: str, body: Sequence[str]) -> str:
    parts = {"@TITLE@": html.escape(title), "@CONTENT@": "\n".join(body)}
    return re.sub("|".join(parts), lambda mark: parts[mark[0]], PAGE.read_text("utf-8"))


def _head(found: ReportContext) -> str:
    head = summary.headline(found.comparisons)
    best = head.comparison
    what = f"{GROUP_LABELS[head.group][0].upper()}{GROUP_LABELS[head.group][1:]}"
    many = "sample" if best.n_samples == 1 else "samples"
    if best.title != "fitted":
        title, note = f"{what} {summary.describe_samples(best)}", summary.small_sample_note(best)
    else:
        title = "Nothing was held out"
        note = (
            f"The figures are of the {best.n_samples} fitted {many} themselves and say little about any other; "
            "calibrate with --holdout 0.3, or validate on other measurements, to judge the arm."
        )
    big = [("before", "before, RMS", head.before), ("after", "after, RMS", head.after)]
    if best.before.groups[head.group].rms:
        big.append(
            (
                "",
                "smaller" if head.percent_reduction >= 0 else "larger",
                f"{abs(head.percent_reduction):.0f} %",
            )
        )
    notes = [note] if note else []
    notes += sections.warnings(found)
    out = [
        "<header>",
        f'<p class="eyebrow">Calibration of {html.escape(found.robot)}{_files(found)}</p>',
        f"<h1>{html.escape(title)}</h1>",
        _figures(big, "figure"),
        _figures(_details(best, head.group), "figure small"),
        *(f"<p>{html.escape(text)}</p>" for text in found.source.remarks),
    ]
    if notes:
        out.append(f'<ul class="warn">{"".join(f"<li>{html.escape(text)}</li>" for text in notes)}</ul>')
    return "\n".join([*out, "</header>"])


def _files(found: ReportContext) -> str:
    names = sorted({*found.source.names, *found.source.holdout_names})
    if not names:
        return ""
    return f" from {html.escape(names[0].rsplit('/', 1)[-1] if len(names) == 1 else f'{len(names)} files')}"


def _figures(rows: Sequence[tuple[str, str, str]], look: str) -> str:
    cells = (f'<div class="{kind}"><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>'
             for kind, name, value in rows)  # fmt: skip
    return f'<dl class="{look}">{"".join(cells)}</dl>'


def _details(best: Comparison, chosen: str) -> list[tuple[str, str, str]]:
    """The headline's other measures, and the RMS of other groups, after calibration."""
    out = []
    for group, after in best.after.groups.items():
        for key, word in STATISTIC_LABELS.items():
            if group == chosen and key in ("p95", "max"):
                value = format_quantity(getattr(after, key), after.unit, after.rms_std, small=True)
                out.append(("", f"after, {word}", value))
            elif group != chosen and key == "rms":
                before, value = (
                    format_quantity(one.rms, after.unit, after.rms_std, small=True)
                    for one in (best.before.groups[group], after)
                )
                out.append(("", f"{GROUP_LABELS[group]}, {word}", f"{before} → {value}"))
    return out


def _section(found: ReportContext, section: Section) -> str:
    drawn = FIGURES.get(section.key, lambda _: "")(found)
    texts = [f"<p>{html.escape(text)}</p>" for text in section.sentences]
    items = "".join(f"<li>{html.escape(text)}</li>" for text in section.items)
    listed = [f"<ul>{items}</ul>"] if items else []
    shown_tables = [_table(found, section, table) for table in section.tables]
    inside = [*texts, *listed, *shown_tables, drawn]
    if not any(inside):
        return ""
    head = f'<h2 id="{section.key}-h">{html.escape(section.title)}</h2>'
    return "\n".join(
        [f'<section aria-labelledby="{section.key}-h">', head, *filter(None, inside), "</section>"]
    )


def _table(found: ReportContext, section: Section, table: Table) -> str:
    bars = None
    if section.key == "parameters":
        bars = figures.estimate_bars(found, [row[0] for row in table.rows])
    name = html.escape(table.caption or f"{section.title}: {table.header[0]}")
    # A region that scrolls must be reachable by the keyboard.
    region = f'<div class="scroll" tabindex="0" role="region" aria-label="{name}">'
    return f"{region}{formatting.html_table(table, bars)}</div>"


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    def swatch(look: str) -> str:
        shapes = {"dots": "M4 6h0M11 6h0M18 6h0", "line": "M0 6H22", "steps": "M1 11V2H21V11Z"}
        return f'<path class="{look}" d="{shapes.get(look.split()[0], "M0 1H22V11H0Z")}"/>'

    cells = (f'<li><svg aria-hidden="true" viewBox="0 0 22 12">{swatch(look)}</svg>{html.escape(text)}</li>'
             for look, text in entries)  # fmt: skip
    return f'<ul class="legend">{"".join(cells)}</ul>'


def _panels(
    drawn: Sequence[str], legend: Sequence[tuple[str, str]] = (), title: str = "", look: str = "panels"
) -> str:
    if not drawn:
        return ""
    head = f"<h3>{html.escape(title)}</h3>" if title else ""
    return "\n".join([head, _legend(legend) if legend else "", f'<div class="{look}">', *drawn, "</div>"])


def _histograms(found: ReportContext) -> str:
    drawn = figures.histograms(found)
    return _panels(drawn, BEFORE_AFTER, look="panels two" if len(drawn) in (2, 4) else "panels")


def _left_figures(found: ReportContext) -> str:
    looks = figures.sample_looks(found)
    dots = [(f"dots {look}", name) for look, name in zip(looks, ("fitted", "held out"), strict=False)]
    dots += [("dots gross", "gross error")] if found.outliers else []
    lines = [(f"line {look}", look) for look in figures.visible_states(found)]
    one = [("dots faint", "a sample"), ("line after", "median")]
    return "\n".join(
        [
            _panels(
                figures.plot_joint_offset_profile(found),
                lines,
                "Error that each part of a joint's range asks of that joint alone",
            ),
            _panels(figures.by_joint(found), one, "Size of the errors over each joint's value, after"),
            _panels(
                figures.by_sample(found),
                dots,
                "Size of the errors in the order of the files, after",
                "panels wide",
            ),
        ]
    )


def _map_figures(found: ReportContext) -> str:
    drawn, legend = maps.map_panels(found.workspace)
    return _panels(drawn, legend, look="panels wide")


def _scene(found: ReportContext) -> str:
    fit = found.fit
    page = scene.scene_html(
        fit.nominal_refitted,
        fit,
        title=found.robot,
        magnification=maps.magnification(found),
    )
    frame = (
        '<iframe class="screen" sandbox="allow-scripts" loading="lazy" '
        f'title="The arm before and after, in three dimensions" srcdoc="{html.escape(page)}"></iframe>'
    )
    note = '<p class="screen">Drag to turn; sliders move the joints and draw errors larger than they are.</p>'
    still = maps.arm(found)
    return f'{note}\n{frame}\n<div class="paper">{_panels(still, BEFORE_AFTER_ARM, look="panels wide")}</div>'


BEFORE_AFTER_ARM = [
    ("line before", "nominal"),
    ("line after", "calibrated"),
    ("dots faint", "fitted samples"),
]


FIGURES = {
    "accuracy": _histograms,
    "left": _left_figures,
    "workspace": _map_figures,
    "scene": _scene,
    "seen": lambda found: _panels(figures.spectrum(found)),
}
