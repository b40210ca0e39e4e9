"""The report's figures: errors before and after, by sample and by joint, over the workspace, singular values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import figures, observability, se3
from .diagnosis import JointTrace, Workspace
from .evaluation import ENDINGS, deviations, sizes
from .figures import Axis, Mark, panel, spanning, symmetric
from .report_sections import Study
from .se3 import Array
from .tables import SMALL, WORDS

HISTOGRAM = 28
# Cells a side of a map.
GRID = 32
MOST_DOTS = 1500
# Height of a panel on which a metre is as long upwards as across.
SQUARE = figures.WIDE - figures.LEFT - figures.RIGHT + figures.TOP + figures.BOTTOM


def _unit(group: str) -> tuple[float, str]:
    factor, name = SMALL[ENDINGS[group].strip("_") or "m"]
    return factor, name.strip()


def histograms(study: Study) -> list[str]:
    """Sizes of errors before and after, a panel a group, held out first."""
    fit, out = study.fit, []
    for title, data in (("held out", fit.holdout), ("fitted", fit.data)):
        if not data:
            continue
        before = sizes(deviations(fit.reference, data))
        after = sizes(deviations(fit.chain, data, fit.instruments))
        for group, size in after.items():
            factor, unit = _unit(group)
            x = spanning(factor * np.concatenate([before[group], size]), f"{WORDS[group]}, {unit}", zero=True)
            edges = np.linspace(x.low, x.high, HISTOGRAM + 1)
            counts = [np.histogram(factor * v, edges)[0] for v in (before[group], size)]
            marks = [figures.steps(edges, n, look) for n, look in zip(counts, ("before", "after"), strict=True)]
            rms = [factor * float(np.sqrt(np.mean(v**2))) for v in (before[group], size)]
            text = (
                f"Histogram of the {WORDS[group]} of {len(size)} samples {title}: RMS {rms[0]:.3g} {unit} before, "
                f"{rms[1]:.3g} {unit} after."
            )
            y = spanning(np.concatenate(counts), "samples", zero=True)
            name = f"{WORDS[group][0].upper()}{WORDS[group][1:]}, {len(size)} {title}"
            out.append(panel(f"h-{title.replace(' ', '')}-{group}", name, text, x, y, marks))
    return out


def _places(study: Study) -> list[tuple[str, Array, dict[str, Array], Array]]:
    """By item: "fitted" or "held out", sample numbers over all files, errors' sizes by group, gross or not."""
    fit = study.fit
    starts: dict[str, int] = {}
    last: dict[str, int] = {}
    named = [*zip(study.names, fit.data, strict=True), *zip(study.holdout_names, fit.holdout, strict=True)]
    for name, item in named:
        last[name] = max(last.get(name, 0), int(item.rows.max()))
    for name in last:
        starts[name] = sum(last[other] for other in starts)
    errors = [*deviations(fit.chain, fit.data, fit.instruments), *deviations(fit.chain, fit.holdout, fit.instruments)]
    gross = {(o.item, o.row) for o in study.outliers}
    out = []
    for i, ((name, item), error) in enumerate(zip(named, errors, strict=True)):
        bad = np.array([(i, int(row)) in gross for row in item.rows])
        title = "fitted" if i < len(fit.data) else "held out"
        out.append((title, starts[name] + item.rows, sizes([error]), bad))
    return out


def by_sample(study: Study) -> list[str]:
    """Errors after calibration over the samples' order, a panel a group."""
    found, out = _places(study), []
    several = len(set(study.names) | set(study.holdout_names)) > 1
    for group in ENDINGS:
        mine = [(title, rows, size[group], bad) for title, rows, size, bad in found if group in size]
        if not mine:
            continue
        factor, unit = _unit(group)
        every = np.concatenate([rows for _, rows, _, _ in mine])
        most = factor * np.concatenate([size for _, _, size, _ in mine])
        x = spanning(every, "sample, all files in a row" if several else "row of the file", zero=True, round_up=False)
        y = spanning(most, f"{WORDS[group]}, {unit}", zero=True)
        marks: list[Mark] = []
        for look, wanted in (("faint", "fitted"), ("after", "held out")):
            for title, rows, size, bad in mine:
                if title == wanted:
                    marks.append(figures.dots(rows[~bad], factor * size[~bad], look))
                    marks += [figures.dots(rows[bad], factor * size[bad], "gross")] if bad.any() else []
        text = f"{WORDS[group]} after calibration of {len(every)} samples in order; the largest is {most.max():.3g} {unit}."
        title = f"{WORDS[group][0].upper()}{WORDS[group][1:]} by sample"
        out.append(panel(f"s-{group}", title, text, x, y, marks, figures.WIDE))
    return out


