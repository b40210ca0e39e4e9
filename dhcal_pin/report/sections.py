"""The report as a person reads it: sections of sentences and tables, and their Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import formatting
from ..calibration import summary
from ..calibration.evaluation import Comparison
from ..calibration.model_selection import trial_table
from ..calibration.result import Result
from ..diagnostics.residuals import (
    JointProfile,
    Outlier,
    Workspace,
    joint_offset_profiles,
    outliers,
    sigmas,
    workspace,
)
from ..estimation import robust
from ..formatting import Table, format_fixed, format_quantity
from ..robot.chain import BASE_FRAME
from .document import Provenance, short_names, versions

# A longer list of outliers is cut: its file is to be looked at, not its rows.
MAX_OUTLIERS = 40


@dataclass(frozen=True, eq=False)
class ReportContext:
    """A result and everything that is computed for its report, once."""

    fit: Result
    source: Provenance
    outliers: Sequence[Outlier]
    joint_profiles: Sequence[JointProfile]
    workspace: Workspace

    @property
    def names(self) -> list[str]:
        """What each item of the fitted data is called."""
        return _names(self.source.names, [item.kind for item in self.fit.data])

    @property
    def holdout_names(self) -> list[str]:
        """What each item held out is called."""
        return _names(self.source.holdout_names, [item.kind for item in self.fit.holdout])

    @property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after, the most honest first."""
        judged, own = self.source.comparison, self.fit.comparisons
        return (judged, *(c for c in own if c.title == "fitted")) if judged and not self.fit.holdout else own

    @property
    def robot(self) -> str:
        """The robot's own name."""
        return self.fit.chain.model.name or "robot"


def _names(given: Sequence[str], kinds: Sequence[str]) -> list[str]:
    if len(given) == len(kinds):
        short = short_names(given)
        return [short[name] for name in given]
    return [f"{kind} measurements {i}" for i, kind in enumerate(kinds, 1)]


def report_context(fit: Result, source: Provenance) -> ReportContext:
    """Everything that the report of a result needs."""
    return ReportContext(fit, source, outliers(fit), joint_offset_profiles(fit), workspace(fit, fit.data))


@dataclass(frozen=True)
class Section:
    """A heading with sentences, a list and tables; `key` says where a page puts which figures."""

    key: str
    title: str
    sentences: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[Table] = ()


def sections(found: ReportContext) -> list[Section]:
    """The whole report below its headline."""
    return [
        _accuracy(found),
        _residual_section(found),
        _extension(found),
        _workspace(found),
        Section("scene", "The arm"),
        _parameters(found),
        _observability_section(found),
        _rows(found),
        _provenance_section(found),
    ]


def warnings(found: ReportContext) -> list[str]:
    """What a reader must know before believing the figures."""
    fit, out = found.fit, []
    if not fit.converged:
        out.append("The loop did not converge: the figures are of its last step.")
    out += summary.regressions(found.comparisons)
    if not np.isfinite(fit.unit_weight_std):
        out.append(
            f"{fit.n_samples} samples stand against {fit.rank} directions that they see: no reading is left "
            "over to tell how uncertain the parameters are."
        )
    if found.outliers:
        many = f"{len(found.outliers)} gross errors are" if len(found.outliers) > 1 else "One gross error is"
        aside = max(c.n_rejected for c in fit.comparisons)
        out.append(f"{many} among the samples, {aside or 'none'} left aside; see below.")
    return out


def _accuracy(found: ReportContext) -> Section:
    frames = {e.name.split(".")[0] for e in found.fit.estimates if e.category == "frame" and not e.fixed}
    same = f", its {' and '.join(sorted(frames))} where they fit best" if frames else ""
    return Section(
        "accuracy",
        "Accuracy",
        [f"Before is the nominal arm{same}: what differs between before and after is the robot alone."],
        tables=[summary.accuracy_table(found.comparisons)],
    )


def _residual_section(found: ReportContext) -> Section:
    title, key = "What the model leaves unexplained", "left"
    if not found.joint_profiles:
        return Section(key, title)
    which = "held out" if found.fit.holdout else "fitted"
    rows = []
    for t in found.joint_profiles:
        unit = "m" if t.is_prismatic else "rad"
        if len(t.centres):
            worst = int(np.nanargmax(np.abs(t.after)))
            std, at = float(t.after_std[worst]), float(t.centres[worst])
            figures = (float(np.nanmax(np.abs(t.before))), float(t.after[worst]), std)
            place = f"{1e3 * at:.0f} mm" if t.is_prismatic else f"{np.degrees(at):.0f}°"
            rows.append(
                [t.name, *(format_quantity(figure, unit, std, small=True) for figure in figures), place]
            )
    text = (
        "In each part of a joint's range, the error of that joint alone that would explain the samples "
        f"{which} best. Scatter about zero is noise; a wave points to an error that the model lacks: an "
        "eccentric gear, elasticity, backlash."
    )
    table = Table(["joint", "largest before", "largest after", "std", "at"], rows)
    if silent := [t.name for t in found.joint_profiles if not len(t.centres)]:
        text += f" Nothing is said of {', '.join(silent)}: too few samples, or it hardly moves the point."
    if not rows:
        return Section(key, title, ["There are too few samples to see how each joint errs over its range."])
    return Section(key, title, [text], tables=[table])


