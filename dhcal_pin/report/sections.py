"""Sections of a calibration: functions that make them, and the table of what shows which.

A new section is a function in this module and a row of `SECTIONS`. The function returns the section, or None
if there is nothing to say. Its figures are made by another function, which only renderings with figures call.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from ..calibration import summary
from ..calibration.cross_validation import Generalization
from ..calibration.estimates import Estimate
from ..calibration.model_selection import trial_table
from ..calibration.presentation.budget import UncertaintyBudget
from ..calibration.presentation.curves import JointCurve, find_lattices, fitted_coverage
from ..calibration.presentation.workspace import RELATIVE_TEXT
from ..diagnostics.residuals import median_sigmas
from ..estimation import robust
from ..formatting import Quantity, Table, capitalized, format_fixed, texts_by_file
from ..identifiability import EXPECTED
from ..io.origins_file import origin_table
from ..measurements.groups import ERROR_GROUPS, error_group
from ..robot.chain import BASE_FRAME
from . import figures, images, samples
from .context import ReportContext
from .document import BarTable, IntervalBar, Section
from .provenance import origin_tables

# The page folds parameters that change by at most this multiple of their standard deviations and whose
# standard deviations are at least this fraction of those before the measurement.
MAX_ZERO_CHANGE, MIN_ZERO_RATIO = 0.01, 0.99
# A longer list of outliers is cut: the file as a whole is then more likely wrong than single rows.
MAX_OUTLIERS = 40
# Ranges of a joint that were not measured and are listed; the widest ones.
MAX_GAPS = 3
# Largest corrections that a certificate lists.
MAX_CORRECTIONS = 8

Rendering = Literal["html", "markdown", "terminal", "certificate"]


def _accuracy_section(context: ReportContext) -> Section:
    frames = {e.name.split(".")[0] for e in context.fit.estimates if e.category == "frame" and not e.fixed}
    fitted = f" with its {' and '.join(sorted(frames))} fitted to the same measurements" if frames else ""
    comparisons, generalization = list(context.comparisons), context.fit.generalization
    sentences = [
        f"“Before” is the nominal robot{fitted}. The difference between before and after is therefore "
        "due to the robot parameters alone."
    ]
    if not context.fit.errors.has_arm:
        sentences = [
            "No parameter of the arm was estimated: before and after are errors of the same arm, with frames "
            "and instruments fitted in both."
        ]
    sentences.append("All errors contain the noise of the instrument.")
    if generalization.region_holdout:
        sentences.append(_region_sentence(generalization))
        if generalization.region_holdout not in comparisons:
            comparisons.insert(1, generalization.region_holdout)
    by_file = summary.file_table(context.data_names, context.fit.file_comparisons)
    return Section(
        "accuracy",
        "Accuracy",
        sentences,
        tables=[summary.accuracy_table(comparisons), *([by_file] if by_file else [])],
        figures=partial(figures.accuracy_figures, context),
    )


def _region_sentence(generalization: Generalization) -> str:
    """Explain what the error of left-out regions means, and where it holds."""
    covered, reached = generalization.covered_share, generalization.reached_share
    if covered is None or reached is None:
        return (
            "“Region hold-out” samples are the ends of the measured poses along each principal direction of "
            "their positions and angles; each end is judged by a fit of the other samples."
        )
    return (
        "“Region hold-out” samples are the ends of the measured region along each principal direction of the "
        "joint values; each end is judged by a fit of the other samples. Their error holds for "
        f"{summary.format_share(reached)} of the joint space: where a configuration is no farther from the "
        "measured ones than these ends are from the others. The measured region itself is "
        f"{summary.format_share(covered)} of the joint space. Nothing is known about the accuracy in the "
        "rest."
    )


def _session_section(context: ReportContext) -> Section | None:
    """Return what happened during the measurement; None if this was not examined."""
    session = context.fit.session
    if session is None:
        return None
    if not session.sentences:
        order = (
            "the order of their lines" if session.is_ordered else "files alone, without an order of the lines"
        )
        text = f"The samples were examined in {order}. No event, drift, lag or wrong scale was found."
        return Section("session", "Session", [text])
    return Section("session", "Session", session.sentences, figures=partial(figures.session_figures, context))


def _signs_section(context: ReportContext) -> Section | None:
    """Return which joints turn the other way; None if this was not examined."""
    signs = context.fit.signs
    if signs is None:
        return None
    note = signs.note or "all joints turn as in the URDF"
    return Section("signs", "Signs of the joints", [f"{capitalized(note)}.", *signs.questions])


def _residual_section(context: ReportContext) -> Section:
    rows, sentences, profiles = [], [], context.joint_profiles
    for profile in profiles:
        if not len(profile.centres):
            continue
        unit = "m" if profile.is_prismatic else "rad"
        worst = int(np.nanargmax(np.abs(profile.after)))
        std, centre = float(profile.after_std[worst]), float(profile.centres[worst])
        values = (float(np.nanmax(np.abs(profile.before))), float(profile.after[worst]), std)
        position = f"{1e3 * centre:.0f} mm" if profile.is_prismatic else f"{np.degrees(centre):.0f}°"
        rows.append(
            [profile.name, *(Quantity(value, unit, std, is_small=True) for value in values), position]
        )
    if rows:
        role = "hold-out" if context.fit.holdout else "fitted"
        text = (
            "For each part of a joint's range, the table shows the error of that joint alone that best "
            f"explains the residuals of the {role} samples. Scatter around zero is noise. A periodic pattern "
            "indicates an unmodelled error such as gear eccentricity, joint elasticity or backlash."
        )
        if unknown := [profile.name for profile in profiles if not len(profile.centres)]:
            text += (
                f" No estimate for {', '.join(unknown)}: too few samples, or the joint hardly moves the tool."
            )
        sentences = [text]
    elif profiles:
        sentences = ["There are too few samples to estimate joint errors over the range of the joints."]
    return Section(
        "residuals",
        "Residual errors",
        sentences,
        tables=[Table(["joint", "largest before", "largest after", "std", "at"], rows)] if rows else [],
        figures=partial(figures.residual_figures, context),
    )


def _transmission_section(context: ReportContext) -> Section:
    extension, hint = context.fit.extension, context.source.hint
    if extension is None or not context.fit.errors.has_arm:
        sentences, tables = [f"{capitalized(hint)}."] if hint else [], []
    else:
        text = (
            "Each family is tried in addition to those added before. Errors are those of random left-out "
            "samples, in standard deviations, without and with the family. A family is added if the evidence "
            "rises and this error falls. The prior width is the standard deviation of greatest evidence."
        )
        tables = [trial_table(extension.trials)] if extension.trials else []
        sentences = [*extension.sentences, *([text] if tables else [])]
    return Section("transmission", "Transmission errors", sentences, tables=tables)


def _joint_section(context: ReportContext) -> Section | None:
    """Return the correction curves of the joints, or which joint values were measured if there are none."""
    coverage = fitted_coverage(context.fit)
    if not coverage:
        return None
    header = ["joint", "not measured", "bins visited"]
    rows: list[list[str | Quantity]] = [
        [c.joint, _format_gaps(c.gaps), f"{c.n_visited} of {c.n_in_range}"] for c in coverage
    ]
    bins = "A bin is 5° wide and counts as visited if one configuration lies in it."
    title, items = "Measured joint values", []
    sentences = [f"Errors of a joint are extrapolated to joint values that were not measured. {bins}"]
    if curves := {curve.coverage.joint: curve for curve in context.joint_curves}:
        title = "Joint correction curves"
        sentences = [
            "The angle to add to a joint value before it is commanded, as far as it depends on that joint "
            "alone and repeats with every turn.",
            "A curve is known where joint values were measured. In the other ranges it continues harmonics "
            f"that were fitted elsewhere, and its band is wide. {bins} The table has the largest correction "
            "at measured joint values, and the median standard deviation at measured and at other ones.",
        ]
        header += ["largest correction", "std, measured", "std, other"]
        rows = [row + _curve_cells(curves.get(c.joint)) for row, c in zip(rows, coverage, strict=True)]
        items = [f"{capitalized(text)}." for text in find_lattices(context.fit)]
    bars = {"share": [c.share for c in coverage]}
    table = BarTable(header, rows, n_text_columns=2, bars=bars)
    draw = partial(figures.joint_curve_figures, context)
    return Section("joints", title, sentences, items, [table], draw)


def _format_gaps(gaps: Sequence[tuple[float, float]]) -> str:
    """List the widest ranges of joint values that were not measured, in their order."""
    widest = sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MAX_GAPS]
    texts = [
        f"{np.degrees(low):g}° to {np.degrees(high):g}°".replace("-", "−") for low, high in sorted(widest)
    ]
    if n_hidden := len(gaps) - len(widest):
        texts.append(f"{n_hidden} more")
    return ", ".join(texts) or "–"


def _curve_cells(curve: JointCurve | None) -> list[str | Quantity]:
    """Return the largest correction of a joint, and the median std at measured and at other values."""
    if curve is None:
        return ["", "", ""]
    is_measured = curve.is_measured
    largest = float(np.max(np.abs(curve.correction[is_measured]), initial=0.0))
    medians = [
        Quantity.error(float(np.median(curve.std[chosen])), "rad") if chosen.any() else "–"
        for chosen in (is_measured, ~is_measured)
    ]
    return [Quantity.error(largest, "rad"), *medians]


def _workspace_section(context: ReportContext) -> Section | None:
    fit = context.fit
    if not fit.errors.parameters or (fit.has_free_frames and not fit.errors.has_arm):
        # Nothing that matters to the tool is uncertain.
        return None
    workspace = context.workspace
    is_known = np.isfinite(workspace.std)
    rows = []
    for title, std in (
        ("everywhere within the joint limits", workspace.std),
        ("at the fitted samples", workspace.measured_std),
    ):
        if len(std):
            finite = std[np.isfinite(std)]
            cells = [
                format_fixed(1e3 * float(np.quantile(finite, fraction)), 3) if finite.size else "–"
                for fraction in (0.05, 0.5, 0.95, 1)
            ]
            rows.append([title, *cells, f"{100 * (1 - finite.size / len(std)):.0f} %"])
    has_model_errors = any(fit.uncertainty.model_std)
    cause = " and from the errors that the model lacks, which the residuals show" if has_model_errors else ""
    sentences = [
        "Standard deviation of the tool position that follows from the uncertainty of the parameters"
        f"{cause}, for configurations drawn within the joint limits (revolute joints at most half a turn "
        "each way). It grows with the distance from the measured samples."
    ]
    if not has_model_errors:
        sentences.append(
            "Unmodelled errors come in addition; the error on hold-out or cross-validated samples includes "
            "them."
        )
    if not is_known.any():
        sentences = [
            "The accuracy cannot be predicted: the measurements do not determine the tool position and no "
            "prior limits it, or there are too few measurements to estimate their noise."
        ]
    elif not is_known.all():
        sentences.append(
            "At some configurations it cannot be predicted, because the measurements do not determine the "
            "tool position there."
        )
    if fit.has_free_frames and is_known.any():
        sentences.append(RELATIVE_TEXT)
    header = [
        "predicted position std, mm",
        "5th percentile",
        "median",
        "95th percentile",
        "largest",
        "not predictable",
    ]
    return Section(
        "workspace",
        "Predicted accuracy in the workspace",
        sentences,
        tables=[Table(header, rows)],
        figures=partial(figures.workspace_figures, context),
    )


def _parameter_section(context: ReportContext) -> Section:
    tables = []
    # Columns of a frame or instrument that mean nothing: nominal value and change of a frame, priors of both.
    for category, title, hidden in (
        ("robot", "Robot", ()),
        ("frame", "Robot base and tool", (1, 3, 5)),
        ("instrument", "Instruments", (5,)),
    ):
        if not (estimates := [e for e in context.fit.estimates if e.category == category]):
            continue
        table = summary.estimate_table(estimates)
        header = [*table.header, "prior std", "observability"]
        rows = [
            [
                *row,
                "" if e.fixed else Quantity(e.prior, e.unit, e.prior, is_small=True),
                "" if e.fixed else f"{e.observability:.2f}",
            ]
            for row, e in zip(table.rows, estimates, strict=True)
        ]
        header, *rows = [[cell for i, cell in enumerate(row) if i not in hidden] for row in [header, *rows]]
        tables.append(
            BarTable(
                header,
                rows,
                caption=title,
                bars=_estimate_bars(estimates),
                groups=_estimate_groups(estimates),
                unchanged=[i for i, e in enumerate(estimates) if _is_unchanged(e)],
            )
        )
    text = (
        "Observability is the fraction of a parameter that the measurements alone determine, from 0 "
        "(nothing) to 1 (all). Below 1, other parameters have partly the same effect on the measurements; "
        "the priors then decide how the effect is shared between them."
    )
    if (origins := origin_table(context.fit.chain)).rows:
        tables.append(replace(origins, caption="Joint origins in the URDF, m and rad"))
    tables.append(replace(summary.definition_table(context.fit.estimates), caption="Frames"))
    note = (
        "At a pitch near ±90°, roll and yaw of an origin can change much more than the origin turns; the "
        "column “moved” has the angle of the turn."
    )
    return Section("parameters", "Parameters", [text, summary.DEFINITION_TEXT, note], tables=tables)


def _estimate_groups(estimates: Sequence[Estimate]) -> dict[str, list[int]]:
    """Group the rows of parameters by the joint, frame or instrument that their names begin with."""
    rows: dict[str, list[int]] = {}
    for i, e in enumerate(estimates):
        owner, dot, _ = e.name.partition(".")
        # Names of Denavit-Hartenberg parameters end with the number of their row.
        row = re.search(r"\d+$", e.name)
        rows.setdefault(owner if dot else f"DH row {row[0]}" if row else "other", []).append(i)
    return rows


def _is_unchanged(e: Estimate) -> bool:
    """Return whether a parameter keeps its nominal value because the measurements say nothing about it."""
    if e.fixed or not math.isfinite(e.std):
        return e.category == "robot" and e.change == 0
    return abs(e.change) <= MAX_ZERO_CHANGE * e.std and e.posterior_to_prior_std >= MIN_ZERO_RATIO


def _estimate_bars(estimates: Sequence[Estimate]) -> dict[str, list[float | IntervalBar | None]]:
    """Return bars of the change with two standard deviations (one scale per unit) and of observability."""
    scale: dict[str, float] = {}
    for e in estimates:
        if math.isfinite(e.change):
            # A parameter that is known much worse than it changed does not set the scale.
            spread = 2 * min(e.std if math.isfinite(e.std) else 0.0, 3 * abs(e.change) + 1e-12)
            scale[e.unit] = max(scale.get(e.unit, 0.0), abs(e.change) + spread)

    def interval(e: Estimate) -> IntervalBar | None:
        if e.fixed or not math.isfinite(e.change) or not math.isfinite(e.std):
            return None
        ends = (e.change - 2 * e.std, e.change, e.change + 2 * e.std)
        relative = (value / scale[e.unit] if scale[e.unit] > 0 else 0.0 for value in ends)
        return IntervalBar(*(max(-1.0, min(1.0, value)) for value in relative))

    columns: dict[str, list[float | IntervalBar | None]] = {}
    if scale:
        columns["change ± 2 std"] = [interval(e) for e in estimates]
    columns["0 to 1"] = [None if e.fixed else e.observability for e in estimates]
    return columns


def _observability_section(context: ReportContext) -> Section:
    fit = context.fit
    sentences = [
        f"The measurements determine {fit.rank} of {len(fit.parameters)} directions in parameter space. "
        f"The condition number of these directions is {fit.condition:.3g}.",
        "Some parameters are determined only in combination; their single values depend on the priors."
        if fit.unobservable
        else "All parameters are observable.",
    ]
    if fixed := [e.name for e in fit.estimates if e.fixed]:
        sentences.append(f"Fixed at their nominal values and not assessed: {', '.join(fixed)}.")
    items = [
        *fit.shrinkage_notes,
        *summary.parameter_notes(fit.unobservable, fit.weakly_observable),
    ]
    draw = partial(figures.observability_figures, context)
    return Section("observability", "Observability", sentences, items, figures=draw)


def _outlier_section(context: ReportContext) -> Section:
    names, rows = (*context.data_names, *context.holdout_names), []
    for outlier in context.outliers[:MAX_OUTLIERS]:
        errors = ", ".join(
            str(Quantity.error(value, ERROR_GROUPS[group].unit))
            for group, value in outlier.error_norms.items()
        )
        score = "held out" if math.isnan(outlier.score) else f"{outlier.score:.0f}"
        rows.append([names[outlier.item], str(outlier.row), errors, score])
    threshold = f"{robust.OUTLIER_THRESHOLD:g}"
    if rows:
        n_hidden = len(context.outliers) - len(rows)
        text = (
            f"Rejected samples, and samples whose standardized residual exceeds {threshold}; a normally "
            "distributed one does so once in three million. No figure of the accuracy contains them."
            + (f" {n_hidden} more are not listed." if n_hidden else "")
        )
    else:
        text = f"No sample has a standardized residual above {threshold}."
    items = [
        f"{name}, line {row}: not used, {reason}"
        for name, reasons in context.source.excluded_rows.items()
        for row, reason in reasons.items()
    ]
    items += texts_by_file(context.source.notes)
    items += texts_by_file(context.source.warnings, "warning: ")
    table = Table(["file", "line", "error", "score"], rows)
    return Section("outliers", "Outliers", [text], items, [table] if rows else [])


def _scene_section(context: ReportContext) -> Section:
    draw = partial(figures.scene_figures, context)
    return Section("scene", "Nominal and calibrated robot", figures=draw)


def _provenance_section(context: ReportContext) -> Section:
    choices = Table(["choice", "value"], _choices(context), n_text_columns=2)
    tables = [_data_table(context), choices, *origin_tables(context.source.inputs)]
    return Section("provenance", "Provenance", tables=[table for table in tables if table.rows])


def _data_table(context: ReportContext) -> Table:
    fit = context.fit
    n_holdout = dict.fromkeys(context.data_names, 0)
    for name, item in zip(context.holdout_names, fit.holdout, strict=True):
        n_holdout[name] = n_holdout.get(name, 0) + len(item.rows)
    rows = []
    for name, item, sigma in zip(context.data_names, fit.data, median_sigmas(fit), strict=True):
        origin = "stated" if item.has_stated_sigma else ("estimated" if fit.method == "lm" else "assumed")
        values = ", ".join(
            f"{group} {Quantity(value, ERROR_GROUPS[error_group(group)].unit, value, is_small=True)}"
            for group, value in sigma.items()
        )
        rows.append(
            [name, item.kind, f"{values}, {origin}", str(len(item.rows)), str(n_holdout.pop(name, 0))]
        )
    rows += [[name, "", "", "0", str(count)] for name, count in n_holdout.items()]
    return Table(
        ["data", "kind", "standard deviation per axis", "fitted", "hold-out"], rows, n_text_columns=3
    )


def _choices(context: ReportContext) -> list[list[str]]:
    """Return names and values of the choices that led to the result."""
    fit, source = context.fit, context.source
    choices = [
        ["robot", f"{context.robot_name}, tip {fit.chain.tip}, joints {', '.join(fit.chain.joint_names)}"]
    ]
    if source.command:
        choices.append(["command", source.command])
    free = {e.name for e in fit.estimates if not e.fixed}
    for name, error_frame in (("base", BASE_FRAME), ("tool", fit.chain.tool_frame_index)):
        count = sum(p.error_frame == error_frame and p.name in free for p in fit.errors.parameters)
        choices.append([name, f"{count} of 6 components estimated" if count else "as given"])
    if fixed := [e.name for e in fit.estimates if e.fixed]:
        choices.append(["fixed", ", ".join(fixed)])
    priors = (
        "normal with nominal mean, standard deviations in the tables above; wide for frames and instruments"
    )
    return [
        *choices,
        ["method", {"lm": "Levenberg-Marquardt", "gn": "Gauss-Newton as in the paper"}[fit.method]],
        ["state", summary.describe_convergence(fit.converged, fit.iterations)],
        ["priors", priors if np.any(fit.problem.weights) else "none"],
        *([name, text] for name, text in source.settings.items()),
    ]


# --- terminal and certificate ----------------------------------------------------------------------


def _numbers_section(context: ReportContext) -> Section:
    """Return accuracy, joint origins and parameters as tables, below what was added to the geometry."""
    fit = context.fit
    tables = [
        replace(summary.accuracy_table(fit.comparisons), caption="accuracy"),
        replace(origin_table(fit.chain), caption="joint origins in the URDF, in m and rad"),
        replace(summary.estimate_table(fit.estimates), caption="parameters"),
    ]
    families = fit.extension.sentences if fit.extension and fit.errors.has_arm else []
    return Section("numbers", "", families, tables=tables)


def _definition_section(context: ReportContext) -> Section:
    table = summary.definition_table(context.fit.estimates)
    return Section("definitions", "", [summary.DEFINITION_TEXT], tables=[table])


def _state_section(context: ReportContext) -> Section:
    fit = context.fit
    state = summary.describe_convergence(fit.converged, fit.iterations)
    sentences = [
        f"{state}; {fit.sample_count}; "
        f"rank {fit.rank} of {len(fit.parameters)}; condition {fit.condition:.3g}",
        *(text for text in fit.unobservable if text.startswith(EXPECTED)),
    ]
    return Section("state", "", sentences)


def _certificate_section(context: ReportContext) -> Section:
    """Return the accuracy, the uncertainty budget and the largest corrections."""
    text = (
        "“Before” is the nominal robot with base and tool fitted to the same measurements, if they are "
        "unknown."
    )
    fit = context.fit
    changed = summary.largest_corrections(fit.estimates, fit.x, fit.solution.system)
    rows = [
        [e.name, e.frame, Quantity(e.change, e.unit, e.std, is_small=True), e.certainty]
        for e in changed[:MAX_CORRECTIONS]
    ]
    n_hidden = len(changed) - len(rows)
    caption = "Largest corrections" + (f" ({n_hidden} more in the report)" if n_hidden > 0 else "")
    corrections = Table(["parameter", "frame", "change", "standard deviation"], rows, 2, caption)
    stated = context.comparisons[0]
    budget = UncertaintyBudget.from_fit(fit, stated)
    tables = [
        summary.accuracy_table(context.comparisons),
        *([budget.table(stated.title)] if budget else []),
        *([corrections] if rows else []),
    ]
    return Section("accuracy", "Accuracy before and after", [text], tables=tables)


# --- table of the sections -------------------------------------------------------------------------


_REPORT: Sequence[Rendering] = ("html", "markdown")

# Functions of the sections in their order, and the renderings that show each. The terminal shows its sections
# with --verbose.
SECTIONS: Sequence[tuple[Callable[[ReportContext], Section | None], Sequence[Rendering]]] = (
    (_accuracy_section, _REPORT),
    (images.image_section, _REPORT),
    (_session_section, _REPORT),
    (_signs_section, _REPORT),
    (_residual_section, _REPORT),
    (_transmission_section, _REPORT),
    (_joint_section, _REPORT),
    (_workspace_section, _REPORT),
    (_scene_section, _REPORT),
    (_parameter_section, _REPORT),
    (_observability_section, _REPORT),
    (_outlier_section, _REPORT),
    (lambda context: samples.samples_section(context.samples), _REPORT),
    (_provenance_section, _REPORT),
    (_numbers_section, ("terminal",)),
    (_definition_section, ("terminal",)),
    (_state_section, ("terminal",)),
    (_certificate_section, ("certificate",)),
)


def sections_of(context: ReportContext, rendering: Rendering) -> list[Section]:
    """Return the sections that a rendering shows."""
    made = (section(context) for section, renderings in SECTIONS if rendering in renderings)
    return [section for section in made if section is not None]