def _label(trace: JointTrace) -> tuple[float, str, float, str]:
    """Factor and unit of a joint's value, and of its error."""
    return (1e3, "mm", 1e3, "mm") if trace.slides else (180 / np.pi, "°", 1e3, "mrad")


def by_joint(study: Study) -> list[str]:
    """Errors after calibration over each joint's value, with the median of each part."""
    traces = study.traces
    if not traces:
        return []
    group = next(iter(study.fit.comparisons)).after
    name = next(g for g in ENDINGS if f"{g}_rms{ENDINGS[g]}" in group)
    factor, unit = _unit(name)
    out = []
    y = spanning(factor * np.concatenate([t.sizes for t in traces]), f"{WORDS[name]}, {unit}", zero=True)
    for i, t in enumerate(traces):
        scale, angle, _, _ = _label(t)
        x = spanning(scale * t.values, f"{t.name}, {angle}", round_up=False)
        thin = np.unique(np.linspace(0, len(t.values) - 1, min(len(t.values), MOST_DOTS)).astype(int))
        marks = [figures.dots(scale * t.values[thin], factor * t.sizes[thin], "faint")]
        if len(t.centres) > 1:
            half = 0.5 * float(np.min(np.diff(t.centres)))
            middle = [np.median(t.sizes[np.abs(t.values - c) <= half * 1.001]) for c in t.centres]
            marks.append(figures.line(scale * t.centres, factor * np.array(middle), "after"))
        text = f"{WORDS[name]} after calibration over the value of {t.name}, with the median of each part of its range."
        out.append(panel(f"j-{i}", t.name, text, x, y, marks))
    return out


def asked(study: Study) -> list[str]:
    """The error of each joint alone that each part of its range asks for, before and after."""
    out = []
    for i, t in enumerate(study.traces):
        if not len(t.centres):
            continue
        scale, angle, factor, unit = _label(t)
        alike = [other for other in study.traces if other.slides == t.slides]
        reach = np.concatenate(
            [s * factor * (np.abs(v) + 2 * d) for o in alike for s in (1, -1)
             for v, d in ((o.before, o.before_std), (o.after, o.after_std))]
        )  # fmt: skip
        x = spanning(scale * t.values, f"{t.name}, {angle}", round_up=False)
        marks = [figures.across_at(0.0, "zero")]
        for value, std, look in ((t.before, t.before_std, "before"), (t.after, t.after_std, "after")):
            at, v, s = scale * t.centres, factor * value, factor * std
            marks += [figures.spans(at, v - 2 * s, v + 2 * s, look), figures.line(at, v, look), figures.dots(at, v, look)]
        worst = factor * float(np.nanmax(np.abs(t.after)))
        text = (
            f"Error of {t.name} alone that would explain the readings in each part of its range, with two standard "
            f"errors; at most {worst:.3g} {unit} after calibration."
        )
        y = symmetric(reach, f"joint error asked for, {unit}")
        out.append(panel(f"a-{i}", t.name, text, x, y, marks))
    return out


@dataclass(frozen=True, eq=False)
class Map:
    """Predicted position std over two coordinates, its RMS along the line of sight.

    Attributes:
        key: the two coordinates' names.
        corners: (c, 2) lower corners of the cells with a configuration, m.
        size: a cell's side, m.
        std: (c,) m; infinite where at most configurations it cannot be predicted.
    """

    key: str
    corners: Array
    size: float
    std: Array


