"""The report's figures: errors before and after, by sample and by joint, and singular values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._typing import Array
from ..calibration.evaluation import GROUP_UNITS, compute_errors, error_norms
from ..calibration.summary import GROUP_LABELS
from ..diagnostics.residuals import JointProfile
from ..estimation import qr
from ..formatting import SMALL_UNITS
from ..visualization import figures
from ..visualization.figures import Axis, Mark, axes, axis_over, symmetric
from .sections import ReportContext

HISTOGRAM = 28


MAX_DOTS = 1500


# Fewer dots than this are drawn large.
MAX_SEPARATE_DOTS = 100


# What is so many times larger than the rest would flatten it, were they to share a scale.
MAX_PANELS = 4


def _unit(group: str) -> tuple[float, str]:
    factor, name = SMALL_UNITS[GROUP_UNITS[group]]
    return factor, name.strip()


def _bins(before: Array, after: Array, title: str, count: int) -> tuple[Axis, Array]:
    """Axis and edges of a histogram of sizes; logarithmic where one of both would else be a single bar."""
    every = np.concatenate([before, after])
    high = float(every.max())
    medians = sorted((float(np.median(before)), float(np.median(after))))
    if medians[1] <= MAX_PANELS * medians[0]:
        axis = axis_over(every, title, zero=True)
        return axis, np.linspace(axis.low, axis.high, count + 1)
    low = max(float(np.quantile(every, 0.01)), 1e-6 * high)
    return Axis(low, high, title, log=True), np.geomspace(low, high, count + 1)


def histograms(study: ReportContext) -> list[str]:
    """Sizes of errors before and after, a panel a group, held out first."""
    fit, out = study.fit, []
    for title, data in (("held out", fit.holdout), ("fitted", fit.inliers)):
        if not data:
            continue
        before = error_norms(compute_errors(fit.nominal_refitted, data))
        after = error_norms(compute_errors(fit.chain, data, fit.instruments))
        for group, size in after.items():
            factor, unit = _unit(group)
            bins = min(HISTOGRAM, max(8, len(size) // 3))
            pair = [factor * before[group], factor * size]
            x, edges = _bins(pair[0], pair[1], f"{GROUP_LABELS[group]}, {unit}", bins)
            counts = [np.histogram(np.clip(v, edges[0], edges[-1]), edges)[0] for v in pair]
            marks = [
                figures.histogram(edges, n, look) for n, look in zip(counts, ("before", "after"), strict=True)
            ]
            rms = [float(np.sqrt(np.mean(v**2))) for v in pair]
            text = (
                f"Histogram of the {GROUP_LABELS[group]} of {len(size)} samples {title}: RMS {rms[0]:.3g} {unit} "
                f"before, {rms[1]:.3g} {unit} after."
            )
            y = axis_over([5, *np.concatenate(counts)], "samples", zero=True)
            name = f"{GROUP_LABELS[group][0].upper()}{GROUP_LABELS[group][1:]}, {len(size)} {title}"
            out.append(axes(f"h-{title.replace(' ', '')}-{group}", name, text, x, y, marks))
    return out


def _places(study: ReportContext) -> list[tuple[str, Array, dict[str, Array], Array]]:
    """By item: "fitted" or "held out", sample numbers over all files, sizes by group, gross or not."""
    fit = study.fit
    starts: dict[str, int] = {}
    last: dict[str, int] = {}
    named = [*zip(study.names, fit.data, strict=True), *zip(study.holdout_names, fit.holdout, strict=True)]
    for name, item in named:
        last[name] = max(last.get(name, 0), int(item.rows.max()))
    for name in last:
        starts[name] = sum(last[other] for other in starts)
    errors = [
        *compute_errors(fit.chain, fit.data, fit.instruments),
        *compute_errors(fit.chain, fit.holdout, fit.instruments),
    ]
    gross = {(o.item, o.row) for o in study.outliers}
    out = []
    for i, ((name, item), error) in enumerate(zip(named, errors, strict=True)):
        bad = np.array([(i, int(row)) in gross for row in item.rows])
        title = "fitted" if i < len(fit.data) else "held out"
        out.append((title, starts[name] + item.rows, error_norms([error]), bad))
    return out


def sample_looks(study: ReportContext) -> tuple[str, ...]:
    """How dots of the fitted samples look, and of those held out if there are any."""
    size = " large" if study.fit.n_samples < MAX_SEPARATE_DOTS else ""
    return (f"faint{size}", f"after{size}") if study.fit.holdout else (f"after{size}",)


def by_sample(study: ReportContext) -> list[str]:
    """Errors after calibration over the samples' order, a panel a group."""
    found, out = _places(study), []
    several = len(set(study.names) | set(study.holdout_names)) > 1
    for group in GROUP_UNITS:
        mine = [(title, rows, size[group], bad) for title, rows, size, bad in found if group in size]
        if not mine:
            continue
        factor, unit = _unit(group)
        every = np.concatenate([rows for _, rows, _, _ in mine])
        most = factor * np.concatenate([size for _, _, size, _ in mine])
        x = axis_over(
            every, "sample, all files in a row" if several else "row of the file", zero=True, round_up=False
        )
        y = axis_over(most, f"{GROUP_LABELS[group]}, {unit}", zero=True)
        marks: list[Mark] = []
        for look, wanted in zip(sample_looks(study), ("fitted", "held out"), strict=False):
            for title, rows, size, bad in mine:
                if title == wanted:
                    thin = np.flatnonzero(~bad)[figures.subsample_indices(int(np.sum(~bad)), 2 * MAX_DOTS)]
                    marks.append(figures.dots(rows[thin], factor * size[thin], look))
                    marks += [figures.dots(rows[bad], factor * size[bad], "gross")] if bad.any() else []
        text = f"{GROUP_LABELS[group]} after calibration of {len(every)} samples; at most {most.max():.3g} {unit}."
        title = f"{GROUP_LABELS[group][0].upper()}{GROUP_LABELS[group][1:]} by sample"
        out.append(axes(f"s-{group}", title, text, x, y, marks, figures.WIDE))
    return out