def _extension(found: ReportContext) -> Section:
    title, trials = "Errors of the joints' drives", found.source.trials
    if not trials:
        hint = found.source.hint
        return Section("extension", title, [f"{hint[0].upper()}{hint[1:]}."] if hint else [])
    kept = [trial.family for trial in trials if trial.is_selected]
    said = f"Added to the geometry: {', '.join(kept)}." if kept else "None was added to the geometry."
    text = (
        "Errors are those on regions of joint space that were left out of the fit, in standard deviations "
        "of a reading, without the family and with it, each on top of those added before. A family is added "
        "where the error falls by more than its standard error and where chance would hardly bring as much."
    )
    return Section("extension", title, [said, text], tables=[trial_table(trials)])


def _workspace(found: ReportContext) -> Section:
    w = found.workspace
    known = np.isfinite(w.std)
    rows = []
    for title, std in (
        ("everywhere within the joints' limits", w.std),
        ("at the fitted samples", w.measured_std),
    ):
        if len(std):
            good = std[np.isfinite(std)]
            cells = [
                format_fixed(1e3 * float(np.quantile(good, at)), 3) if good.size else "–"
                for at in (0.05, 0.5, 0.95, 1)
            ]
            rows.append([title, *cells, f"{100 * (1 - good.size / len(std)):.0f} %"])
    sentences = [
        "The standard deviation of the tool's position that follows from the parameters' own uncertainty, "
        "for configurations drawn over the joints' limits (a joint turns at most half a turn each way). "
        "It grows away from what was measured. What the model lacks comes on top of it: see "
        "the error on samples that were not fitted."
    ]
    if not known.any():
        sentences = [
            "No accuracy can be predicted anywhere: the data leave the tool's place undetermined and no "
            "prior holds it, or no reading is left over to tell the noise by."
        ]
    elif not known.all():
        sentences.append("Where the data leave the tool's place undetermined it cannot be predicted at all.")
    header = ["predicted position std, mm", "best 5 % below", "half below", "95 % below", "worst", "unknown"]
    return Section(
        "workspace", "Where the calibrated arm can be trusted", sentences, tables=[Table(header, rows)]
    )


def _parameters(found: ReportContext) -> Section:
    titles = {
        "robot": "Robot",
        "frame": "Where the robot stands and where the target sits",
        "instrument": "Instruments",
    }
    every = [
        (title, [e for e in found.fit.estimates if e.category == place]) for place, title in titles.items()
    ]
    out = []
    for title, rows in every:
        if rows:
            table = summary.estimate_table(rows)
            # A frame's nominal place says nothing, and only joints have a prior that matters.
            drop = (1, 3, 5) if title == titles["frame"] else (5,) if title == titles["instrument"] else ()
            header = [*table.header, "prior std", "observability"]
            full = [
                [
                    *row,
                    format_quantity(e.prior, e.unit, e.prior, True) if not e.fixed else "",
                    "" if e.fixed else f"{e.observability:.2f}",
                ]
                for row, e in zip(table.rows, rows, strict=True)
            ]
            header, *cells = [
                [text for i, text in enumerate(row) if i not in drop] for row in [header, *full]
            ]
            out.append(Table(header, cells, caption=title))
    text = (
        "Observability is how far the data alone see a parameter, from 0 (not at all) to 1 (fully). A "
        "parameter with less than 1 shares what it does with others; the prior decides how the sum is parted."
    )
    return Section("parameters", "Parameters", [text], tables=out)


def _observability_section(found: ReportContext) -> Section:
    fit = found.fit
    text = (
        f"The data see {fit.rank} of {len(fit.parameters)} directions of the parameters; the largest "
        f"singular value seen is {fit.condition:.3g} times the smallest."
    )
    also = "Nothing is hidden: every parameter can be told from the others."
    if fit.unobservable:
        also = "These cannot be told apart: their single values mean little, what they do together is known."
    sentences = [text, also]
    if held := [e.name for e in fit.estimates if e.fixed]:
        sentences.append(f"Held at nominal, and so not judged: {', '.join(held)}.")
    items = [
        *(f"held back: {text}" for text in fit.shrinkage_notes),
        *fit.unobservable,
        *(f"weakly seen: {text}" for text in fit.weakly_observable),
    ]
    return Section("seen", "What could not be told apart", sentences, items)