def maps(w: Workspace) -> list[Map]:
    """The workspace from above and from the side; empty where nothing is predicted."""
    out = []
    for key, pick in (("xy", [0, 1]), ("xz", [0, 2])) if np.isfinite(w.std).any() else ():
        points = w.points[:, pick]
        low = points.min(0)
        size = float(np.ptp(points, axis=0).max()) / GRID or 1.0
        place = np.floor((points - low) / size).astype(int)
        known = np.isfinite(w.std)
        sums = np.zeros((3, GRID + 3, GRID + 3))
        for layer, weight in zip(sums, (np.where(known, w.std, 0.0) ** 2, known, np.ones(len(known))), strict=True):
            np.add.at(layer, (place[:, 0] + 1, place[:, 1] + 1), weight)
        cells = np.argwhere(sums[2] > 0)
        # Each cell with its eight neighbours, so that few configurations make no speckles.
        pooled = np.array([sums[:, i - 1 : i + 2, j - 1 : j + 2].sum((1, 2)) for i, j in cells])
        square = pooled[:, 0] / np.maximum(pooled[:, 1], 1)
        std = np.where(pooled[:, 1] > 0.5 * pooled[:, 2], np.sqrt(square), np.inf)
        out.append(Map(key, low + size * (cells - 1), size, std))
    return out


def levels(found: Sequence[Map]) -> list[float]:
    """Edges in m between the levels of maps: round steps over most of what they show."""
    every = np.concatenate([m.std[np.isfinite(m.std)] for m in found])
    low, high = (float(np.quantile(every, at)) for at in (0.02, 0.98)) if every.size else (0.0, 1.0)
    step = figures.nice_step(max(high - low, 1e-3 * high, 1e-12) / figures.LEVELS)
    return (step * (np.floor(low / step) + np.arange(figures.LEVELS + 1))).tolist()


def map_panels(study: Study) -> tuple[list[str], list[tuple[str, str]]]:
    """Maps of the predicted position std with the fitted samples, and their legend in mm."""
    w = study.workspace
    found = maps(w)
    if not found:
        return [], []
    edges, out = levels(found), []
    good = w.std[np.isfinite(w.std)]
    thin = np.unique(np.linspace(0, len(w.measured) - 1, min(len(w.measured), 500)).astype(int))
    for m, title in zip(found, ("Seen from above", "Seen from the side"), strict=True):
        pick = ["xyz".index(name) for name in m.key]
        x, y = _square(w.points[:, pick], m.key)
        marks = [figures.cells(m.corners[:, 0], m.corners[:, 1], m.size, figures.level_of(m.std, edges))]
        marks += [figures.dots(*w.measured[thin][:, pick].T, "measured")] if len(thin) else []
        text = (
            f"Map of the predicted standard deviation of the tool's position over {m.key[0]} and {m.key[1]}: half of "
            f"the configurations below {1e3 * float(np.median(good)):.3g} mm, 95 % below "
            f"{1e3 * float(np.quantile(good, 0.95)):.3g} mm."
        )
        out.append(panel(f"m-{m.key}", title, text, x, y, marks, figures.WIDE, SQUARE))
    places = figures.places(1e3 * (edges[1] - edges[0]))
    words = [f"{1e3 * edge:.{places}f}" for edge in edges]
    legend = [(f"level{i}", f"{a}–{b} mm") for i, (a, b) in enumerate(zip(words, words[1:], strict=False))]
    legend[0], legend[-1] = ("level0", f"below {words[1]} mm"), (legend[-1][0], f"above {words[-2]} mm")
    if not all(np.isfinite(m.std).all() for m in found):
        legend.append(("unknown", "cannot be predicted"))
    return out, [*legend, ("dots measured", "fitted samples")]


def _square(points: Array, names: str) -> tuple[Axis, Axis]:
    """Axes about points (m, 2) on which a metre is as long upwards as across."""
    low, high = points.min(0), points.max(0)
    middle, half = 0.5 * (low + high), 0.53 * max(float(np.max(high - low)), 1e-3)
    x, y = (Axis(float(c) - half, float(c) + half, f"{name} in the base frame, m")
            for c, name in zip(middle, names, strict=True))  # fmt: skip
    return x, y


