"""Page with the checks of a robot over time."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from functools import partial

import numpy as np

from .. import plots
from ..formatting import Quantity, Table
from ..io.check_history import Check
from ..plots import WIDE_PANEL
from .document import Document, FigureGroup, LegendEntry, Panel, Section
from .html import html_page


def history_page(robot: str, checks: Sequence[Check]) -> str:
    """Render the history of a robot."""
    last = checks[-1]
    return html_page(
        Document(
            title=f"Checks of {robot}",
            heading=f"{last.verdict}: {last.what}" if last.what else last.verdict,
            eyebrow=f"Last of {len(checks)} checks of {robot}, {last.time}",
            sections=[
                Section("history", "Checks over time", figures=partial(_figures, checks)),
                Section("checks", "Checks", tables=[_table(checks)]),
            ],
        )
    )


def _figures(checks: Sequence[Check]) -> list[FigureGroup]:
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
    return [FigureGroup([panel], legend=[*legend, LegendEntry("expected", "text", "dashes")], layout="wide")]


def _table(checks: Sequence[Check]) -> Table:
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