def _label(trace: JointProfile) -> tuple[float, str, float, str]:
    """Factor and unit of a joint's value, and of its error."""
    return (1e3, "mm", 1e3, "mm") if trace.is_prismatic else (180 / np.pi, "°", 1e3, "mrad")


def by_joint(study: ReportContext) -> list[str]:
    """Errors after calibration over each joint's value, with the median of each part."""
    traces = study.joint_profiles
    if not traces:
        return []
    name = next(iter(study.fit.comparisons[0].after.groups))
    factor, unit = _unit(name)
    out = []
    y = axis_over(
        factor * np.concatenate([t.sizes for t in traces]), f"{GROUP_LABELS[name]}, {unit}", zero=True
    )
    for i, t in enumerate(traces):
        scale, angle, _, _ = _label(t)
        x = axis_over(scale * t.values, f"{t.name}, {angle}", round_up=False)
        thin = figures.subsample_indices(len(t.values), MAX_DOTS)
        size = " large" if len(thin) < MAX_SEPARATE_DOTS else ""
        marks = [figures.dots(scale * t.values[thin], factor * t.sizes[thin], f"faint{size}")]
        if len(t.centres) > 1:
            half = 0.5 * float(np.min(np.diff(t.centres)))
            middle = [np.median(t.sizes[np.abs(t.values - c) <= half * 1.001]) for c in t.centres]
            marks.append(figures.line(scale * t.centres, factor * np.array(middle), "after"))
        text = f"{GROUP_LABELS[name]} after calibration over the value of {t.name}, with each part's median."
        out.append(axes(f"j-{i}", t.name, text, x, y, marks))
    return out


def _reach(value: Array, std: Array) -> float:
    """How far from zero values go, two standard errors included."""
    return float(np.max(np.abs(value) + 2 * std, initial=0.0))


def visible_states(study: ReportContext) -> list[str]:
    """What the panels of `asked` show: "before" only where it leaves room to see what is left after."""
    pairs = [
        max((_reach(v, s) for v, s in rows), default=0.0)
        for rows in (
            [(t.before, t.before_std) for t in study.joint_profiles],
            [(t.after, t.after_std) for t in study.joint_profiles],
        )
    ]
    return ["before", "after"] if pairs[0] <= MAX_PANELS * pairs[1] else ["after"]