def magnification(study: Study) -> float:
    """How many times larger errors are drawn so that they show: round, from 1 to 500."""
    points = [
        np.array([body[3, :, 0] for body in chain.sweep(_pose(study)).bodies])
        for chain in (study.fit.reference, study.fit.chain)
    ]
    off = float(np.linalg.norm(points[1] - points[0], axis=1).max())
    wanted = 0.05 * float(np.ptp(points[0], axis=0).max()) / max(off, 1e-12)
    return min(max(figures.nice_step(max(wanted, 1e-3) / 2), 1.0), 500.0)


def _pose(study: Study) -> Array:
    """Joint values (1, n) of the fitted sample that is nearest the middle of all."""
    used = [item.configurations() for item in study.fit.data if item.ends > 0]
    if not used:
        return np.zeros((1, study.fit.chain.size))
    points = study.workspace.measured
    nearest = int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))
    return np.concatenate(used)[nearest : nearest + 1]


def arm(study: Study) -> list[str]:
    """The arm's skeleton at one sample before and after, errors drawn larger, from the side and from above."""
    fit, larger = study.fit, magnification(study)
    into = se3.inverse(fit.chain.base)
    shapes = []
    for chain in (fit.reference, fit.chain):
        sweep = chain.sweep(_pose(study))
        points = np.array([*(body[3, :, 0] for body in sweep.bodies), sweep.tool[3, :, 0]])
        shapes.append(points @ into[:3, :3].T + into[:3, 3])
    nominal = shapes[0]
    drawn = nominal + larger * (shapes[1] - nominal)
    cloud = study.workspace.measured[:MOST_DOTS]
    out = []
    for key, pick, title in (("xz", [0, 2], "From the side"), ("xy", [0, 1], "From above")):
        x, y = _square(np.concatenate([nominal, drawn, cloud])[:, pick], key)
        marks = [figures.dots(*cloud[:, pick].T, "faint")] if len(cloud) else []
        for points, look in ((nominal, "before"), (drawn, "after")):
            marks += [draw(*points[:, pick].T, look) for draw in (figures.line, figures.dots)]
        name = f"{title}, errors drawn {larger:g} times larger"
        text = f"The arm's joints before and after calibration over {key[0]} and {key[1]}."
        out.append(panel(f"arm-{key}", name, text, x, y, marks, figures.WIDE, SQUARE))
    return out


def spectrum(study: Study) -> list[str]:
    """Singular values of the whitened Jacobian, those below the cut apart."""
    s = observability.singular_values(study.fit.solution.triangle.r)
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
        marks += [figures.across_at(observability.RANK_CUT, "cut"), figures.dots(number[~seen], share[~seen], "gross large")]
    text = (
        f"{len(s)} singular values, {study.fit.rank} of them seen; the smallest seen is "
        f"{share[seen][-1]:.2g} of the largest."
    )
    return [panel("sv", "Singular values", text, x, y, marks)]


def estimate_bars(study: Study, names: Sequence[str]) -> dict[str, list[str]]:
    """Drawings for the rows of a parameter table: change with two standard deviations, and observability."""
    rows = {e.name: e for e in study.fit.estimates}
    chosen = [rows[name] for name in names]
    most = {}
    for e in chosen:
        if np.isfinite(e.change):
            spread = e.std if np.isfinite(e.std) else 0.0
            most[e.unit] = max(most.get(e.unit, 0.0), abs(e.change) + 2 * min(spread, 3 * abs(e.change) + 1e-12))
    out: dict[str, list[str]] = {}
    if most:
        out["change ± 2 std"] = [
            "" if e.fixed or not np.isfinite(e.change) or not np.isfinite(e.std)
            else figures.interval_bar(e.change - 2 * e.std, e.change, e.change + 2 * e.std, most[e.unit])
            for e in chosen
        ]  # fmt: skip
    out["seen"] = ["" if e.fixed else figures.share_bar(e.observability) for e in chosen]
    return out
