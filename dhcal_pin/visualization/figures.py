"""Small figures as SVG text: panels with axes, dots, lines, steps, bars and maps.

A panel is as wide as a third of a page or a telephone, so that its letters stay legible on both. Colours
come from the page's style sheet by class (`before`, `after`, `faint`, `level0` …), for light, dark and print.
Numbers are rounded to a tenth of a pixel; the same input gives the same text.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .._typing import Array

WIDTH, WIDE, HEIGHT = 320.0, 420.0, 200.0


LEFT, RIGHT, TOP, BOTTOM = 50.0, 10.0, 26.0, 36.0


# Levels of a map, from good to bad.
LEVELS = 6


@dataclass(frozen=True)
class Axis:
    """One axis of a panel.

    Attributes:
        low, high: its ends, in the data's unit.
        title: what it is, with unit.
        log: whether it is logarithmic; low and high are positive then.
    """

    low: float
    high: float
    title: str
    log: bool = False

    def share(self, values: ArrayLike) -> Array:
        """Where values are between the ends, 0 to 1."""
        values = np.asarray(values, float)
        if self.log:
            return np.log(values / self.low) / math.log(self.high / self.low)
        return (values - self.low) / (self.high - self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Round places and their labels."""
        if self.log:
            first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            if self.high / self.low < 1e3:
                between = (1, 2, 5) if self.high / self.low < 50 else (1,)
                every = (k * 10.0**e for e in range(first - 1, last + 1) for k in between)
                inside = (v for v in every if self.low <= v * (1 + 1e-9) and v <= self.high * (1 + 1e-9))
                return [(value, f"{value:g}") for value in inside]
            step = max(1, -(-(last - first) // 4))
            return [(10.0**e, _power(e)) for e in range(first, last + 1, step)]
        step = nice_step((self.high - self.low) / 5)
        numbers = range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)
        return [(n * step, _minus(f"{n * step:.{decimals(step)}f}")) for n in numbers]


def nice_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-9))


def decimals(step: float) -> int:
    """Digits behind the point that multiples of a round step need."""
    return max(0, -math.floor(math.log10(step) + 1e-9))


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _power(exponent: int) -> str:
    raised = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return "1" if exponent == 0 else "10" if exponent == 1 else f"10{raised}"


def axis_over(values: ArrayLike, title: str, *, zero: bool = False, round_up: bool = True) -> Axis:
    """An axis over all finite values, from zero if asked, ending on round numbers if asked."""
    values = np.asarray(values, float).ravel()
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    low = min(low, 0.0) if zero else low
    if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
        pad = abs(high) or 1.0
        low, high = (0.0, pad) if zero else (low - pad, high + pad)
    if round_up:
        step = nice_step((high - low) / 5)
        low, high = step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)
    return Axis(low, high, title)


def symmetric(values: ArrayLike, title: str) -> Axis:
    """An axis over all finite values with zero in the middle."""
    values = np.asarray(values, float).ravel()
    most = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0)) or 1.0
    step = nice_step(most / 2)
    return Axis(-step * math.ceil(most / step - 1e-9), step * math.ceil(most / step - 1e-9), title)


@dataclass(frozen=True)
class Frame:
    """The plotting area: pixels of data."""

    x: Axis
    y: Axis
    width: float
    height: float

    @property
    def right(self) -> float:
        """The right end of the plotting area, pixels."""
        return self.width - RIGHT

    def x_pixels(self, values: ArrayLike) -> Array:
        """Pixels from the left."""
        return LEFT + np.clip(self.x.share(values), -0.02, 1.02) * (self.right - LEFT)

    def y_pixels(self, values: ArrayLike) -> Array:
        """Pixels from the top."""
        return (
            self.height - BOTTOM - np.clip(self.y.share(values), -0.02, 1.02) * (self.height - TOP - BOTTOM)
        )


Mark = Callable[[Frame], str]


def _number(value: float) -> str:
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def _pairs(frame: Frame, x: ArrayLike, y: ArrayLike) -> list[str]:
    across, down = np.broadcast_arrays(frame.x_pixels(x), frame.y_pixels(y))
    pairs = zip(across.tolist(), down.tolist(), strict=True)
    return [f"{_number(a)} {_number(d)}" for a, d in pairs if math.isfinite(a) and math.isfinite(d)]


def dots(x: ArrayLike, y: ArrayLike, css_class: str) -> Mark:
    """Round dots, one path for all of them."""
    return lambda frame: (
        f'<path class="dots {css_class}" d="{"".join(f"M{at}h0" for at in _pairs(frame, x, y))}"/>'
    )


def line(x: ArrayLike, y: ArrayLike, css_class: str) -> Mark:
    """A line through points."""
    return lambda frame: f'<path class="line {css_class}" d="M{"L".join(_pairs(frame, x, y))}"/>'


def histogram(edges: ArrayLike, counts: ArrayLike, css_class: str) -> Mark:
    """A histogram's outline over a filled area."""
    edges = np.asarray(edges, float)
    x = np.repeat(edges, 2)
    y = np.concatenate([[0.0], np.repeat(np.asarray(counts, float), 2), [0.0]])
    return lambda frame: f'<path class="steps {css_class}" d="M{"L".join(_pairs(frame, x, y))}"/>'


