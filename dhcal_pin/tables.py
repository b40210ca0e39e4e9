"""Numbers and tables as people read them: millimetres, degrees, digits as far as they are known."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from . import se3
from .chain import BASE, Chain
from .error_model import Parameter
from .evaluation import ENDINGS, Comparison
from .measurements import Unknown
from .se3 import Array

# Factor and name of a unit for reading: of a value, and of a change or an uncertainty.
RATES = {"rad/Nm": (1e6, " µrad/Nm"), "rad/rad": (1e3, " mrad/rad"), "rad/m": (1e3, " mrad/m")}
UNITS = {"m": (1e3, " mm"), "rad": (180 / math.pi, "°"), **RATES}
SMALL = {"m": (1e3, " mm"), "rad": (1e3, " mrad"), **RATES}
# Digits behind the point where no uncertainty says how many are known; and never more than MOST.
PLAIN, MOST = 3, 6
# Fewer samples than this do not tell an accuracy; a longer text than this may be broken into lines.
FEW, LONG = 10, 48
# Gross errors among what was held out are worth a word where the RMS is this share of itself without them.
TELLING = 0.9
# Groups of accuracy in words.
WORDS = {"position": "position error", "orientation": "orientation error", "residual": "residual"}
# Measures of accuracy in words.
MEASURES = {"mean": "mean", "rms": "RMS", "p95": "95 % within", "max": "largest"}


def digits(std: float) -> int:
    """Digits behind the point for an uncertainty: two of its own up to 35, else one (Particle Data Group)."""
    if not (math.isfinite(std) and std > 0):
        return PLAIN
    power = math.floor(math.log10(std))
    leading = std / 10.0**power
    return min(max((1 if leading < 3.55 or leading >= 9.5 else 0) - power - (leading >= 9.5), 0), MOST)


def fixed(value: float, places: int) -> str:
    """A number with so many digits behind the point; a dash where it is unknown, and no minus zero."""
    return f"{round(value, places) + 0.0:.{places}f}" if math.isfinite(value) else "–"


def shown(value: float, unit: str, std: float = math.nan, small: bool = False) -> str:
    """A value with its unit, rounded to its standard deviation where that is known.

    Args:
        value: m, rad, or in another unit and then shown as it is, to three digits.
        unit: of the value; "1" for a pure number.
        std: standard deviation in that unit.
        small: whether it is a change or an uncertainty: then angles are in mrad, not degrees.
    """
    if not math.isfinite(value):
        return "–"
    if unit not in UNITS:
        return f"{value:.3g} {unit}".removesuffix(" 1")
    factor, name = (SMALL if small else UNITS)[unit]
    return f"{fixed(factor * value, digits(factor * std))}{name}"


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes:
        header: names of the columns.
        rows: their cells.
        texts: how many of the first columns are text; the others are numbers.
        caption: what it shows.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: int = 1
    caption: str = ""


@dataclass(frozen=True)
class Estimate:
    """What was found of one parameter, m and rad.

    Attributes:
        name, unit: of the parameter.
        nominal, value: before and after.
        std: standard deviation, infinite where nothing tells.
        prior: standard deviation expected before any measurement, infinite without a prior.
        observability: how far the data see it, 0 to 1.
        remaining: the share that std is of what was expected before the measurement.
        fixed: whether it was held.
        place: "robot", "frame" (base and tool) or "instrument".
    """

    name: str
    unit: str
    nominal: float
    value: float
    std: float
    prior: float
    observability: float
    remaining: float
    fixed: bool
    place: str

    @property
    def change(self) -> float:
        """Value minus nominal; NaN for a frame, whose nominal place means nothing."""
        return math.nan if self.place == "frame" else self.value - self.nominal

    @property
    def certainty(self) -> str:
        """The standard deviation in words."""
        if self.fixed:
            return "fixed"
        return "not seen" if math.isinf(self.std) else shown(self.std, self.unit, self.std, small=True)


def estimates(
    chain: Chain, unknowns: Sequence[Parameter | Unknown], figures: Array, fixed: Sequence[Parameter]
) -> tuple[Estimate, ...]:
    """What was found of each unknown, then the parameters that were held.

    Args:
        chain: calibrated; base and tool are given by component of their place, others as nominal plus error.
        unknowns: of the robot and the instruments, p of them.
        figures: (p, 5) found error, standard deviation, prior, observability and share remaining of each.
        fixed: parameters that were held.
    """
    frames = {BASE: chain.base, chain.tool_station: chain.tool}
    sixes = {at: np.append(pose[:3, 3], se3.log3(pose[:3, :3])) for at, pose in frames.items()}
    rows = [(p, row, False) for p, row in zip(unknowns, figures.tolist(), strict=True)]
    rows += [(p, [0.0] * 5, True) for p in fixed]
    out = []
    for p, (x, std, prior, seen, left), held in rows:
        nominal, value, place = p.nominal, p.nominal + x, "instrument"
        if isinstance(p, Parameter):
            place = "frame" if p.station in frames else "robot"
        if isinstance(p, Parameter) and place == "frame":
            value = float(sixes[p.station] @ np.array(p.twist))
            nominal = value if held else nominal
        out.append(Estimate(p.name, p.unit, nominal, value, std, prior, seen, left, held, place))
    return tuple(out)


def estimate_table(found: Sequence[Estimate]) -> Table:
    """Nominal and calibrated values, angles in degrees, changes and deviations in mrad."""
    rows = [
        [
            e.name,
            shown(e.nominal, e.unit, e.std),
            shown(e.value, e.unit, e.std),
            shown(e.change, e.unit, e.std, small=True),
            e.certainty,
        ]
        for e in found
    ]
    return Table(["parameter", "nominal", "calibrated", "change", "std"], rows)


def accuracy_table(comparisons: Sequence[Comparison]) -> Table:
    """Before and after, held out and fitted, a line each; lengths in mm, angles in mrad."""
    rows = []
    for c in comparisons:
        for group, end in ENDINGS.items():
            if f"{group}_rms{end}" not in c.after:
                continue
            factor, unit = SMALL[end.strip("_") or "m"]
            for state, side in (("before", c.before), ("after", c.after)):
                places = digits(factor * side[f"{group}_rms_std{end}"])
                figures = [side[f"{group}_{key}{end}"] for key in MEASURES]
                figures += side.get(f"{group}_axes_rms{end}", [math.nan] * 3)
                cells = [fixed(factor * figure, places) for figure in figures]
                rows.append(
                    [f"{c.after[f'{group}_samples']} {c.title}", f"{WORDS[group]},{unit}", state, *cells]
                )
    axes = [f"{axis}, RMS" for axis in "xyz"]
    return Table(["samples", "error", "calibration", *MEASURES.values(), *axes], rows, texts=3)


@dataclass(frozen=True)
class Headline:
    """The one figure that people act on.

    Attributes:
        text: in words.
        before, after: the figures with their unit.
        drop: how much smaller in percent; negative where the error grew.
        group: of ENDINGS.
        of: the accuracy it is of, with as many samples as the group has.
    """

    text: str
    before: str
    after: str
    drop: float
    group: str
    of: Comparison


def headline(comparisons: Sequence[Comparison]) -> Headline:
    """The error on what was not fitted where there is such, and an honest word where there is not."""
    best = comparisons[0]
    group = next(group for group in ENDINGS if f"{group}_rms{ENDINGS[group]}" in best.after)
    best = replace(best, samples=best.after[f"{group}_samples"])
    end = ENDINGS[group]
    unit = end.strip("_") or "m"
    key, spread = f"{group}_rms{end}", f"{group}_rms_std{end}"
    before, after = (shown(side[key], unit, side[spread], True) for side in (best.before, best.after))
    what = f"RMS {WORDS[group]} {on_samples(best)}: {before} before, {after} after"
    if best.without and best.without[key] < TELLING * best.after[key]:
        clean = shown(best.without[key], unit, best.without[spread], True)
        what += f", {clean} without {_gross(best.gross)} among them"
    what += f". {_gross(best.aside).capitalize()} left aside." if best.aside else "."
    text = f"{what} {few(best)}".strip() if best.title != "fitted" else f"Nothing was held out. {what}"
    drop = 100 * (1 - best.after[key] / best.before[key]) if best.before[key] else 0.0
    return Headline(text, before, after, drop, group, best)


def setbacks(comparisons: Sequence[Comparison]) -> list[str]:
    """Where the calibrated arm is worse than the nominal one, and what to do about it."""
    worse = [on_samples(c) for c in comparisons if headline([c]).drop < 0]
    return [
        f"The calibrated arm is worse than the nominal one {where}: they warrant no such correction. Keep "
        "the nominal arm, measure more poses, or identify fewer parameters."
        for where in worse
    ]


def _gross(count: int) -> str:
    return f"{count} gross errors" if count > 1 else "one gross error"


def on_samples(c: Comparison) -> str:
    """Which samples a comparison is about, in words."""
    many, was = ("sample", "was") if c.samples == 1 else ("samples", "were")
    ends = {
        "held out": f"{many} that {was} not fitted",
        "left out": f"{many}, each left out of the fit that it judges",
        "fitted": f"fitted {many}",
    }
    return f"on {c.samples} {ends[c.title]}"


def few(c: Comparison) -> str:
    """A warning where a comparison has too few samples to be sure of."""
    return "So few samples say little." if c.samples < FEW else ""


def html_table(table: Table, drawings: Mapping[str, Sequence[str]] | None = None) -> str:
    """A table for a page; `drawings` are further columns of one svg a row, by their header."""
    drawn = drawings or {}

    def cell(tag: str, i: int, text: str) -> str:
        look = ' class="number"' if i >= table.texts else ' class="long"' if len(text) > LONG else ""
        scope = ' scope="row"' if tag == "th" else ""
        content = html.escape(text).replace("-", "−") if i >= table.texts else html.escape(text)
        return f"<{tag}{scope}{look}>{content}</{tag}>"

    head = "".join(
        f'<th scope="col"{" class=number" if i >= table.texts else ""}>{html.escape(name)}</th>'
        for i, name in enumerate(table.header)
    )
    head += "".join(f'<th scope="col">{html.escape(name)}</th>' for name in drawn)
    body = []
    for number, row in enumerate(table.rows):
        cells = "".join(cell("td" if i else "th", i, text) for i, text in enumerate(row))
        cells += "".join(f"<td>{column[number]}</td>" for column in drawn.values())
        body.append(f"<tr>{cells}</tr>")
    caption = f"<caption>{html.escape(table.caption)}</caption>" if table.caption else ""
    return f"<table>{caption}<thead><tr>{head}</tr></thead>\n<tbody>{chr(10).join(body)}</tbody></table>"


def markdown_table(table: Table) -> str:
    """A Markdown table, numbers to the right."""
    rules = [" --- " if i < table.texts else " ---: " for i in range(len(table.header))]
    lines = ["| " + " | ".join(table.header) + " |", "|" + "|".join(rules) + "|"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in table.rows]
    return "\n".join(lines)
