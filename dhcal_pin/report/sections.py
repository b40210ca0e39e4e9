"""Sections of the report: sentences and tables, and the figures that belong to them.

A new section is a function in this module that returns a `Section` and is listed in `report_sections`. If it
has figures, a function in `figures.py` draws them. The HTML page shows all of it. Markdown has no figures and
no bars.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from .. import formatting
from ..calibration import summary
from ..calibration.cross_validation import Generalization
from ..calibration.estimates import Estimate
from ..calibration.model_selection import trial_table
from ..diagnostics.curves import JointCurve, find_lattices
from ..diagnostics.residuals import median_sigmas
from ..diagnostics.workspace import RELATIVE_TEXT
from ..estimation import robust
from ..formatting import Table, format_fixed, format_quantity
from ..identifiability import label_unobservable
from ..io.origins_file import origin_table
from ..measurements.groups import ERROR_GROUPS, error_group
from ..robot.chain import BASE_FRAME
from . import figures, images
from .context import ReportContext
from .document import short_names, versions
from .figures import FigureGroup
from .samples import Samples, is_prismatic_joint

# The page folds parameters that change by at most this multiple of their standard deviations and whose
# standard deviations are at least this fraction of those before the measurement.
MAX_ZERO_CHANGE, MIN_ZERO_RATIO = 0.01, 0.99
# Samples with the largest errors that the table of samples lists without scripts.
MAX_LISTED_SAMPLES = 20
# A longer list of outliers is cut: the file as a whole is then more likely wrong than single rows.
MAX_OUTLIERS = 40
# Ranges of a joint that were not measured and are listed; the widest ones.
MAX_GAPS = 3


@dataclass(frozen=True)
class ShareBar:
    """Bar of a fraction.

    Attributes:
        share: Length of the bar, from 0 to 1.
    """

    share: float


@dataclass(frozen=True)
class IntervalBar:
    """Mark with an interval around it, on a scale from -1 to 1.

    Attributes:
        low: Lower end of the interval.
        middle: Position of the mark.
        high: Upper end of the interval.
    """

    low: float
    middle: float
    high: float


@dataclass(frozen=True)
class BarColumn:
    """Column of bars beside the numbers of a table.

    Attributes:
        title: Title of the column.
        bars: One bar per row; None leaves the cell empty.
    """

    title: str
    bars: Sequence[ShareBar | IntervalBar | None]


@dataclass(frozen=True)
class RowGroup:
    """Rows of a table that belong together.

    Attributes:
        title: Heading above the rows.
        rows: Indices of the rows.
    """

    title: str
    rows: Sequence[int]


@dataclass(frozen=True)
class BarTable(Table):
    """Table with columns of bars and groups of rows, which only the HTML page shows.

    Attributes:
        bars: The additional columns.
        groups: Groups of all rows; none if the rows are not grouped.
        unchanged: Indices of rows that the page folds, as they report no change.
    """

    bars: Sequence[BarColumn] = ()
    groups: Sequence[RowGroup] = ()
    unchanged: Sequence[int] = ()


@dataclass(frozen=True)
class Section:
    """Section of the report.

    Attributes:
        key: Identifier of the section on the page.
        title: Heading.
        sentences: Paragraphs.
        items: List below the paragraphs.
        tables: Tables below the list.
        figures: Draws the figures, at the end of the section; called for HTML only.
    """

    key: str
    title: str
    sentences: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Callable[[], Sequence[FigureGroup]] | None = None


def report_sections(context: ReportContext) -> list[Section]:
    """Return all sections of the report below its headline."""
    return [
        _accuracy_section(context),
        _image_section(context),
        _residual_section(context),
        _transmission_section(context),
        _joint_section(context),
        _workspace_section(context),
        Section("scene", "Nominal and calibrated robot", figures=partial(figures.scene_figures, context)),
        _parameter_section(context),
        _observability_section(context),
        _outlier_section(context),
        samples_section(context.samples),
        _provenance_section(context),
    ]


def warnings(context: ReportContext) -> list[str]:
    """Return what a reader must know before relying on the report."""
    fit, texts = context.fit, []
    texts += summary.regressions(fit.errors, context.comparisons)
    if not np.isfinite(fit.unit_weight_std):
        texts.append(
            f"{fit.sample_count} determine {fit.rank} directions in parameter space and leave no "
            "redundancy; the measurement noise and the parameter uncertainties cannot be estimated."
        )
    if context.outliers:
        count, n_rejected = len(context.outliers), max(c.n_rejected for c in fit.comparisons)
        texts.append(
            f"{count} {'outlier' if count == 1 else 'outliers'} among the samples, {n_rejected or 'none'} "
            "rejected; see the section on outliers."
        )
    return texts


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
    if generalization.region_holdout:
        sentences.append(_region_sentence(generalization))
        if generalization.region_holdout not in comparisons:
            comparisons.insert(1, generalization.region_holdout)
    return Section(
        "accuracy",
        "Accuracy",
        sentences,
        tables=[summary.accuracy_table(comparisons)],
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


def _image_section(context: ReportContext) -> Section:
    key, title = "images", "Images"
    if not images.has_images(context):
        return Section(key, title)
    stages, sentences, items = context.fit.camera_stages, [], []
    tables: list[Table] = []
    if stages:
        sentences.append(
            "Unknowns are freed in stages. Each stage is judged on images that its fit did not see: random "
            "ones, and whole regions of joint space. An error in mm is the distance of a corner of the board "
            "from the line of sight through its image."
        )
        items = [f"{stage.name}: {stage.reason}" for stage in stages if stage.reason]
        tables.append(images.stage_table(stages))
    hand_eye = context.fit.hand_eye
    if hand_eye is not None:
        likely = "" if hand_eye.is_noise else hand_eye.likely
        sentences += [f"{hand_eye.error_sentence}{likely}", *hand_eye.image_sentences]
        if hand_eye.trials:
            sentences.append(
                "The table of causes shows the error of left-out images if one thing more than the poses is "
                "estimated."
            )
        tables.append(hand_eye.table)
    tables.append(images.image_table(context))
    return Section(key, title, sentences, items, tables, partial(images.image_figures, context))


def _residual_section(context: ReportContext) -> Section:
    key, title = "residuals", "Residual errors"
    profiles = context.joint_profiles
    if not profiles:
        return Section(key, title, figures=partial(figures.residual_figures, context))
    rows = []
    for profile in profiles:
        if not len(profile.centres):
            continue
        unit = "m" if profile.is_prismatic else "rad"
        worst = int(np.nanargmax(np.abs(profile.after)))
        std, centre = float(profile.after_std[worst]), float(profile.centres[worst])
        values = (float(np.nanmax(np.abs(profile.before))), float(profile.after[worst]), std)
        position = f"{1e3 * centre:.0f} mm" if profile.is_prismatic else f"{np.degrees(centre):.0f}°"
        rows.append(
            [profile.name, *(format_quantity(value, unit, std, small=True) for value in values), position]
        )
    if not rows:
        sentences = ["There are too few samples to estimate joint errors over the range of the joints."]
        return Section(key, title, sentences, figures=partial(figures.residual_figures, context))
    role = "hold-out" if context.fit.holdout else "fitted"
    text = (
        "For each part of a joint's range, the table shows the error of that joint alone that best "
        f"explains the residuals of the {role} samples. Scatter around zero is noise. A periodic pattern "
        "indicates an unmodelled error such as gear eccentricity, joint elasticity or backlash."
    )
    if unknown := [profile.name for profile in profiles if not len(profile.centres)]:
        text += f" No estimate for {', '.join(unknown)}: too few samples, or the joint hardly moves the tool."
    table = Table(["joint", "largest before", "largest after", "std", "at"], rows)
    return Section(key, title, [text], tables=[table], figures=partial(figures.residual_figures, context))


def _transmission_section(context: ReportContext) -> Section:
    key, title, extension = "transmission", "Transmission errors", context.fit.extension
    if extension is None or not context.fit.errors.has_arm:
        hint = context.source.hint
        return Section(key, title, [f"{hint[0].upper()}{hint[1:]}."] if hint else [])
    text = (
        "Each family is tried in addition to those added before. Errors are those of random left-out "
        "samples, in standard deviations, without and with the family. A family is added if the evidence "
        "rises and this error falls. The prior width is the standard deviation of greatest evidence."
    )
    tables = [trial_table(extension.trials)] if extension.trials else []
    return Section(key, title, [*extension.sentences, *([text] if tables else [])], tables=tables)


def _joint_section(context: ReportContext) -> Section:
    """Return the correction curves of the joints, or which joint values were measured if there are none."""
    curves = {curve.coverage.joint: curve for curve in context.joint_curves}
    coverage = context.coverage
    header = ["joint", "not measured", "bins visited"]
    rows = [[c.joint, _format_gaps(c.gaps), f"{c.n_visited} of {c.n_in_range}"] for c in coverage]
    bins = "A bin is 5° wide and counts as visited if one configuration lies in it."
    if curves:
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
        items = [f"{text[:1].upper()}{text[1:]}." for text in find_lattices(context.fit)]
    else:
        items = []
        title = "Measured joint values"
        sentences = [
            f"Errors of a joint are extrapolated to joint values that were not measured. {bins}",
        ]
    bars = [BarColumn("share", [ShareBar(c.share) for c in coverage])]
    table = BarTable(header, rows, n_text_columns=2, bars=bars)
    tables = [table] if rows else []
    return Section(
        "joints",
        title,
        sentences if rows else [],
        items,
        tables,
        figures=partial(figures.joint_curve_figures, context),
    )


def _format_gaps(gaps: Sequence[tuple[float, float]]) -> str:
    """List the widest ranges of joint values that were not measured, in their order."""
    widest = sorted(gaps, key=lambda gap: gap[0] - gap[1])[:MAX_GAPS]
    texts = [
        f"{np.degrees(low):g}° to {np.degrees(high):g}°".replace("-", "−") for low, high in sorted(widest)
    ]
    if n_hidden := len(gaps) - len(widest):
        texts.append(f"{n_hidden} more")
    return ", ".join(texts) or "–"


def _curve_cells(curve: JointCurve | None) -> list[str]:
    """Return the largest correction of a joint, and the median std at measured and at other values."""
    if curve is None:
        return ["", "", ""]
    is_measured = curve.is_measured
    cells = [_format_small(float(np.max(np.abs(curve.correction[is_measured]), initial=0.0)))]
    for chosen in (is_measured, ~is_measured):
        cells.append(_format_small(float(np.median(curve.std[chosen]))) if chosen.any() else "–")
    return cells


def _format_small(angle: float) -> str:
    return format_quantity(angle, "rad", angle / 10, small=True)


def _workspace_section(context: ReportContext) -> Section:
    workspace, fit = context.workspace, context.fit
    if not fit.errors.parameters or (fit.has_free_frames and not fit.errors.has_arm):
        # Nothing that matters to the tool is uncertain.
        return Section("workspace", "Predicted accuracy in the workspace")
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
    sentences = [
        "Standard deviation of the tool position that follows from the uncertainty of the parameters, for "
        "configurations drawn within the joint limits (revolute joints at most half a turn each way). It "
        "grows with the distance from the measured samples. Unmodelled errors come in addition; the error "
        "on hold-out or cross-validated samples includes them."
    ]
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
                "" if e.fixed else format_quantity(e.prior, e.unit, e.prior, small=True),
                "" if e.fixed else f"{e.observability:.2f}",
            ]
            for row, e in zip(table.rows, estimates, strict=True)
        ]
        header, *rows = [[text for i, text in enumerate(row) if i not in hidden] for row in [header, *rows]]
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


def _estimate_groups(estimates: Sequence[Estimate]) -> list[RowGroup]:
    """Group the rows of parameters by the joint, frame or instrument that their names begin with."""
    rows: dict[str, list[int]] = {}
    for i, e in enumerate(estimates):
        owner, dot, _ = e.name.partition(".")
        # Names of Denavit-Hartenberg parameters end with the number of their row.
        row = re.search(r"\d+$", e.name)
        rows.setdefault(owner if dot else f"DH row {row[0]}" if row else "other", []).append(i)
    return [RowGroup(title, numbers) for title, numbers in rows.items()]


def _is_unchanged(e: Estimate) -> bool:
    """Return whether a parameter keeps its nominal value because the measurements say nothing about it."""
    if e.fixed or not math.isfinite(e.std):
        return e.category == "robot" and e.change == 0
    return abs(e.change) <= MAX_ZERO_CHANGE * e.std and e.posterior_to_prior_std >= MIN_ZERO_RATIO


def _estimate_bars(estimates: Sequence[Estimate]) -> list[BarColumn]:
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

    columns = [BarColumn("change ± 2 std", [interval(e) for e in estimates])] if scale else []
    shares = [None if e.fixed else ShareBar(e.observability) for e in estimates]
    return [*columns, BarColumn("0 to 1", shares)]


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
        *(label_unobservable(text) for text in fit.unobservable),
        *(f"poorly identified: {text}" for text in fit.weakly_observable),
    ]
    return Section(
        "observability",
        "Observability",
        sentences,
        items,
        figures=partial(figures.observability_figures, context),
    )


def _outlier_section(context: ReportContext) -> Section:
    names, rows = context.data_names, []
    for outlier in context.outliers[:MAX_OUTLIERS]:
        errors = ", ".join(
            format_quantity(value, ERROR_GROUPS[group].unit, value / 10, small=True)
            for group, value in outlier.error_norms.items()
        )
        rows.append([names[outlier.item], str(outlier.row), errors, f"{outlier.score:.0f}"])
    threshold = f"{robust.OUTLIER_THRESHOLD:g}"
    if rows:
        n_hidden = len(context.outliers) - len(rows)
        text = (
            f"Rejected samples, and fitted samples whose standardized residual exceeds {threshold}; a "
            "normally distributed one does so once in three million."
            + (f" {n_hidden} more are not listed." if n_hidden else "")
        )
    else:
        text = f"No fitted sample has a standardized residual above {threshold}."
    items = [
        f"{name}, line {row}: not used, {reason}"
        for name, reasons in context.source.excluded_rows.items()
        for row, reason in reasons.items()
    ]
    items += [f"{name}: {text}" for name, texts in context.source.notes.items() for text in texts]
    items += [f"{name}: warning: {text}" for name, texts in context.source.warnings.items() for text in texts]
    table = Table(["file", "line", "error", "score"], rows)
    return Section("outliers", "Outliers", [text], items, [table] if rows else [])


def samples_section(samples: Samples, title: str = "Samples") -> Section:
    """List the samples with the largest errors; scripts of the page make it a list of all samples."""
    groups = {
        group: states["after"]
        for group, states in samples.errors.items()
        if np.isfinite(states["after"]).any()
    }
    largest = np.arange(len(samples))
    text = f"The first {min(len(samples), MAX_LISTED_SAMPLES)} of {len(samples)}."
    if groups:
        first = next(iter(groups.values()))
        largest = np.argsort(-np.nan_to_num(first, nan=-1.0), kind="stable")
        label = ERROR_GROUPS[next(iter(groups))].label
        text = f"The {min(len(samples), MAX_LISTED_SAMPLES)} samples with the largest {label}."
    shown = largest[:MAX_LISTED_SAMPLES]
    joints = samples.chain.joint_names
    rows = [
        [
            samples.file[i],
            str(samples.line[i]),
            samples.role[i] + (", outlier" if samples.is_outlier[i] else ""),
            *(
                format_quantity(
                    float(samples.q[i, j]), "m" if is_prismatic_joint(samples.chain, j) else "rad"
                )
                for j in range(len(joints))
            ),
            *(
                format_quantity(float(errors[i]), ERROR_GROUPS[group].unit, float(errors[i]) / 10, small=True)
                for group, errors in groups.items()
            ),
        ]
        for i in shown
    ]
    header = ["file", "line", "set", *joints, *(ERROR_GROUPS[group].label for group in groups)]
    sentences = [text, *filter(None, [samples.note])]
    return Section("samples", title, sentences, tables=[Table(header, rows)] if rows else [])


def _provenance_section(context: ReportContext) -> Section:
    tables = [
        _data_table(context),
        Table(["choice", "value"], _choices(context), n_text_columns=2),
        _hash_table(context),
        Table(["software", "version"], [list(pair) for pair in versions().items()], n_text_columns=2),
    ]
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
            f"{group} {format_quantity(value, ERROR_GROUPS[error_group(group)].unit, value, small=True)}"
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
    state = "converged" if fit.converged else "not converged"
    priors = (
        "normal with nominal mean, standard deviations in the tables above; wide for frames and instruments"
    )
    return [
        *choices,
        ["method", {"lm": "Levenberg-Marquardt", "gn": "Gauss-Newton as in the paper"}[fit.method]],
        ["state", f"{state} after {fit.iterations} iterations"],
        ["priors", priors if np.any(fit.problem.weights) else "none"],
        *([name, text] for name, text in source.settings.items()),
    ]


def _hash_table(context: ReportContext) -> Table:
    short = short_names(list(context.source.inputs))
    rows = [[short[path], digest] for path, digest in context.source.inputs.items()]
    return Table(["file", "SHA-256"], rows, n_text_columns=2)


def markdown(context: ReportContext) -> str:
    """Render the report as Markdown, without figures."""
    head = summary.headline(context.comparisons)
    verdict = context.fit.verdict
    escape = formatting.escape_markdown
    parts = [
        f"# Calibration of {escape(context.robot_name)}",
        f"**Verdict: {verdict.status}**",
        *map(escape, verdict.reasons),
        f"**{escape(head.text)}**",
        *map(escape, context.source.remarks),
        *map(escape, context.generalization_lines),
        *map(escape, warnings(context)),
    ]
    for section in report_sections(context):
        blocks = [*map(escape, section.sentences)]
        if section.items:
            blocks.append("\n".join(f"- {escape(item)}" for item in section.items))
        for table in section.tables:
            blocks += [f"**{escape(table.caption)}**"] if table.caption else []
            blocks.append(formatting.markdown_table(table))
        parts += [f"## {section.title}", *blocks] if blocks else []
    return "\n\n".join(parts) + "\n"
