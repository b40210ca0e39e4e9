"""The plot of a study: median errors over the setting with the most values, a line for each of the others."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .._typing import Array
from .figures import HEIGHT, WIDE, Axis, axes, axis_over, dots, line

# What is drawn: a column, its title, and its factor from SI.
PANELS = (
    ("position_rms[m]", "position error, RMS [mm]", 1e3),
    ("orientation_rms[rad]", "orientation error, RMS [°]", 180 / math.pi),
    ("length_error[m]", "error of lengths, RMS [mm]", 1e3),
    ("angle_error[rad]", "error of angles, RMS [°]", 180 / math.pi),
)


# Okabe and Ito's colours, told apart by all eyes, then again with dashes.
COLOURS = ("#0072b2", "#b85c00", "#009e73", "#b0106a", "#56b4e9", "#8a7400", "#17212b")


DASHES = ("", "6 3", "2 2.5")


# Smaller shares of the largest error are rounding; from the first ratio on an axis is logarithmic.
ROUNDING, MIN_LOG_RATIO, MIN_TICK_SPACING = 1e-9, 8.0, 30.0


_GAP, _ROW = 14.0, 18.0


def plot(title: str, settings: int, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """The study's table as one SVG, or an empty text where no setting with a number varies.

    Args:
        title: of the study.
        settings: how many of the first columns are settings.
        header: names of the columns.
        rows: a row a setting, None where a figure is missing.
    """
    varied = [i for i in range(settings) if len({row[i] for row in rows}) > 1]
    numeric = [i for i in varied if all(type(row[i]) in (int, float) for row in rows)]
    if not numeric:
        return ""
    along = max(numeric, key=lambda i: len({row[i] for row in rows}))
    others = [i for i in varied if i != along]
    series: dict[str, list[Sequence[Any]]] = {}
    for row in rows:
        label = ", ".join(f"{header[i].replace('_', ' ')} {row[i]}" for i in others) or "all"
        series.setdefault(label, []).append(row)
    drawn = [one for one in PANELS if any(row[header.index(one[0])] is not None for row in rows)]
    across = 2 if len(drawn) > 1 else 1
    tall = HEIGHT * 1.3
    parts = []
    for number, (column, words, factor) in enumerate(drawn):
        key, at = f"study-{number}", header.index(column)
        figure = _panel(key, words, series, along, at, factor, header[along].replace("_", " "), tall)
        left, top = (number % across) * (WIDE + _GAP), 30 + (number // across) * (tall + _GAP)
        parts.append(
            figure.replace("<svg ", f'<svg x="{left:g}" y="{top:g}" width="{WIDE:g}" height="{tall:g}" ', 1)
        )
    width = across * WIDE + (across - 1) * _GAP
    top = 30 + math.ceil(len(drawn) / across) * (tall + _GAP)
    columns = max(1, int(width // (60 + 6.5 * max(map(len, series)))))
    for number, label in enumerate(series):
        x, y = (number % columns) * width / columns, top + (number // columns + 0.7) * _ROW
        parts.append(
            f'<path class="line s{number}" d="M{x + 8:.0f} {y - 4:.0f}h24"/>'
            f'<text x="{x + 38:.0f}" y="{y:.0f}">{html.escape(label)}</text>'
        )
    height = top + (math.ceil(len(series) / columns) + 0.5) * _ROW
    box = f'width="{width:.0f}" height="{height:.0f}"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" {box}>',
            f"<style>{_style(len(series))}</style>",
            f'<rect {box} fill="#fff"/>',
            f'<text class="title" x="8" y="19">{html.escape(title)}</text>',
            *parts,
            "</svg>\n",
        ]
    )


def _panel(
    key: str,
    words: str,
    series: dict[str, list[Sequence[Any]]],
    along: int,
    at: int,
    factor: float,
    name: str,
    tall: float,
) -> str:
    lines = []
    for rows in series.values():
        pairs = sorted((row[along], factor * row[at]) for row in rows if row[at] is not None)
        lines.append(np.array(pairs, float).reshape(-1, 2))
    every = np.concatenate(lines)
    floor = ROUNDING * every[:, 1].max()
    lines = [np.stack([pairs[:, 0], np.maximum(pairs[:, 1], floor)], 1) for pairs in lines]
    marks = [
        mark(pairs[:, 0], pairs[:, 1], f"s{number}")
        for number, pairs in enumerate(lines)
        for mark in (line, dots)
        if len(pairs)
    ]
    x, y = (
        _axis(every[:, 0], name, MIN_LOG_RATIO),
        _axis(np.maximum(every[:, 1], floor), "median", MIN_TICK_SPACING),
    )
    told = f"Median {words} over {name}, {len(series)} lines; the study's CSV has the numbers."
    return axes(key, words, told, x, y, marks, WIDE, tall)


def _axis(values: Array, title: str, many: float) -> Axis:
    """Logarithmic where the values span so large a ratio."""
    low, high = float(values.min()), float(values.max())
    if low > 0 and high / low > many:
        return Axis(low / 1.1, high * 1.1, title, log=True)
    return axis_over(values, title, zero=low >= 0)


def _style(count: int) -> str:
    rounds = [divmod(i, len(COLOURS)) for i in range(count)]
    looks = [
        f".s{i}{{stroke:{COLOURS[colour]};stroke-dasharray:{DASHES[turn % len(DASHES)]}}}"
        for i, (turn, colour) in enumerate(rounds)
    ]
    return (
        'text{font:11px system-ui,"Liberation Sans",sans-serif;fill:#51606e}'
        ".title{font-size:12px;font-weight:650;fill:#17212b}.middle{text-anchor:middle}.end{text-anchor:end}"
        "path{fill:none}.grid{stroke:#d4dce3;stroke-width:.8}.line{stroke-width:1.6;stroke-linejoin:round}"
        ".dots{stroke-width:4.5;stroke-linecap:round;stroke-dasharray:none!important}" + "".join(looks)
    )
