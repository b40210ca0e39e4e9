"""Pages of changes of a calibrated robot: the difference of two calibrations, and later checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial

import numpy as np

from .. import plots, se3
from ..diagnostics.difference import STATISTICS, Difference
from ..formatting import Quantity, Table, format_count
from ..io.check_history import Check
from ..plots import SQUARE_PANEL, WIDE_PANEL
from ..visualization import scene
from .document import Document, FigureGroup, LegendEntry, Panel, Section
from .figures import MAX_SCENE_TRIANGLES, level_legend, packed_scene
from .html import html_page
from .provenance import origin_tables


def difference_table(difference: Difference) -> Table:
    """Return one row per region and sort of distance."""
    rows = []
    for where, each in (("measured region", difference.region), ("joint limits", difference.everywhere)):
        for what, unit in (("position", "m"), ("orientation", "rad")):
            if each is None or getattr(each, what) is None:
                continue
            values = getattr(each, what)
            cells = [Quantity.error(float(function(values)), unit) for function in STATISTICS.values()]
            expected = each.expected if what == "position" and each.expected is not None else np.nan
            rows.append([f"{what}, {where}", *cells, Quantity.error(expected, "m")])
    return Table(["distance", "RMS", "95 %", "max", "expected RMS"], rows)


def difference_page(names: Sequence[str], difference: Difference, inputs: Mapping[str, str]) -> str:
    """Render the page of a difference of two robot files."""
    table = difference_table(difference)
    joints = [[name, part.text, f"{part.chi_square:.0f}"] for name, part in difference.joints.items()]
    header = ["joint or link", "largest difference", "part of chi-square"]
    tables = [table, *([Table(header, joints, n_text_columns=2)] if joints else [])]
    sections = [
        Section("difference", "Distance of the tools", difference.sentences, tables=tables),
        Section("map", "Over the workspace", figures=partial(_maps, difference)),
        Section("scene", "Both robots", figures=partial(_scene, difference)),
        Section("provenance", "Provenance", tables=origin_tables(inputs)),
    ]
    title = f"Difference of {names[0]} and {names[1]}"
    values = [("", row[0], f"{row[1]} RMS") for row in table.texts]
    return html_page(Document(title, sections, heading=difference.verdict, eyebrow=title, values=values))


def _maps(difference: Difference) -> list[FigureGroup]:
    """Draw maps of the distance of the tools."""
    a, b = difference.first, difference.second
    at = difference.q if difference.at is None else difference.at
    points, others = (chain.poses(at)[:, :3, 3] for chain in (a, b))
    distances, base = np.linalg.norm(points - others, axis=1), se3.inverse(a.base)
    points = se3.transform_points(base, points)
    levels, panels = plots.std_levels(distances), []
    for plane, view in (("xy", "from above"), ("xz", "from the side")):
        plot = partial(plots.plot_position_std_map, points, distances, plane=plane, levels=levels)
        rms = Quantity.error(float(STATISTICS["rms"](distances)), "m")
        text = f"Map of the distance of the tools over {plane[0]} and {plane[1]}: RMS {rms}."
        panels.append(Panel(f"difference-{plane}", f"Distance, {view}", text, plot, SQUARE_PANEL))
    return [FigureGroup(panels, legend=level_legend(levels), layout="wide")]


def _scene(difference: Difference) -> list[FigureGroup]:
    """Draw both robots in 3-D."""
    a, b = difference.first, difference.second
    page = scene.scene_html(a, b, title="Difference", triangles=MAX_SCENE_TRIANGLES)
    return [FigureGroup((), scene=packed_scene(page), scene_title="Both robots, in three dimensions")]


# --- checks over time ------------------------------------------------------------------------------


def history_page(robot: str, checks: Sequence[Check]) -> str:
    """Render the history of a robot."""
    last = checks[-1]
    return html_page(
        Document(
            title=f"Checks of {robot}",
            heading=f"{last.verdict}: {last.what}" if last.what else last.verdict,
            eyebrow=f"{format_count(len(checks), 'check')} of {robot}, the last one {last.time}",
            sections=[
                Section("history", "Checks over time", figures=partial(_history_figures, checks)),
                Section("checks", "Checks", tables=[_history_table(checks)]),
            ],
        )
    )


def _history_figures(checks: Sequence[Check]) -> list[FigureGroup]:
    """Draw the residuals of the checks over time."""
    times = np.array([datetime.fromisoformat(check.time).timestamp() for check in checks])
    residuals = np.array([check.residual_rms_m for check in checks])
    expected = np.array([np.nan if c.expected_rms_m is None else c.expected_rms_m for c in checks])
    verdicts = [check.verdict for check in checks]
    plot = partial(plots.plot_checks, (times - times.max()) / 86400.0, residuals, expected, verdicts)
    largest = Quantity.error(float(residuals.max()), "m")
    text = f"RMS distance of the measured positions from those of the robot over time; at most {largest}."
    panel = Panel("checks", "Distance of measured positions, RMS", text, plot, WIDE_PANEL)
    legend = [
        LegendEntry(name, color, "dots") for name, color in plots.CHECK_COLORS.items() if name in verdicts
    ]
    if np.isfinite(expected).any():
        legend.append(LegendEntry("expected", "text", "dashes"))
    return [FigureGroup([panel], legend=legend, layout="wide")]


def _history_table(checks: Sequence[Check]) -> Table:
    """List the checks, the last one first."""
    rows = []
    for check in reversed(checks):
        expected = np.nan if check.expected_rms_m is None else check.expected_rms_m
        size = (
            Quantity(check.size, check.unit or "m", check.std or np.nan, is_small=True) if check.size else ""
        )
        rows.append(
            [
                check.time,
                check.verdict,
                check.what,
                size,
                Quantity.error(check.residual_rms_m, "m"),
                Quantity.error(expected, "m"),
            ]
        )
    return Table(["time", "verdict", "what", "size", "RMS", "expected RMS"], rows, n_text_columns=3)