def error_bars(x: ArrayLike, low: ArrayLike, high: ArrayLike, css_class: str) -> Mark:
    """Vertical bars from low to high."""

    def draw(frame: Frame) -> str:
        across, top, bottom = (
            v.tolist() for v in (frame.x_pixels(x), frame.y_pixels(high), frame.y_pixels(low))
        )
        parts = (
            f"M{_number(a)} {_number(t)}V{_number(b)}"
            for a, t, b in zip(across, top, bottom, strict=True)
            if math.isfinite(t + b)
        )
        return f'<path class="line {css_class}" d="{"".join(parts)}"/>'

    return draw


def hline(value: float, css_class: str) -> Mark:
    """A horizontal line through the whole panel."""
    return lambda frame: (
        f'<path class="line {css_class}" d="M{_number(LEFT)} {_number(float(frame.y_pixels(value)))}'
        f'H{_number(frame.right)}"/>'
    )


def heatmap(x: ArrayLike, y: ArrayLike, size: float, level: ArrayLike) -> Mark:
    """Squares of a map with lower corners (x, y) and side `size`, coloured by level; -1 is unknown."""
    x, y, level = np.asarray(x, float), np.asarray(y, float), np.asarray(level, int)

    def draw(frame: Frame) -> str:
        out = []
        for value in np.unique(level):
            mine = level == value
            left, right = frame.x_pixels(x[mine]), frame.x_pixels(x[mine] + size)
            low, high = frame.y_pixels(y[mine]), frame.y_pixels(y[mine] + size)
            parts = "".join(
                f"M{_number(a)} {_number(d)}H{_number(b)}V{_number(c)}H{_number(a)}Z"
                for a, b, c, d in zip(left.tolist(), right.tolist(), low.tolist(), high.tolist(), strict=True)
            )
            out.append(f'<path class="{f"level{value}" if value >= 0 else "unknown"}" d="{parts}"/>')
        return "".join(out)

    return draw


def axes(
    key: str,
    title: str,
    description: str,
    x: Axis,
    y: Axis,
    marks: Sequence[Mark],
    width: float = WIDTH,
    height: float = HEIGHT,
) -> str:
    """One figure: title, axes and marks; `key` makes its ids unique on the page."""
    frame = Frame(x, y, width, height)
    floor = height - BOTTOM
    lines, labels = [], []
    for value, label in y.ticks():
        at = float(frame.y_pixels(value))
        lines.append(f"M{_number(LEFT)} {_number(at)}H{_number(frame.right)}")
        labels.append(
            f'<text class="tick end" x="{_number(LEFT - 5)}" y="{_number(at + 3.5)}">{label}</text>'
        )
    for value, label in x.ticks():
        at = float(frame.x_pixels(value))
        lines.append(f"M{_number(at)} {_number(TOP)}V{_number(floor)}")
        labels.append(f'<text class="tick middle" x="{_number(at)}" y="{_number(floor + 13)}">{label}</text>')
    middle = _number(0.5 * (LEFT + frame.right))
    return "\n".join(
        [
            f'<svg role="img" aria-labelledby="{key}-t {key}-d" viewBox="0 0 {width:.0f} {height:.0f}">',
            f'<title id="{key}-t">{html.escape(title)}</title>',
            f'<desc id="{key}-d">{html.escape(description)}</desc>',
            f'<path class="grid" d="{"".join(lines)}"/>',
            *(mark(frame) for mark in marks),
            *labels,
            f'<text class="title" x="{_number(LEFT)}" y="14">{html.escape(title)}</text>',
            f'<text class="axis middle" x="{middle}" y="{_number(height - 6)}">{html.escape(x.title)}</text>',
            f'<text class="axis middle" transform="translate(10 {_number(0.5 * (TOP + floor))}) rotate(-90)">'
            f"{html.escape(y.title)}</text>",
            "</svg>",
        ]
    )


def subsample_indices(count: int, most: int) -> Array:
    """At most so many numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def level_of(values: ArrayLike, edges: Sequence[float]) -> Array:
    """Which interval between rising edges each value is in, from 0; -1 where it is not finite."""
    values = np.asarray(values, float)
    level = np.clip(np.searchsorted(np.asarray(edges), values, side="right") - 1, 0, len(edges) - 2)
    return np.where(np.isfinite(values), level, -1)


def share_bar(share: float) -> str:
    """A bar of a share between 0 and 1, to stand in a table's cell beside its number."""
    return (
        '<svg class="bar" aria-hidden="true" viewBox="0 0 60 10"><path class="track" d="M0 5H60"/>'
        f'<path class="fill" d="M0 5H{_number(60 * share)}"/></svg>'
    )


def interval_bar(low: float, middle: float, high: float, most: float) -> str:
    """An interval on a scale from -most to most, to stand in a table's cell beside its numbers."""
    a, m, b = (50 + 48 * max(-1.0, min(1.0, v / most)) if most > 0 else 50.0 for v in (low, middle, high))
    return (
        '<svg class="interval" aria-hidden="true" viewBox="0 0 100 10"><path class="zero" d="M50 0V10"/>'
        f'<path class="reach" d="M{_number(a)} 5H{_number(b)}"/>'
        f'<path class="dot" d="M{_number(m)} 5h0"/></svg>'
    )
