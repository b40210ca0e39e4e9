"""Numbers and tables as people read them: millimetres, degrees, digits as far as they are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..formatting import SMALL_UNITS, Table, format_fixed, format_quantity, significant_decimals
from .estimates import Estimate
from .evaluation import Comparison

# Fewer samples than this do not tell an accuracy; a longer text than this may be broken into lines.
MIN_SAMPLES = 10


# Gross errors among what was held out are worth a word where the RMS is this share of itself without them.
OUTLIER_RMS_RATIO = 0.9


# Groups of accuracy in words.
GROUP_LABELS = {"position": "position error", "orientation": "orientation error", "residual": "residual"}


# Measures of accuracy in words.
STATISTIC_LABELS = {"mean": "mean", "rms": "RMS", "p95": "95 % within", "max": "largest"}


def estimate_table(found: Sequence[Estimate]) -> Table:
    """Nominal and calibrated values, angles in degrees, changes and deviations in mrad."""
    rows = [
        [
            e.name,
            format_quantity(e.nominal, e.unit, e.std),
            format_quantity(e.value, e.unit, e.std),
            format_quantity(e.change, e.unit, e.std, small=True),
            e.certainty,
        ]
        for e in found
    ]
    return Table(["parameter", "nominal", "calibrated", "change", "std"], rows)


def accuracy_table(comparisons: Sequence[Comparison]) -> Table:
    """Before and after, held out and fitted, a line each; lengths in mm, angles in mrad."""
    rows = []
    for c in comparisons:
        for group, after in c.after.groups.items():
            factor, unit = SMALL_UNITS[after.unit]
            for state, side in (("before", c.before), ("after", c.after)):
                statistics = side.groups[group]
                places = significant_decimals(factor * statistics.rms_std)
                values = [getattr(statistics, key) for key in STATISTIC_LABELS]
                values += statistics.axes_rms or [math.nan] * 3
                cells = [format_fixed(factor * value, places) for value in values]
                rows.append([f"{after.samples} {c.title}", f"{GROUP_LABELS[group]},{unit}", state, *cells])
    axes = [f"{axis}, RMS" for axis in "xyz"]
    return Table(
        ["samples", "error", "calibration", *STATISTIC_LABELS.values(), *axes], rows, n_text_columns=3
    )


@dataclass(frozen=True)
class Headline:
    """The one figure that people act on.

    Attributes:
        text: in words.
        before, after: the figures with their unit.
        percent_reduction: how much smaller in percent; negative where the error grew.
        group: name of the group of errors, see `evaluation.GROUP_UNITS`.
        comparison: the accuracy it is of, with as many samples as the group has.
    """

    text: str
    before: str
    after: str
    percent_reduction: float
    group: str
    comparison: Comparison


def headline(comparisons: Sequence[Comparison]) -> Headline:
    """The error on what was not fitted where there is such, and an honest word where there is not."""
    best = comparisons[0]
    group, after = next(iter(best.after.groups.items()))
    before = best.before.groups[group]
    best = replace(best, n_samples=after.samples)
    before_text, after_text = (
        format_quantity(side.rms, side.unit, side.rms_std, True) for side in (before, after)
    )
    what = f"RMS {GROUP_LABELS[group]} {describe_samples(best)}: {before_text} before, {after_text} after"
    clean = best.after_without_outliers.groups.get(group)
    if clean and clean.rms < OUTLIER_RMS_RATIO * after.rms:
        clean_text = format_quantity(clean.rms, clean.unit, clean.rms_std, True)
        what += f", {clean_text} without {_outlier_count(best.n_outliers)} among them"
    what += f". {_outlier_count(best.n_rejected).capitalize()} left aside." if best.n_rejected else "."
    text = (
        f"{what} {small_sample_note(best)}".strip()
        if best.title != "fitted"
        else f"Nothing was held out. {what}"
    )
    drop = 100 * (1 - after.rms / before.rms) if before.rms else 0.0
    return Headline(text, before_text, after_text, drop, group, best)


def regressions(comparisons: Sequence[Comparison]) -> list[str]:
    """Where the calibrated arm is worse than the nominal one, and what to do about it."""
    worse = [describe_samples(c) for c in comparisons if headline([c]).percent_reduction < 0]
    return [
        f"The calibrated arm is worse than the nominal one {where}: they warrant no such correction. Keep "
        "the nominal arm, measure more poses, or identify fewer parameters."
        for where in worse
    ]


def _outlier_count(count: int) -> str:
    return f"{count} gross errors" if count > 1 else "one gross error"


def describe_samples(c: Comparison) -> str:
    """Which samples a comparison is about, in words."""
    many, was = ("sample", "was") if c.n_samples == 1 else ("samples", "were")
    ends = {
        "held out": f"{many} that {was} not fitted",
        "cross-validated": f"{many}, each left out of the fit that it judges",
        "fitted": f"fitted {many}",
    }
    return f"on {c.n_samples} {ends[c.title]}"


def small_sample_note(c: Comparison) -> str:
    """A warning where a comparison has too few samples to be sure of."""
    return "So few samples say little." if c.n_samples < MIN_SAMPLES else ""
