"""The report's drawings of space: where accuracy is predicted good or bad, and the arm itself for print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .. import se3
from .._typing import Array
from ..diagnostics.residuals import Workspace
from ..visualization import figures
from ..visualization.figures import Axis, axes
from .figures import MAX_DOTS, MAX_SEPARATE_DOTS
from .sections import ReportContext

# Cells a side of a map.
GRID = 32


# Height of a panel on which a metre is as long upwards as across.
SQUARE = figures.WIDE - figures.LEFT - figures.RIGHT + figures.TOP + figures.BOTTOM


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
        for layer, weight in zip(
            sums, (np.where(known, w.std, 0.0) ** 2, known, np.ones(len(known))), strict=True
        ):
            np.add.at(layer, (place[:, 0] + 1, place[:, 1] + 1), weight)
        cells = np.argwhere(sums[2] > 0)
        # Each cell with its eight neighbours, so that few configurations make no speckles.
        pooled = np.array([sums[:, i - 1 : i + 2, j - 1 : j + 2].sum((1, 2)) for i, j in cells])
        square = pooled[:, 0] / np.maximum(pooled[:, 1], 1)
        std = np.where(pooled[:, 1] > 0.5 * pooled[:, 2], np.sqrt(square), np.inf)
        out.append(Map(key, low + size * (cells - 1), size, std))
    return out


def levels(found: Sequence[Map]) -> list[float]:
    """Edges in m between the levels of maps: even steps over nearly all of what they show."""
    every = np.concatenate([m.std[np.isfinite(m.std)] for m in found])
    low, high = (float(np.quantile(every, at)) for at in (0.02, 0.98)) if every.size else (0.0, 1.0)
    step = max(high - low, 1e-3 * high, 1e-12) / figures.LEVELS
    # Two digits of the step are enough for the legend.
    digit = 10.0 ** (np.floor(np.log10(step)) - 1)
    return (digit * np.round((low + step * np.arange(figures.LEVELS + 1)) / digit)).tolist()


def map_panels(w: Workspace) -> tuple[list[str], list[tuple[str, str]]]:
    """Maps of the predicted position std with measured samples, and their legend in mm."""
    found = maps(w)
    if not found:
        return [], []
    edges, out = levels(found), []
    good = w.std[np.isfinite(w.std)]
    thin = figures.subsample_indices(len(w.measured), 500)
    for m, title in zip(found, ("Seen from above", "Seen from the side"), strict=True):
        pick = ["xyz".index(name) for name in m.key]
        x, y = _square(w.points[:, pick], m.key)
        marks = [figures.heatmap(m.corners[:, 0], m.corners[:, 1], m.size, figures.level_of(m.std, edges))]
        marks.append(figures.dots(w.measured[thin, pick[0]], w.measured[thin, pick[1]], "measured"))
        text = (
            f"Map of the predicted standard deviation of the tool's position over {m.key[0]} and {m.key[1]}: "
            f"half of the configurations below {1e3 * float(np.median(good)):.3g} mm, 95 % below "
            f"{1e3 * float(np.quantile(good, 0.95)):.3g} mm."
        )
        out.append(axes(f"m-{m.key}", title, text, x, y, marks, figures.WIDE, SQUARE))
    places = figures.decimals(0.1 * 1e3 * (edges[1] - edges[0]))
    words = [f"{1e3 * edge:.{places}f}" for edge in edges]
    legend = [(f"level{i}", f"{a}–{b} mm") for i, (a, b) in enumerate(pairwise(words))]
    legend[0], legend[-1] = ("level0", f"below {words[1]} mm"), (legend[-1][0], f"above {words[-2]} mm")
    if not all(np.isfinite(m.std).all() for m in found):
        legend.append(("unknown", "cannot be predicted"))
    return out, [*legend, *([("dots measured", "measured samples")] if len(thin) else [])]


def _square(points: Array, names: str) -> tuple[Axis, Axis]:
    """Axes about points (m, 2) on which a metre is as long upwards as across."""
    low, high = points.min(0), points.max(0)
    middle, half = 0.5 * (low + high), 0.53 * max(float(np.max(high - low)), 1e-3)
    x, y = (Axis(float(c) - half, float(c) + half, f"{name} in the base frame, m")
            for c, name in zip(middle, names, strict=True))  # fmt: skip
    return x, y


def magnification(study: ReportContext) -> float:
    """How many times larger errors are drawn so that they show: round, from 1 to 500."""
    points = [
        np.array([body[3, :, 0] for body in chain.forward_kinematics(_pose(study)).bodies])
        for chain in (study.fit.nominal_refitted, study.fit.chain)
    ]
    off = float(np.linalg.norm(points[1] - points[0], axis=1).max())
    wanted = 0.05 * float(np.ptp(points[0], axis=0).max()) / max(off, 1e-12)
    return min(max(figures.nice_step(max(wanted, 1e-3) / 2), 1.0), 500.0)


def _pose(study: ReportContext) -> Array:
    """Joint values (1, n) of the fitted sample that is nearest the middle of all."""
    used = [item.configurations() for item in study.fit.data if item.configurations_per_row > 0]
    if not used:
        return np.zeros((1, study.fit.chain.n_joints))
    points = study.workspace.measured
    nearest = int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))
    return np.concatenate(used)[nearest : nearest + 1]


def arm(study: ReportContext) -> list[str]:
    """The arm's skeleton at one sample before and after, errors drawn larger, from two sides."""
    fit, larger = study.fit, magnification(study)
    into = se3.inverse(fit.chain.base)
    shapes = []
    for chain in (fit.nominal_refitted, fit.chain):
        frames = chain.forward_kinematics(_pose(study))
        points = np.array([*(body[3, :, 0] for body in frames.bodies), frames.tool[3, :, 0]])
        shapes.append(points @ into[:3, :3].T + into[:3, 3])
    nominal = shapes[0]
    drawn = nominal + larger * (shapes[1] - nominal)
    cloud = study.workspace.measured
    cloud = cloud[figures.subsample_indices(len(cloud), MAX_DOTS)]
    out = []
    for key, pick, title in (("xz", [0, 2], "From the side"), ("xy", [0, 1], "From above")):
        x, y = _square(np.concatenate([nominal, drawn, cloud])[:, pick], key)
        size = " large" if len(cloud) < MAX_SEPARATE_DOTS else ""
        marks = [figures.dots(cloud[:, pick[0]], cloud[:, pick[1]], f"faint{size}")]
        for points, look in ((nominal, "before"), (drawn, "after")):
            across, up = points[:, pick].T
            marks += [draw(across, up, look) for draw in (figures.line, figures.dots)]
        name = f"{title}, " + (f"errors drawn {larger:g} times larger" if larger > 1 else "true to scale")
        text = f"The arm's joints before and after calibration over {key[0]} and {key[1]}."
        out.append(axes(f"arm-{key}", name, text, x, y, marks, figures.WIDE, SQUARE))
    return out