def plot_joint_offset_profile(study: ReportContext) -> list[str]:
    """The error of each joint alone that each part of its range asks for, before and after."""
    out, looks = [], visible_states(study)

    def drawn(t: JointProfile) -> list[tuple[Array, Array]]:
        every = {"before": (t.before, t.before_std), "after": (t.after, t.after_std)}
        return [every[look] for look in looks]

    for i, t in enumerate(study.joint_profiles):
        if not len(t.centres):
            continue
        scale, angle, factor, unit = _label(t)
        # Joints share a scale, but for one that is asked for much more than the others.
        reach = {o.name: max(_reach(v, s) for v, s in drawn(o)) for o in study.joint_profiles if o.is_prismatic == t.is_prismatic
                 and len(o.centres)}  # fmt: skip
        shared = max(r for r in reach.values() if r <= MAX_PANELS * np.median(list(reach.values())))
        x = axis_over(scale * t.values, f"{t.name}, {angle}", round_up=False)
        marks = [figures.hline(0.0, "zero")]
        for (value, std), look in zip(drawn(t), looks, strict=True):
            at, v, s = scale * t.centres, factor * value, factor * std
            marks += [
                figures.error_bars(at, v - 2 * s, v + 2 * s, look),
                figures.line(at, v, look),
                figures.dots(at, v, look),
            ]
        worst = factor * float(np.nanmax(np.abs(t.after)))
        text = (
            f"Error of {t.name} alone that would explain the readings in each part of its range, with two "
            f"standard errors; at most {worst:.3g} {unit} after calibration."
        )
        y = symmetric([factor * max(shared, reach[t.name])], f"joint error asked for, {unit}")
        out.append(axes(f"a-{i}", t.name, text, x, y, marks))
    return out


def spectrum(study: ReportContext) -> list[str]:
    """Singular values of the whitened Jacobian, those below the cut apart."""
    s = qr.singular_values(study.fit.solution.system.r)
    if not (s.size and s[0] > 0):
        return []
    share = np.maximum(s / s[0], 1e-18)
    number = np.arange(1, len(s) + 1)
    seen = np.arange(len(s)) < study.fit.rank
    low = 10.0 ** np.floor(np.log10(min(float(share.min()), 0.1)))
    y = Axis(low, 2.0, "share of the largest", log=True)
    x = Axis(0.0, len(s) + 1.0, "direction")
    marks: list[Mark] = [figures.dots(number[seen], share[seen], "after large")]
    if not seen.all():
        marks += [
            figures.hline(qr.RANK_RTOL, "cut"),
            figures.dots(number[~seen], share[~seen], "gross large"),
        ]
    text = (
        f"{len(s)} singular values, {study.fit.rank} of them seen; the smallest seen is "
        f"{share[seen][-1]:.2g} of the largest."
    )
    return [axes("sv", "Singular values", text, x, y, marks)]


def estimate_bars(study: ReportContext, names: Sequence[str]) -> dict[str, list[str]]:
    """Drawings for the rows of a parameter table: change with two standard deviations, and observability."""
    rows = {e.name: e for e in study.fit.estimates}
    chosen = [rows[name] for name in names]
    most = {}
    for e in chosen:
        if np.isfinite(e.change):
            spread = e.std if np.isfinite(e.std) else 0.0
            most[e.unit] = max(
                most.get(e.unit, 0.0), abs(e.change) + 2 * min(spread, 3 * abs(e.change) + 1e-12)
            )
    out: dict[str, list[str]] = {}
    if most:
        out["change ± 2 std"] = [
            "" if e.fixed or not np.isfinite(e.change) or not np.isfinite(e.std)
            else figures.interval_bar(e.change - 2 * e.std, e.change, e.change + 2 * e.std, most[e.unit])
            for e in chosen
        ]  # fmt: skip
    out["seen"] = ["" if e.fixed else figures.share_bar(e.observability) for e in chosen]
    return out
