"""Summary of a calibration for people: tables of estimates and accuracy, and one sentence as headline.

Lengths are shown in millimetres, angles in degrees, changes and standard deviations of angles in
milliradians. The number of decimals follows from the standard error of each figure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation.parameters import fold_harmonics
from ..estimation.qr import TriangularSystem
from ..formatting import SMALL_UNITS, Quantity, Table, format_count, format_quantity
from ..identifiability import label_unobservable
from ..measurements.contact import SphereContact
from ..measurements.groups import ERROR_GROUPS, error_group
from ..plausibility.displacement import workspace_radius
from .cross_validation import Generalization
from .estimates import Estimate
from .evaluation import MIN_SAMPLES, Comparison, ErrorStatistics
from .evidence import BESIDE, Evidence

# Smaller shares of the joint space are shown as "under 1 %", and larger ones than the rest as "over 99 %".
MIN_SHOWN_SHARE = 0.01
# Errors beside the measured point of a tool are stated if they are larger than those at it by this factor.
MIN_BESIDE_RATIO = 2.0
# Smaller distances from the axis of the last joint are the reason for them, and those of a point on it [m].
MAX_ON_AXIS, MIN_OFF_AXIS = 0.05, 1e-3
# Errors are far smaller than their stated standard deviations below this share of them. At 0.13 a calibration
# with estimated noise reduced the true error by 20 % in simulations, and at 0.2 by 5 %.
MAX_SIGMA_SHARE = 0.15
# Error of the radius of touched spheres whose effect is stated [m].
RADIUS_ERROR = 1e-4

# Option that excludes outliers, by the method of the calibration that kept them.
AUTO_OPTIONS = {"lm": "--loss auto", "gn": "--method lm"}

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
            Quantity(e.nominal, e.unit, e.std),
            Quantity(e.value, e.unit, e.std),
            Quantity(e.change, e.unit, e.std, is_small=True),
            e.certainty,
        ]
        for e in estimates
    ]
    return Table(["parameter", "nominal", "calibrated", "change", "std"], rows)


def definition_table(estimates: Sequence[Estimate]) -> Table:
    """Make a table of the frames and directions in which the parameters are defined."""
    by_frame: dict[str, dict[str, list[str]]] = {}
    for e in estimates:
        if e.frame:
            by_frame.setdefault(e.frame, {}).setdefault(e.direction, []).append(e.name)
    rows = [
        [frame, ", ".join(f"{name} {way}" for way, names in ways.items() for name in fold_harmonics(names))]
        for frame, ways in by_frame.items()
    ]
    return Table(["frame", "parameters and their directions"], rows, n_text_columns=2)


def parameter_notes(unobservable: Sequence[str], weakly_observable: Sequence[str]) -> list[str]:
    """List the parameters that are not or poorly identified."""
    return [
        *map(label_unobservable, unobservable),
        *(f"poorly identified: {text}" for text in weakly_observable),
    ]


def describe_convergence(converged: bool, iterations: int) -> str:
    """State whether a fit converged, and in how many iterations."""
    return f"{'converged' if converged else 'not converged'} after {format_count(iterations, 'iteration')}"


def position_notes(std: float | None) -> list[str]:
    """Return a sentence on the positions of camera and board, if their standard deviation [m] is known."""
    if std is None or not np.isfinite(std):
        return []
    size = Quantity.error(std, "m")
    return [
        f"Positions of camera and board relative to the arm: standard deviation {size}, without errors of "
        "the arm that no image shows, such as the length of its last link."
    ]


def position_error_of_images(fit: Evidence) -> float | None:
    """Return the position error [m] of the tool of an arm that images correct; None for other arms."""
    if not (fit.camera_stages and fit.errors.has_arm and np.isfinite(fit.position_std)):
        return None
    # The prediction lacks errors that the links imitate; left-out images lack those along the line of sight.
    shown = fit.comparisons[0].after.groups.get("board")
    return max(fit.position_std, shown.rms) if shown else fit.position_std


def position_error_notes(fit: Evidence) -> list[str]:
    """Return a sentence on the position error of the tool of an arm that images correct."""
    error = position_error_of_images(fit)
    if error is None:
        return []
    size = Quantity.error(error, "m")
    return [f"Tool in the measured region: position error of about {size} with the best base and tool."]


def position_error_beside(fit: Evidence) -> float | None:
    """Return the predicted error [m] beside the measured point of a tool if it is far larger, else None."""
    groups = fit.comparisons[0].after.groups.values()
    errors = [group.rms for group in groups if group.unit == "m"]
    is_point = bool(errors) and len(errors) == len(groups) and fit.has_joint_values
    if not (is_point and fit.errors.has_arm and fit.shrinkage_factor):
        return None
    beside = fit.position_std_beside
    return beside if beside > MIN_BESIDE_RATIO * max(fit.position_std, *errors) else None


def accuracy_notes(fit: Evidence) -> list[str]:
    """Return sentences on errors that the stated accuracy does not contain, and on what would reduce it."""
    mounting = [fit.mounting.sentence] if fit.mounting else []
    return [*beside_notes(fit), *size_notes(fit), *sigma_notes(fit), *mounting]


def beside_notes(fit: Evidence) -> list[str]:
    """Return sentences on the error beside the measured point of a tool, and what to measure."""
    error = position_error_beside(fit)
    if error is None:
        return []
    size = f"about {format_quantity(error, 'm', 0.1 * error)}" if np.isfinite(error) else "not known"
    distance = f"{1e3 * BESIDE:.0f} mm"
    text = f"{distance} beside the measured point of the tool, the expected error is {size}."
    chain = fit.chain
    last = chain.joint_jacobian(chain.forward_kinematics(np.zeros((1, chain.n_joints))))[-1, :, 0]
    off_axis, turn = np.linalg.norm(last[:3]), np.linalg.norm(last[3:])
    if off_axis >= MAX_ON_AXIS * turn:
        return [f"{text} Measure the orientation of the tool, too, or several points of it."]
    place = f"{1e3 * off_axis / turn:.0f} mm from" if off_axis >= MIN_OFF_AXIS * turn else "on"
    return [
        f"{text} The point is {place} the axis of {chain.joint_names[-1]} and hardly shows the direction of "
        f"this axis. Measure a point at least {distance} from the axis."
    ]


def size_notes(fit: Evidence) -> list[str]:
    """Return a sentence on the error by a wrong radius of touched spheres, if only it shows the size."""
    lengths = [item for item in fit.data if item.has_length_scale]
    radii = [item.values for item in lengths if isinstance(item, SphereContact)]
    if not (radii and len(radii) == len(lengths) and fit.errors.has_arm and fit.shrinkage_factor):
        return []
    size = workspace_radius(fit.chain) / np.sqrt(np.mean(np.concatenate(radii) ** 2))
    error = format_quantity(RADIUS_ERROR * size, "m", 0.1 * RADIUS_ERROR * size)
    return [
        f"Only the stated radius shows the size of the robot: if it is wrong by {1e3 * RADIUS_ERROR:g} mm, "
        f"positions are wrong by about {error}."
    ]


def sigma_notes(fit: Evidence) -> list[str]:
    """Return a sentence on stated standard deviations that are far larger than the residuals."""
    stated = fit.stated_noise_factors
    ratio = min(stated.values(), default=1.0)
    if ratio > MAX_SIGMA_SHARE or fit.camera_stages or not fit.errors.has_arm:
        return []
    label = ERROR_GROUPS[error_group(min(stated, key=lambda name: stated[name]))].label
    return [
        f"The stated standard deviations are {1 / max(ratio, 1e-3):.0f} times as large as the {label}s, so "
        "that the measurements count too little. Leave the sigma columns out, or correct them."
    ]


def largest_corrections(estimates: Sequence[Estimate], x: Array, system: TriangularSystem) -> list[Estimate]:
    """Sort the corrections x of the robot by their effect on the measured values.

    Those that are zero within two standard deviations are left out.
    """
    ordered = [estimates[i] for i in np.argsort(-np.abs(x) * system.column_norms, kind="stable")]
    return [e for e in ordered if e.category == "robot" and e.change and not abs(e.change) <= 2 * e.std]


def statistic(errors: ErrorStatistics, name: str = "rms") -> Quantity:
    """Return a statistic of errors, rounded by the standard error of their RMS."""
    return Quantity(getattr(errors, name), errors.unit, errors.rms_std, is_small=True)


def before_and_after(comparison: Comparison, group: str) -> tuple[Quantity, Quantity]:
    """Return the RMS errors of a group before and after a calibration."""
    return statistic(comparison.before.groups[group]), statistic(comparison.after.groups[group])


def urdf_alone(comparison: Comparison, group: str) -> Quantity | None:
    """Return the RMS error of a group with the URDF alone; None if the sidecar has no errors of the arm."""
    return statistic(comparison.after_alone.groups[group]) if comparison.after_alone else None


def accuracy_table(comparisons: Sequence[Comparison]) -> Table:
    """Make a table of the error statistics before and after a calibration, in mm and mrad."""
    rows = []
    for c in comparisons:
        for group, after in c.after.groups.items():
            error = f"{ERROR_GROUPS[group].label},{SMALL_UNITS[after.unit][1]}"
            for state, side in (("before", c.before), ("after", c.after), ("URDF alone", c.after_alone)):
                if side is None:
                    continue
                errors = side.groups[group]
                values = [getattr(errors, key) for key in STATISTIC_LABELS]
                axes_rms = errors.axes_rms or ()
                # Image coordinates have two axes.
                values += [*axes_rms, *[math.nan] * (3 - len(axes_rms))]
                cells = [replace(statistic(errors), value=value, has_unit=False) for value in values]
                rows.append([f"{after.samples} {c.title}", error, state, *cells])
    axes = [f"{axis}, RMS" for axis in "xyz"]
    return Table(
        ["samples", "error", "calibration", *STATISTIC_LABELS.values(), *axes], rows, n_text_columns=3
    )


def file_table(names: Sequence[str], comparisons: Sequence[Comparison]) -> Table | None:
    """Make a table of the error of each file; None for a single one."""
    if len(names) < 2:
        return None
    rows = [
        [name, f"{c.n_samples}", f"{c.n_outliers}", *before_and_after(c, group)]
        for name, c in zip(names, comparisons, strict=True)
        for group in list(c.after.groups)[:1]
    ]
    return Table(["error of each file, RMS", "samples", "outliers", "before", "after"], rows)


@frozen
class Headline:
    """Most important figure of a calibration."""

    text: str  # Sentence with the figure
    before: str  # RMS error before, with its unit
    after: str  # RMS error after, with its unit
    percent_reduction: float  # Reduction of the RMS error in percent; negative if the error grew
    group: str  # Name of the group of errors, see `measurements.groups.ERROR_GROUPS`
    # Comparison that the figure is taken from; `n_samples` counts the samples of the group.
    comparison: Comparison


def headline(comparisons: Sequence[Comparison]) -> Headline:
    """Summarize the accuracy in one sentence."""
    best = comparisons[0]
    group, after = next(iter(best.after.groups.items()))
    before = best.before.groups[group]
    best = replace(best, n_samples=after.samples)
    before_text, after_text = map(str, before_and_after(best, group))
    text = (
        f"RMS {ERROR_GROUPS[group].label} {describe_samples(best)}: {before_text} before, {after_text} after"
    )
    if best.n_outliers:
        text += f", without {format_count(best.n_outliers, 'outlier')}"
        everything = best.after_with_outliers.groups.get(group)
        text += (
            f" ({statistic(everything)} with {'it' if best.n_outliers == 1 else 'them'})"
            if everything
            else ""
        )
    if alone := urdf_alone(best, group):
        text += f"; {alone} with the URDF alone"
    text += "."
    if best.title == "fitted":
        text = f"No hold-out samples. {text}"
    elif note := small_sample_note(best):
        text = f"{text} {note}"
    reduction = 100 * (1 - after.rms / before.rms) if before.rms else 0.0
    return Headline(text, before_text, after_text, reduction, group, best)


def judged_regions(
    generalization: Generalization, comparisons: Sequence[Comparison]
) -> tuple[tuple[Comparison | None, str], tuple[Comparison | None, str]]:
    """Return the accuracy within the measured region and beyond it, each with the reason if there is none."""
    has_holdout = comparisons[0].title == "hold-out"
    inside = comparisons[0] if has_holdout else generalization.cross_validated
    return (
        (inside, generalization.cross_validated_reason),
        (generalization.region_holdout, generalization.region_holdout_reason),
    )


def generalization_lines(
    generalization: Generalization, comparisons: Sequence[Comparison]
) -> tuple[str, str]:
    """State the accuracy in the measured region and beyond it, one line each; shares need joint values."""
    inside, beyond = judged_regions(generalization, comparisons)
    covered, reached = generalization.covered_share, generalization.reached_share
    region, pronoun, rest = "Among the measured poses", "them", ""
    if covered is not None and reached is not None:
        region, pronoun = f"Measured region ({format_share(covered)} of joint space)", "it"
        rest = f"; for {format_share(1 - reached)} of joint space not known"

    def describe(comparison: Comparison | None, reason: str, rest: str = "") -> str:
        if comparison is None:
            return f"cannot be said, {reason}."
        group = next(iter(comparison.after.groups))
        before, after = before_and_after(comparison, group)
        alone = urdf_alone(comparison, group)
        return f"{before} before, {after} after{f', {alone} with the URDF alone' if alone else ''}{rest}."

    return (
        f"{region}: {describe(*inside)}",
        f"Beyond {pronoun}: {describe(*beyond, rest)}",
    )


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


def regressions(fit: Evidence, comparisons: Sequence[Comparison]) -> list[str]:
    """List the comparisons in which the calibrated robot is worse than the nominal one."""
    if not fit.errors.has_arm:
        return []
    # Hold-out samples with a mistake say nothing about the robot.
    judged = [c for c in comparisons if c.title != "hold-out" or not fit.holdout_mistake]
    return [
        f"The calibrated robot is worse than the nominal one {describe_samples(c)}. Keep the nominal robot, "
        "measure more poses, or identify fewer parameters."
        for c in judged
        if headline([c]).percent_reduction < 0
    ]


def describe_samples(comparison: Comparison) -> str:
    """Describe the samples of a comparison, such as "on 12 hold-out samples"."""
    count = comparison.n_samples
    if comparison.title == "region hold-out":
        return "on regions that were left out"
    return f"on {format_count(count, f'{comparison.title} sample')}"


def describe_sample_count(n_used: int, n_samples: int) -> str:
    """Describe the number of samples that a fit used, such as "60 samples" or "57 of 60 samples"."""
    used = "" if n_used == n_samples else f"{n_used} of "
    return f"{used}{format_count(n_samples, 'sample')}"


def small_sample_note(comparison: Comparison) -> str:
    """Return a note if a comparison has too few samples for a reliable figure, else an empty text."""
    return "So few samples give no reliable figure." if comparison.n_samples < MIN_SAMPLES else ""
