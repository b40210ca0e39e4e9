"""Summary of a calibration for people: tables of estimates and accuracy, and one sentence as headline.

Lengths are shown in millimetres, angles in degrees, changes and standard deviations of angles in
milliradians. The number of decimals follows from the standard error of each figure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..estimation.error_model import ErrorModel
from ..formatting import SMALL_UNITS, Table, format_fixed, format_quantity, significant_decimals
from ..measurements.groups import ERROR_GROUPS
from .cross_validation import Generalization
from .estimates import Estimate
from .evaluation import MIN_SAMPLES, Comparison

# The headline gives the RMS without outliers if it is below this fraction of the RMS with them.
OUTLIER_RMS_RATIO = 0.9
# Smaller shares of the joint space are shown as "under 1 %", and larger ones than the rest as "over 99 %".
MIN_SHOWN_SHARE = 0.01

# Statistics in words, by the attribute of `ErrorStatistics`.
STATISTIC_LABELS = {"mean": "mean", "rms": "RMS", "p95": "95th percentile", "max": "maximum"}

# Explanation of `definition_table`.
DEFINITION_TEXT = (
    "A parameter of the robot is a translation along, or a rotation about, an axis of a frame. The last "
    "table names the frames. “Origin of J” is the frame into which the <origin> of joint J places it, before "
    "the joint moves. “Link L” is the frame of link L. Base and tool are given by position and rotation "
    "vector."
)


def estimate_table(estimates: Sequence[Estimate]) -> Table:
    """Make a table of nominal and calibrated values, changes and standard deviations."""
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


def definition_table(estimates: Sequence[Estimate]) -> Table:
    """Make a table of the frames and directions in which the parameters are defined."""
    by_frame: dict[str, list[str]] = {}
    for e in estimates:
        if e.frame:
            by_frame.setdefault(e.frame, []).append(f"{e.name} {e.direction}")
    rows = [[frame, ", ".join(texts)] for frame, texts in by_frame.items()]
    return Table(["frame", "parameters and their directions"], rows, n_text_columns=2)


def accuracy_table(comparisons: Sequence[Comparison]) -> Table:
    """Make a table of the error statistics before and after a calibration, in mm and mrad."""
    rows = []
    for c in comparisons:
        for group, after in c.after.groups.items():
            factor, unit = SMALL_UNITS[after.unit]
            for state, side in (("before", c.before), ("after", c.after)):
                statistics = side.groups[group]
                decimals = significant_decimals(factor * statistics.rms_std)
                values = [getattr(statistics, key) for key in STATISTIC_LABELS]
                axes_rms = statistics.axes_rms or []
                # Image coordinates have two axes.
                values += [*axes_rms, *[math.nan] * (3 - len(axes_rms))]
                cells = [format_fixed(factor * value, decimals) for value in values]
                rows.append(
                    [f"{after.samples} {c.title}", f"{ERROR_GROUPS[group].label},{unit}", state, *cells]
                )
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
        group: Name of the group of errors, see `measurements.groups.ERROR_GROUPS`.
        comparison: Comparison that the figure is taken from; `n_samples` counts the samples of the group.
    """

    text: str
    before: str
    after: str
    percent_reduction: float
    group: str
    comparison: Comparison


def headline(comparisons: Sequence[Comparison]) -> Headline:
    """Summarize the accuracy in one sentence."""
    best = comparisons[0]
    group, after = next(iter(best.after.groups.items()))
    before = best.before.groups[group]
    best = replace(best, n_samples=after.samples)
    before_text, after_text = (
        format_quantity(side.rms, side.unit, side.rms_std, small=True) for side in (before, after)
    )
    text = (
        f"RMS {ERROR_GROUPS[group].label} {describe_samples(best)}: {before_text} before, {after_text} after"
    )
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


def generalization_lines(
    generalization: Generalization, comparisons: Sequence[Comparison]
) -> tuple[str, str]:
    """State the accuracy within the measured region and beyond it, one line each.

    Where joint values have no meaning, the lines speak of the measured poses, and state no shares.
    """
    inside, beyond = generalization.cross_validated, generalization.region_holdout
    if comparisons[0].title == "hold-out":
        inside = comparisons[0]
    covered, reached = generalization.covered_share, generalization.reached_share
    region, pronoun, rest = "Among the measured poses", "them", ""
    if covered is not None and reached is not None:
        region, pronoun = f"Measured region ({format_share(covered)} of joint space)", "it"
        rest = f"; for {format_share(1 - reached)} of joint space not known"
    unknown = "cannot be said, "
    return (
        f"{region}: "
        + (_before_and_after(inside) if inside else unknown + generalization.cross_validated_reason)
        + ".",
        f"Beyond {pronoun}: "
        + (_before_and_after(beyond) + rest if beyond else unknown + generalization.region_holdout_reason)
        + ".",
    )


def _before_and_after(comparison: Comparison) -> str:
    """Return the most important RMS error before and after."""
    group, after = next(iter(comparison.after.groups.items()))
    before_text, after_text = (
        format_quantity(side.rms, side.unit, side.rms_std, small=True)
        for side in (comparison.before.groups[group], after)
    )
    return f"{before_text} before, {after_text} after"


def format_share(share: float) -> str:
    """Format a share of random configurations in percent; it is never exactly 0 or 100 %.

    >>> format_share(0.004)
    'under 1 %'
    """
    if share < MIN_SHOWN_SHARE:
        return f"under {100 * MIN_SHOWN_SHARE:.0f} %"
    if share > 1 - MIN_SHOWN_SHARE:
        return f"over {100 * (1 - MIN_SHOWN_SHARE):.0f} %"
    return f"{100 * share:.0f} %"


def regressions(errors: ErrorModel, comparisons: Sequence[Comparison]) -> list[str]:
    """List the comparisons in which the calibrated robot is worse than the nominal one."""
    if not errors.has_arm:
        return []
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
    """Describe the samples of a comparison, such as "on 12 hold-out samples"."""
    count = comparison.n_samples
    if comparison.title == "region hold-out":
        return "on regions that were left out"
    return f"on {count} {comparison.title} {'sample' if count == 1 else 'samples'}"


def describe_sample_count(n_used: int, n_samples: int) -> str:
    """Describe the number of samples that a fit used, such as "60 samples" or "57 of 60 samples"."""
    used = "" if n_used == n_samples else f"{n_used} of "
    return f"{used}{n_samples} samples"


def small_sample_note(comparison: Comparison) -> str:
    """Return a note if a comparison has too few samples for a reliable figure, else an empty text."""
    return "So few samples give no reliable figure." if comparison.n_samples < MIN_SAMPLES else ""
