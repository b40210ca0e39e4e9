"""Summary of a calibration for people: tables of estimates and accuracy, and one sentence as headline.

Lengths are shown in millimetres, angles in degrees, changes and standard deviations of angles in
milliradians. The number of decimals follows from the standard error of each figure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..formatting import SMALL_UNITS, Table, format_fixed, format_quantity, significant_decimals
from .estimates import Estimate
from .evaluation import Comparison

# With fewer samples the figures come with a note that they are not reliable.
MIN_SAMPLES = 10
# The headline gives the RMS without outliers if it is below this fraction of the RMS with them.
OUTLIER_RMS_RATIO = 0.9

# Groups of errors in words.
GROUP_LABELS = {"position": "position error", "orientation": "orientation error", "residual": "residual"}
# Statistics in words, by the attribute of `ErrorStatistics`.
STATISTIC_LABELS = {"mean": "mean", "rms": "RMS", "p95": "95th percentile", "max": "maximum"}


def estimate_table(estimates: Sequence[Estimate]) -> Table:
    """Make a table of nominal and calibrated values, changes and standard deviations.

    Args:
        estimates: Estimates of a calibration.

    Returns:
        Table with one row per parameter.
    """
    rows = [
        [
            e.name,
            format_quantity(e.nominal, e.unit, e.std),
            format_quantity(e.value, e.unit, e.std),
            format_quantity(e.change, e.unit, e.std, small=True),
            e.certainty,
        ]
        for e in estimates
    ]
    return Table(["parameter", "nominal", "calibrated", "change", "std"], rows)


def accuracy_table(comparisons: Sequence[Comparison]) -> Table:
    """Make a table of the error statistics before and after a calibration, in mm and mrad.

    Args:
        comparisons: Comparisons of a calibration.

    Returns:
        Table with one row per comparison, group of errors and state.
    """
    rows = []
    for c in comparisons:
        for group, after in c.after.groups.items():
            factor, unit = SMALL_UNITS[after.unit]
            for state, side in (("before", c.before), ("after", c.after)):
                statistics = side.groups[group]
                decimals = significant_decimals(factor * statistics.rms_std)
                values = [getattr(statistics, key) for key in STATISTIC_LABELS]
                values += statistics.axes_rms or [math.nan] * 3
                cells = [format_fixed(factor * value, decimals) for value in values]
                rows.append([f"{after.samples} {c.title}", f"{GROUP_LABELS[group]},{unit}", state, *cells])
    axes = [f"{axis}, RMS" for axis in "xyz"]
    return Table(
        ["samples", "error", "calibration", *STATISTIC_LABELS.values(), *axes], rows, n_text_columns=3
    )


@dataclass(frozen=True)
class Headline:
    """Most important figure of a calibration.

    Attributes:
        text: Sentence with the figure.
        before: RMS error before, with its unit.
        after: RMS error after, with its unit.
        percent_reduction: Reduction of the RMS error in percent; negative if the error grew.
        group: Name of the group of errors, see `evaluation.GROUP_UNITS`.
        comparison: Comparison that the figure is taken from; `n_samples` counts the samples of the group.
    """

    text: str
    before: str
    after: str
    percent_reduction: float
    group: str
    comparison: Comparison


def headline(comparisons: Sequence[Comparison]) -> Headline:
    """Summarize the accuracy in one sentence.

    Args:
        comparisons: Comparisons of a calibration; the first is used: hold-out samples, else cross-validated,
            else fitted ones.

    Returns:
        The sentence and its figures.
    """
    best = comparisons[0]
    group, after = next(iter(best.after.groups.items()))
    before = best.before.groups[group]
    best = replace(best, n_samples=after.samples)
    before_text, after_text = (
        format_quantity(side.rms, side.unit, side.rms_std, small=True) for side in (before, after)
    )
    text = f"RMS {GROUP_LABELS[group]} {describe_samples(best)}: {before_text} before, {after_text} after"
    clean = best.after_without_outliers.groups.get(group)
    if clean and clean.rms < OUTLIER_RMS_RATIO * after.rms:
        clean_text = format_quantity(clean.rms, clean.unit, clean.rms_std, small=True)
        text += f", {clean_text} without {_count_outliers(best.n_outliers)}"
    text += f". {_count_outliers(best.n_rejected).capitalize()} rejected." if best.n_rejected else "."
    if best.title == "fitted":
        text = f"No hold-out samples. {text}"
    elif note := small_sample_note(best):
        text = f"{text} {note}"
    reduction = 100 * (1 - after.rms / before.rms) if before.rms else 0.0
    return Headline(text, before_text, after_text, reduction, group, best)


def regressions(comparisons: Sequence[Comparison]) -> list[str]:
    """List the comparisons in which the calibrated robot is worse than the nominal one.

    Args:
        comparisons: Comparisons of a calibration.

    Returns:
        One warning each, with what to do about it.
    """
    return [
        f"The calibrated robot is worse than the nominal one {describe_samples(c)}. Keep the nominal robot, "
        "measure more poses, or identify fewer parameters."
        for c in comparisons
        if headline([c]).percent_reduction < 0
    ]


def _count_outliers(count: int) -> str:
    """Return the number of outliers in words."""
    return f"{count} outliers" if count > 1 else "one outlier"


def describe_samples(comparison: Comparison) -> str:
    """Describe the samples of a comparison, such as "on 12 hold-out samples".

    Args:
        comparison: Comparison of a calibration.

    Returns:
        The description.
    """
    count = comparison.n_samples
    return f"on {count} {comparison.title} {'sample' if count == 1 else 'samples'}"


def small_sample_note(comparison: Comparison) -> str:
    """Return a note if a comparison has too few samples for a reliable figure, else an empty text."""
    return "So few samples give no reliable figure." if comparison.n_samples < MIN_SAMPLES else ""