def _rows(found: ReportContext) -> Section:
    names, rows = found.names, []
    for o in found.outliers[:MAX_OUTLIERS]:
        size = ", ".join(
            format_quantity(v, "rad" if g == "orientation" else "m", v / 10, True) for g, v in o.sizes.items()
        )
        rows.append([names[o.item], str(o.row), size, f"{o.score:.0f}"])
    sentences = [
        f"No fitted sample scores beyond {robust.OUTLIER_THRESHOLD:g} against the scatter of the others."
    ]
    if rows:
        more = len(found.outliers) - len(rows)
        sentences = [
            f"Fitted samples that score beyond {robust.OUTLIER_THRESHOLD:g} against the scatter of the others; a good "
            "sample does that once in three million." + (f" {more} more are not listed." if more else "")
        ]
    items = [
        f"{name}, row {row}, is left out: {reason}"
        for name, reasons in found.source.excluded_rows.items()
        for row, reason in reasons.items()
    ]
    items += [f"{name}: warning: {text}" for name, texts in found.source.warnings.items() for text in texts]
    return Section(
        "rows", "Outliers", sentences, items, [Table(["file", "row", "error", "score"], rows)] if rows else []
    )


def _provenance_section(found: ReportContext) -> Section:
    fit, source = found.fit, found.source
    facts = [["robot", f"{found.robot}, tip {fit.chain.tip}, joints {', '.join(fit.chain.joint_names)}"]]
    if source.command:
        facts.append(["command", source.command])
    free = {e.name for e in fit.estimates if not e.fixed}
    for what, station in (("base", BASE_FRAME), ("tool", fit.chain.tool_frame_index)):
        count = sum(p.error_frame == station and p.name in free for p in fit.errors.parameters)
        facts.append(
            [what, f"{count} of 6 components found from the data" if count else "as given, not changed"]
        )
    held = [e.name for e in fit.estimates if e.fixed]
    facts += [["held", ", ".join(held)]] if held else []
    facts.append(
        ["method", {"lm": "Levenberg-Marquardt", "gn": "Gauss-Newton, the paper's loop"}[fit.method]]
    )
    facts.append(
        ["state", f"{'converged' if fit.converged else 'not converged'} after {fit.iterations} iterations"]
    )
    priors = bool(np.any(fit.problem.weights))
    near = "normal about nominal, standard deviations in the tables above; frames and instruments wide"
    facts.append(["priors", near if priors else "none"])
    facts += [[name, text] for name, text in source.settings.items()]
    rows = []
    held_out = dict.fromkeys(found.names, 0)
    for name, item in zip(found.holdout_names, fit.holdout, strict=True):
        held_out[name] = held_out.get(name, 0) + len(item.rows)
    for name, item, sigma in zip(found.names, fit.data, sigmas(fit), strict=True):
        how = "stated" if item.has_stated_sigma else ("estimated" if fit.method == "lm" else "assumed")
        each = ", ".join(
            f"{group} {format_quantity(v, 'rad' if group == 'orientation' else 'm', v, small=True)}"
            for group, v in sigma.items()
        )
        rows.append([name, item.kind, f"{each}, {how}", str(len(item.rows)), str(held_out.pop(name, 0))])
    rows += [[name, "", "", "0", str(count)] for name, count in held_out.items()]
    short = short_names(list(source.inputs))
    hashes = [[short[path], digest] for path, digest in source.inputs.items()]
    out = [
        Table(
            ["data", "kind", "standard deviation of an axis", "fitted", "held out"], rows, n_text_columns=3
        ),
        Table(["choice", "value"], facts, n_text_columns=2),
        Table(["file", "SHA-256"], hashes, n_text_columns=2),
        Table(["software", "version"], list(map(list, versions().items())), n_text_columns=2),
    ]
    return Section("done", "How this was made", tables=[table for table in out if table.rows])


def markdown(found: ReportContext) -> str:
    """The report without its figures."""
    head = summary.headline(found.comparisons)
    parts = [f"# Calibration of {found.robot}", f"**{head.text}**", *found.source.remarks, *warnings(found)]
    for section in sections(found):
        blocks = [*section.sentences]
        if section.items:
            blocks.append("\n".join(f"- {item}" for item in section.items))
        for table in section.tables:
            blocks += [f"**{table.caption}**"] if table.caption else []
            blocks.append(formatting.markdown_table(table))
        parts += [f"## {section.title}", *blocks] if blocks else []
    return "\n\n".join(parts) + "\n"
