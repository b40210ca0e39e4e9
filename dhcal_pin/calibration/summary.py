"""Numbers and tables as people read them: millimetres, degrees, digits as far as they are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..formatting import SMALL, Table, digits, fixed, shown
from .estimates import Estimate
from .evaluation import ENDINGS, Comparison

# Fewer samples than this do not tell an accuracy; a longer text than this may be broken into lines.
FEW = 10


# Gross errors among what was held out are worth a word where the RMS is this share of itself without them.
TELLING = 0.9


# Groups of accuracy in words.
WORDS = {"position": "position error", "orientation": "orientation error", "residual": "residual"}


# Measures of accuracy in words.
MEASURES = {"mean": "mean", "rms": "RMS", "p95": "95 % within", "max": "largest"}


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
