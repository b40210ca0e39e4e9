"""Plots of calibrations and studies with matplotlib.

Every plot function draws into the axes `ax`, or into a new figure if `ax` is None, and returns the axes:

    ax = plot_error_histogram(before, after, quantity="position error", unit="m")
    ax.figure.savefig("errors.png")

Arguments are in SI units; the axes show mm, mrad and degrees. No function uses `matplotlib.pyplot`, so plots
do not depend on a display or on figures of the caller. Only this module and
`calibration.presentation.fit_plots` import matplotlib. The imports are inside functions, because they take
about 0.4 s and most commands draw nothing.

`svg_panels` draws plots for a web page. The SVG is the same for the same data on every machine: identifiers
are hashed with a fixed salt, no date is written, and the layout is computed with the font that is part of
matplotlib. The colours in `COLORS` become CSS variables of the same names, so the light, dark and print
styles of the page apply.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal
from xml.etree import ElementTree

import numpy as np

from ._typing import Array
from .estimation.qr import RANK_RTOL
from .formatting import SMALL_UNITS, UNITS
from .subsampling import evenly_spaced_indices

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours after Okabe and Ito, darkened until they stand out on white. Names are those of the CSS variables.
COLORS = {
    "text": "#51606e",
    "grid": "#d4dce3",
    "before": "#0072b2",
    "after": "#b85c00",
    "sample": "#8496a5",
    "holdout": "#007a5e",
    "outlier": "#b0106a",
    "measured": "#d4452f",
    "unknown": "#e3e8ec",
    "level-0": "#00224e",
    "level-1": "#35456c",
    "level-2": "#666970",
    "level-3": "#948e77",
    "level-4": "#c8b866",
    "level-5": "#fee838",
}
# Colours of the verdicts of checks of a robot.
CHECK_COLORS = {"ok": "after", "changed": "outlier", "cannot say": "before"}
# Half width of a 95 % band in standard deviations.
BAND_SIGMAS = 1.96
# Number of levels of a map, from small to large standard deviations.
N_LEVELS = 6
# Colours of the lines of a study (Okabe and Ito) and the line styles of each further round of colours.
STUDY_COLORS = ("#0072b2", "#b85c00", "#009e73", "#b0106a", "#56b4e9", "#8a7400", "#17212b")
STUDY_LINE_STYLES = ("-", (0, (6, 3)), (0, (2, 2.5)))

# Size of a panel and of a wider panel, and side of the panel of a map [px].
PANEL = (320.0, 186.0)
WIDE_PANEL = (420.0, 186.0)
SQUARE_PANEL = (420.0, 406.0)
# Space around the axes of a panel for tick labels and axis labels [px].
_LEFT, _RIGHT, _TOP, _BOTTOM = 50.0, 10.0, 10.0, 36.0

# Class of the SVG group of an artist by its `gid`, for the scripts and styles of a page: dots and lines of
# samples, states of a calibration, and the vertical axis.
SVG_CLASSES = {
    "samples": "samples",
    "state-before": "state-before",
    "state-after": "state-after",
    "matplotlib.axis_2": "y-axis",
}

# Line style of the nominal robot: distinguishes it where colours do not.
DASHED = (0, (2.5, 1.6))
# Largest number of dots of one series.
MAX_DOTS = 800
# Series with fewer dots are drawn with larger dots.
_MAX_LARGE_DOTS = 100
# Diameter of small and large dots [pt].
DOT_SIZES = (3.0, 5.0)
# Largest number of bins of a histogram.
_MAX_BINS = 28
# The axis of a histogram is logarithmic if the medians before and after differ by more than this factor.
MAX_MEDIAN_RATIO = 4.0
# Number of parts of a joint's range with a median each, and fewest samples of a part.
_MEDIAN_PARTS, _MIN_PART_SAMPLES = 12, 5
# Cells along each side of a map.
_MAP_CELLS = 32
# Largest number of measured samples on a map; more would hide it.
_MAX_MAP_SAMPLES = 500

# Columns of a study that are plotted: title and factor from SI units.
STUDY_COLUMNS = {
    "position_rms[m]": ("position error, RMS [mm]", 1e3),
    "orientation_rms[rad]": ("orientation error, RMS [°]", 180 / math.pi),
    "length_error[m]": ("error of lengths, RMS [mm]", 1e3),
    "angle_error[rad]": ("error of angles, RMS [°]", 180 / math.pi),
}
# An axis of a study is logarithmic if its values span more than this factor: settings, errors.
_MIN_LOG_RATIO_X, _MIN_LOG_RATIO_Y = 8.0, 30.0
# Errors below this fraction of the largest one are rounding errors and are drawn at this fraction.
_ROUNDING = 1e-9

_RC_PARAMS: Any = {
    # This font is part of matplotlib, so text has the same size on every machine.
    "font.family": "DejaVu Sans",
    "font.size": 11,
    "axes.labelsize": 11,
    "axes.titlesize": 12,
    "xtick.labelsize": 11,
    "ytick.labelsize": 11,
    "legend.fontsize": 11,
    # A dollar sign in a name is no formula.
    "text.parse_math": False,
    "text.color": COLORS["text"],
    "axes.labelcolor": COLORS["text"],
    "xtick.labelcolor": COLORS["text"],
    "ytick.labelcolor": COLORS["text"],
    "axes.grid": True,
    "grid.color": COLORS["grid"],
    "grid.linewidth": 0.7,
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.spines.bottom": False,
    "xtick.bottom": False,
    "ytick.left": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.6,
    # A series of dots would lose those that lie close together.
    "path.simplify": False,
    # Text stays text: it can be searched, and it takes the font of the page.
    "svg.fonttype": "none",
}


# --- plots of a calibration -------------------------------------------------------------------------
def plot_error_histogram(
    before: Array,
    after: Array,
    ax: Axes | None = None,
    *,
    quantity: str = "position error",
    unit: str = "m",
    bins: tuple[Array, bool] | None = None,
) -> Axes:
    """Plot histograms of the errors before and after a calibration.

    The horizontal axis is logarithmic if the medians differ by more than a factor of four.
    """
    from matplotlib.ticker import MaxNLocator

    ax = _axes(ax)
    factor, unit_name = shown_unit(unit)
    edges, is_log = bins or histogram_edges(np.asarray(before), np.asarray(after))
    before, after, edges = factor * np.asarray(before), factor * np.asarray(after), factor * edges
    for state, values in (("before", before), ("after", after)):
        counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
        ax.stairs(
            counts,
            edges,
            fill=True,
            facecolor=(COLORS[state], 0.2),
            edgecolor=COLORS[state],
            linewidth=1.5,
            linestyle=DASHED if state == "before" else "-",
            label=state,
            gid=f"state-{state}",
        )
    if is_log:
        make_logarithmic(ax, "x")
    ax.set(xlabel=f"{quantity}, {unit_name}", ylabel="samples", xlim=(edges[0], edges[-1]))
    ax.set_ylim(0.0, max(5.0, ax.get_ylim()[1]))
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return ax


def histogram_edges(before: Array, after: Array) -> tuple[Array, bool]:
    """Choose the bins of histograms of the errors before and after a calibration."""
    errors = np.concatenate([before, after])
    high = float(errors.max()) or 1.0
    n_bins = min(_MAX_BINS, max(8, len(after) // 3))
    small, large = sorted((float(np.median(before)), float(np.median(after))))
    if large <= MAX_MEDIAN_RATIO * small or small == large:
        return np.linspace(0.0, high, n_bins + 1), False
    low = max(float(np.quantile(errors, 0.01)), 1e-6 * high)
    return np.geomspace(low, high, n_bins + 1), True


def plot_errors_by_sample(
    samples: Mapping[str, tuple[Array, Array]],
    ax: Axes | None = None,
    *,
    quantity: str = "position error",
    unit: str = "m",
    marks: Sequence[float] = (),
) -> Axes:
    """Plot the error of each sample over its number, with vertical lines at some numbers."""
    ax = _axes(ax)
    factor, unit_name = shown_unit(unit)
    n_samples = sum(len(numbers) for numbers, _ in samples.values())
    for role, (numbers, errors) in samples.items():
        if role == "outlier":
            size, limit = DOT_SIZES[1], len(numbers)
        else:
            size, limit = DOT_SIZES[n_samples < _MAX_LARGE_DOTS], 2 * MAX_DOTS
        chosen = evenly_spaced_indices(len(numbers), limit)
        color = COLORS[sample_color(role, has_holdout="hold-out" in samples)]
        plot_dots(ax, numbers[chosen], factor * errors[chosen], color, size, label=role)
    for mark in marks:
        ax.axvline(mark, color=COLORS["text"], linestyle="--", linewidth=1.2)
    ax.set(xlabel="sample", ylabel=f"{quantity}, {unit_name}")
    ax.set_ylim(bottom=0.0)
    return ax


def plot_change(
    numbers: Array, values: Array, std: Array, ax: Axes | None = None, *, of: str, unit: str
) -> Axes:
    """Plot a change of a part of a robot over the numbers of the samples, with its 95 % band."""
    ax = _axes(ax)
    factor, unit_name = shown_unit(unit)
    low, high = (factor * (values + sign * BAND_SIGMAS * std) for sign in (-1, 1))
    ax.fill_between(numbers, low, high, color=COLORS["after"], alpha=0.3, linewidth=0, step="mid")
    ax.step(numbers, factor * values, color=COLORS["after"], linewidth=1.6, where="mid")
    ax.set(xlabel="sample", ylabel=f"{of}, {unit_name}")
    return ax


def plot_checks(
    days: Array, residuals: Array, expected: Array, verdicts: Sequence[str], ax: Axes | None = None
) -> Axes:
    """Plot the residuals [m] of checks of a robot over the days before the last one, by verdict."""
    ax = _axes(ax)
    factor, unit_name = shown_unit("m")
    ax.plot(days, factor * residuals, color=COLORS["grid"], linewidth=1.2)
    # A single check has no line.
    ax.plot(days, factor * expected, color=COLORS["text"], linewidth=1.2, linestyle="--", marker="_")
    for verdict, color in CHECK_COLORS.items():
        chosen = np.array([each == verdict for each in verdicts])
        plot_dots(ax, days[chosen], factor * residuals[chosen], COLORS[color], DOT_SIZES[1], label=verdict)
    ax.set(xlabel="days before the last check", ylabel=f"RMS, {unit_name}")
    ax.set_ylim(bottom=0.0)
    return ax


def sample_color(role: str, has_holdout: bool) -> str:
    """Return the name in `COLORS` of the dots of "fitted", "hold-out", "outlier" or other samples."""
    if role == "fitted":
        return "sample" if has_holdout else "after"
    return {"hold-out": "holdout", "outlier": "outlier"}.get(role, "after")


def medians_by_part(x: Array, values: Array) -> tuple[Array, Array]:
    """Return centres and medians of the equal parts of the range of x that have enough values."""
    edges = np.linspace(x.min(), x.max(), _MEDIAN_PARTS + 1)
    part = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _MEDIAN_PARTS - 1)
    full = [k for k in range(_MEDIAN_PARTS) if np.sum(part == k) >= _MIN_PART_SAMPLES]
    return 0.5 * (edges[:-1] + edges[1:])[full], np.array([np.median(values[part == k]) for k in full])


def plot_errors_over_joint(
    values: Array,
    errors: Array,
    ax: Axes | None = None,
    *,
    joint: str = "joint position",
    is_prismatic: bool = False,
    quantity: str = "position error",
    unit: str = "m",
) -> Axes:
    """Plot the errors of the samples over the position of one joint, with their medians along its range."""
    ax = _axes(ax)
    scale, angle = shown_joint_unit(is_prismatic)
    factor, unit_name = shown_unit(unit)
    chosen = evenly_spaced_indices(len(values), MAX_DOTS)
    size = DOT_SIZES[len(chosen) < _MAX_LARGE_DOTS]
    plot_dots(ax, scale * values[chosen], factor * errors[chosen], COLORS["sample"], size, label="sample")
    centres, medians = medians_by_part(values, errors)
    if len(centres) > 1:
        ax.plot(scale * centres, factor * medians, color=COLORS["text"], label="median", gid="samples")
    ax.set(xlabel=f"{joint}, {angle}", ylabel=f"{quantity}, {unit_name}")
    ax.set_ylim(bottom=0.0)
    return ax


def plot_joint_offsets(
    centres: Array,
    offsets: Mapping[str, tuple[Array, Array]],
    ax: Axes | None = None,
    *,
    joint: str = "joint position",
    is_prismatic: bool = False,
    limit: float | None = None,
) -> Axes:
    """Plot the joint-angle error over the joint angle "before" and "after", with two standard errors.

    `limit` is the largest error that the vertical axis shows on both sides [rad or m]; from the data if None.
    """
    ax = _axes(ax)
    scale, angle = shown_joint_unit(is_prismatic)
    factor, unit_name = shown_unit("m" if is_prismatic else "rad")
    ax.axhline(0.0, color=COLORS["text"], linewidth=1.0)
    for state, (value, std) in offsets.items():
        container = ax.errorbar(
            scale * centres,
            factor * value,
            yerr=2 * factor * std,
            color=COLORS[state],
            linestyle=DASHED if state == "before" else "-",
            marker="o",
            markersize=DOT_SIZES[0] + 1,
            markeredgewidth=0,
            label=state,
        )
        for artist in container.get_children():
            artist.set_gid(f"state-{state}")
    if limit is None:
        limit = max(float(np.max(np.abs(value) + 2 * std)) for value, std in offsets.values())
    half = 1.05 * factor * limit or 1.0
    ax.set(xlabel=f"{joint}, {angle}", ylabel=f"joint error, {unit_name}", ylim=(-half, half))
    return ax


def plot_joint_corrections(
    values: Array,
    correction: Array,
    std: Array,
    ax: Axes | None = None,
    *,
    gaps: Sequence[tuple[float, float]] = (),
    joint: str = "joint position",
    limit: float | None = None,
) -> Axes:
    """Plot the correction of a joint over its position, with its 95 % band and the gaps between measurements.

    `limit` is the largest correction that the vertical axis shows on both sides [rad]; from the data if None.
    """
    from matplotlib.ticker import MaxNLocator

    ax = _axes(ax)
    scale, angle = shown_joint_unit(is_prismatic=False)
    factor, unit_name = shown_unit("rad")
    for number, (low, high) in enumerate(gaps):
        label = "_" * bool(number) + "not measured"
        ax.axvspan(scale * low, scale * high, color=COLORS["unknown"], linewidth=0, label=label)
    ax.axhline(0.0, color=COLORS["text"], linewidth=1.0)
    largest = np.abs(correction) + BAND_SIGMAS * std
    if limit is None:
        limit = float(np.max(largest[np.isfinite(largest)], initial=0.0))
    half = 1.05 * factor * limit or 1.0
    # An infinite standard deviation fills the height of the axes.
    reach = np.minimum(BAND_SIGMAS * factor * std, 4 * half)
    x, middle = scale * values, factor * correction
    band = ax.fill_between(x, middle - reach, middle + reach, linewidth=0, label="95 % band")
    band.set_facecolor((COLORS["after"], 0.25))
    ax.plot(x, middle, color=COLORS["after"], linewidth=1.2, label="correction")
    ax.set(xlabel=f"{joint}, {angle}", ylabel=f"correction, {unit_name}")
    ax.set(xlim=(x[0], x[-1]), ylim=(-half, half))
    # Steps of 90°, 45°, 30° and the like.
    ax.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 1.5, 3, 4.5, 9, 10]))
    return ax


def plot_singular_values(singular_values: Array, rank: int, ax: Axes | None = None) -> Axes:
    """Plot the singular values of the whitened Jacobian relative to the largest one."""
    ax = _axes(ax)
    # Exact zeros are drawn at this ratio, below every rounding error.
    ratios = np.maximum(singular_values / singular_values[0], 1e-18)
    numbers = np.arange(1, len(ratios) + 1)
    plot_dots(ax, numbers[:rank], ratios[:rank], COLORS["after"], DOT_SIZES[1], label="observable")
    if rank < len(ratios):
        ax.axhline(RANK_RTOL, color=COLORS["outlier"], linewidth=1.0, linestyle=":")
        plot_dots(ax, numbers[rank:], ratios[rank:], COLORS["outlier"], DOT_SIZES[1], label="not observable")
    ax.set(xlabel="direction", ylabel="relative to the largest", xlim=(0, len(ratios) + 1))
    lowest = min(float(ratios.min()), 0.1)
    make_logarithmic(ax, "y")
    ax.set_ylim(10.0 ** math.floor(math.log10(lowest)), 2.0)
    return ax


def plot_plan_curve(
    planned: tuple[Array, Array],
    random: tuple[Array, Array],
    chosen: tuple[int, float],
    recommended_size: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the predicted error over the number of poses.

    `planned`, `random` and `chosen` are numbers of poses with their predicted RMS position errors [m]. The
    recommended size is that with diminishing returns.
    """
    ax = _axes(ax)
    ax.plot(
        random[0],
        1e3 * np.asarray(random[1]),
        "s",
        color=COLORS["before"],
        linestyle=DASHED,
        markersize=DOT_SIZES[1],
        label="random poses",
    )
    ax.plot(
        planned[0], 1e3 * np.asarray(planned[1]), color=COLORS["after"], linewidth=2.0, label="planned poses"
    )
    plot_dots(ax, np.array([chosen[0]]), 1e3 * np.array([chosen[1]]), COLORS["after"], 8.0, label="this plan")
    if recommended_size:
        ax.axvline(recommended_size, color=COLORS["text"], linestyle=":", linewidth=1.2, label="recommended")
    make_logarithmic(ax, "x")
    make_logarithmic(ax, "y")
    ax.set(xlabel="measured poses", ylabel="predicted position error, mm RMS")
    ax.legend(frameon=False)
    return ax


# --- plots of the workspace -------------------------------------------------------------------------
def plot_position_std_map(
    points: Array,
    std: Array,
    ax: Axes | None = None,
    *,
    plane: str = "xz",
    measured: Array | None = None,
    levels: Array | None = None,
    region: Array | None = None,
) -> Axes:
    """Plot a map of the predicted standard deviation of the tool position, or of measured errors.

    A cell shows the RMS along the line of sight of the points in it and in its eight neighbours, so that a
    few points do not look like speckles. The standard deviations [m] are infinite where they cannot be
    predicted. The plane is "xy", "xz" or "yz". With the edges between the colours in `levels`, several maps
    share a scale. The axes contain `region`, which contains the points.
    """
    ax = _axes(ax)
    columns = ["xyz".index(name) for name in plane]
    shown = (points if region is None else region)[:, columns]
    corners, size, cell_std = _map_cells(points[:, columns], std, shown)
    edges = std_levels(std) if levels is None else levels
    level = np.searchsorted(edges[1:-1], cell_std, side="right")
    for k in range(N_LEVELS):
        _fill_cells(ax, corners[np.isfinite(cell_std) & (level == k)], size, COLORS[f"level-{k}"])
    _fill_cells(ax, corners[~np.isfinite(cell_std)], size, COLORS["unknown"])
    if measured is not None and len(measured):
        chosen = measured[evenly_spaced_indices(len(measured), _MAX_MAP_SAMPLES)][:, columns]
        plot_dots(ax, chosen[:, 0], chosen[:, 1], COLORS["measured"], 2.4, label="measured samples")
    _show_plane(ax, shown, plane)
    return ax


def std_levels(std: Array) -> Array:
    """Return the edges between the levels of a map, evenly spaced from zero."""
    finite = std[np.isfinite(std)]
    high = max(float(np.quantile(finite, 0.98)), 2 * float(np.median(finite))) if finite.size else 0.0
    step = max(high, 1e-12) / N_LEVELS
    # Two significant digits are enough for a legend.
    digit = 10.0 ** (math.floor(math.log10(step)) - 1)
    return digit * math.ceil(step / digit - 1e-9) * np.arange(N_LEVELS + 1)


def _map_cells(points: Array, std: Array, region: Array) -> tuple[Array, float, Array]:
    """Return lower corners (c, 2), side and pooled std (c,) of the cells of a region with points (s, 2)."""
    low = region.min(0)
    size = float(np.ptp(region, axis=0).max()) / _MAP_CELLS or 1.0
    cell = np.floor((points - low) / size).astype(int)
    is_known = np.isfinite(std)
    # Sums of squares, of known points and of all points, with a border of one cell for the neighbours.
    sums = np.zeros((3, _MAP_CELLS + 3, _MAP_CELLS + 3))
    for layer, weight in zip(
        sums, (np.where(is_known, std, 0.0) ** 2, is_known, np.ones(len(std))), strict=True
    ):
        np.add.at(layer, (cell[:, 0] + 1, cell[:, 1] + 1), weight)
    cells = np.argwhere(sums[2] > 0)
    pooled = np.array([sums[:, i - 1 : i + 2, j - 1 : j + 2].sum((1, 2)) for i, j in cells])
    mean_square = pooled[:, 0] / np.maximum(pooled[:, 1], 1)
    cell_std = np.where(pooled[:, 1] > 0.5 * pooled[:, 2], np.sqrt(mean_square), np.inf)
    return low + size * (cells - 1), size, cell_std


def _fill_cells(ax: Axes, corners: Array, size: float, color: str) -> None:
    """Fill squares with lower corners (c, 2) as one path; one artist per square would be slow and large."""
    if not len(corners):
        return
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    outline = size * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    vertices = (corners[:, None] + outline).reshape(-1, 2)
    codes = np.tile([Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY], len(corners))
    # `add_patch` would compute the limits of the axes from every vertex, which takes most of the time.
    ax.add_artist(PathPatch(Path(vertices, codes), facecolor=color, edgecolor="none", antialiased=False))


def plot_arms(
    arms: Mapping[str, Array], ax: Axes | None = None, *, plane: str = "xz", samples: Array | None = None
) -> Axes:
    """Plot the joints of an arm before and after calibration as connected points."""
    ax = _axes(ax)
    columns = ["xyz".index(name) for name in plane]
    shown = [points[:, columns] for points in arms.values()]
    if samples is not None and len(samples):
        chosen = samples[evenly_spaced_indices(len(samples), MAX_DOTS)][:, columns]
        size = DOT_SIZES[len(chosen) < _MAX_LARGE_DOTS]
        plot_dots(ax, chosen[:, 0], chosen[:, 1], COLORS["sample"], size, label="samples")
        shown.append(chosen)
    for state, points in arms.items():
        ax.plot(
            *points[:, columns].T,
            color=COLORS[state],
            linestyle=DASHED if state == "before" else "-",
            marker="o",
            markersize=DOT_SIZES[1],
            markeredgewidth=0,
            label=state,
        )
    _show_plane(ax, np.concatenate(shown), plane)
    return ax


def _show_plane(ax: Axes, points: Array, plane: str) -> None:
    """Show points (m, 2) with the same scale on both axes."""
    low, high = points.min(0), points.max(0)
    middle, half = 0.5 * (low + high), 0.53 * max(float(np.max(high - low)), 1e-3)
    ax.set(
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        xlabel=f"{plane[0]} in the base frame, m",
        ylabel=f"{plane[1]} in the base frame, m",
        aspect="equal",
    )


# --- plots of a study -------------------------------------------------------------------------------
def plot_study(
    header: Sequence[str],
    rows: Sequence[Sequence[Any]],
    n_settings: int,
    column: str,
    ax: Axes | None = None,
) -> Axes:
    """Plot one column of a study over the setting with the most numbers, a line per choice of the others."""
    ax = _axes(ax)
    abscissa = _study_abscissa(rows, n_settings)
    if abscissa is None:
        raise ValueError("no numeric setting of the study varies; nothing to plot over")
    title, factor = STUDY_COLUMNS[column]
    index = header.index(column)
    lines = {
        label: np.array(
            sorted((row[abscissa], factor * row[index]) for row in group if row[index] is not None)
        )
        for label, group in _study_series(header, rows, n_settings, abscissa).items()
    }
    points = np.concatenate([line.reshape(-1, 2) for line in lines.values()])
    floor = _ROUNDING * points[:, 1].max()
    for number, (label, line) in enumerate(lines.items()):
        if not len(line):
            continue
        cycle, color = divmod(number, len(STUDY_COLORS))
        ax.plot(
            line[:, 0],
            np.maximum(line[:, 1], floor),
            color=STUDY_COLORS[color],
            linestyle=STUDY_LINE_STYLES[cycle % len(STUDY_LINE_STYLES)],
            marker="o",
            markersize=DOT_SIZES[0] + 1,
            markeredgewidth=0,
            label=label,
        )
    ax.set(title=title, xlabel=header[abscissa].replace("_", " "), ylabel="median")
    errors = np.maximum(points[:, 1], floor)
    if 0 < points[:, 0].min() and points[:, 0].max() > _MIN_LOG_RATIO_X * points[:, 0].min():
        make_logarithmic(ax, "x")
    if 0 < errors.min() and errors.max() > _MIN_LOG_RATIO_Y * errors.min():
        make_logarithmic(ax, "y")
    elif errors.min() >= 0:
        ax.set_ylim(bottom=0.0)
    return ax


def _study_abscissa(rows: Sequence[Sequence[Any]], n_settings: int) -> int | None:
    """Return the column of the varied numeric setting with the most values."""
    counts = {i: len({row[i] for row in rows}) for i in range(n_settings)}
    numeric = [i for i in counts if counts[i] > 1 and all(type(row[i]) in (int, float) for row in rows)]
    return max(numeric, key=lambda i: counts[i]) if numeric else None


def _study_series(
    header: Sequence[str], rows: Sequence[Sequence[Any]], n_settings: int, abscissa: int
) -> dict[str, list[Sequence[Any]]]:
    """Group the rows by the other varied settings; the label of a group names their values."""
    varied = [i for i in range(n_settings) if i != abscissa and len({row[i] for row in rows}) > 1]
    series: dict[str, list[Sequence[Any]]] = {}
    for row in rows:
        label = ", ".join(f"{header[i].replace('_', ' ')} {row[i]}" for i in varied) or "all"
        series.setdefault(label, []).append(row)
    return series


def study_svg(title: str, header: Sequence[str], rows: Sequence[Sequence[Any]], n_settings: int) -> str:
    """Draw the table of a study as one SVG file with a panel per column."""
    if _study_abscissa(rows, n_settings) is None:
        return ""
    columns = [name for name in STUDY_COLUMNS if any(row[header.index(name)] is not None for row in rows)]
    with _svg_style():
        from matplotlib.figure import Figure

        n_across = min(2, len(columns))
        n_down = math.ceil(len(columns) / n_across)
        figure = Figure(facecolor="white")
        panels = figure.subplots(n_down, n_across, squeeze=False)
        for name, ax in zip(columns, panels.flat, strict=False):
            plot_study(header, rows, n_settings, name, ax)
        for ax in panels.flat[len(columns) :]:
            ax.set_axis_off()
        handles, labels = panels.flat[0].get_legend_handles_labels()
        longest = max(map(len, labels))
        n_label_columns = max(1, int(430 * n_across // (60 + 7 * longest)))
        legend_height = 20.0 * math.ceil(len(labels) / n_label_columns) + 16
        width, height = 434.0 * n_across, 274.0 * n_down + legend_height + 30
        figure.set_size_inches(width / 72, height / 72)
        figure.subplots_adjust(
            left=62 / width,
            right=1 - 16 / width,
            top=1 - 58 / height,
            bottom=(legend_height + 42) / height,
            wspace=0.2,
            hspace=0.36,
        )
        figure.text(8 / width, 1 - 20 / height, title, fontsize=13)
        figure.legend(
            handles,
            labels,
            loc="lower left",
            bbox_to_anchor=(0, 4 / height),
            ncols=n_label_columns,
            frameon=False,
        )
        root = _svg_tree(figure, "study")
    # Pixels instead of points: the size of the text is then that of the report.
    root.attrib |= {"xmlns": "http://www.w3.org/2000/svg", "width": f"{width:g}", "height": f"{height:g}"}
    return ElementTree.tostring(root, "unicode") + "\n"


# --- SVG --------------------------------------------------------------------------------------------
@contextmanager
def svg_panels() -> Iterator[SvgPanels]:
    """Draw plots as SVG elements of a web page.

    with svg_panels() as svg:
        element = svg.draw(partial(plot_singular_values, values, rank), "sv", "Singular values", "...")
    """
    with _svg_style():
        yield SvgPanels()


class SvgPanels:
    """Series of plots as SVG elements of one web page; `svg_panels` provides it.

    The axes are reused from panel to panel, because creating axes takes longer than drawing into them.
    """

    def __init__(self) -> None:
        self._figures: dict[tuple[float, float], Figure] = {}

    def draw(
        self,
        plot: Callable[..., object],
        key: str,
        title: str,
        description: str,
        size: tuple[float, float] = PANEL,
    ) -> str:
        """Draw a plot as an SVG element."""
        figure = self._empty_figure(size)
        ax = figure.axes[0]
        plot(ax=ax)
        root = _svg_tree(figure, key)
        # The scripts of a page place marks with the frame [px] and the ranges of the axes.
        width, height = size
        frame = (_LEFT, _TOP, width - _RIGHT, height - _BOTTOM)
        for name, numbers in (("frame", frame), ("x", ax.get_xlim()), ("y", ax.get_ylim())):
            root.set(f"data-{name}", " ".join(f"{number:.9g}" for number in numbers))
        variables = {color: f"var(--{name})" for name, color in COLORS.items()}
        for element in root.iter():
            if style := element.get("style"):
                style = re.sub(r"font-family:[^;]*;? ?", "", style)
                style = re.sub("#[0-9a-f]{6}", lambda color: variables.get(color[0], color[0]), style)
                element.set("style", style)
        for name in ("width", "height", "version"):
            root.attrib.pop(name, None)
        root.set("role", "img")
        root.set("aria-labelledby", f"{key}-t {key}-d")
        for position, (tag, text) in enumerate((("title", title), ("desc", description))):
            element = ElementTree.Element(tag, id=f"{key}-{tag[0]}")
            element.text = text
            root.insert(position, element)
        return ElementTree.tostring(root, "unicode")

    def _empty_figure(self, size: tuple[float, float]) -> Figure:
        """Return a figure of this size with empty axes."""
        width, height = size
        if (figure := self._figures.get(size)) is not None:
            ax = figure.axes[0]
            for artist in (*ax.lines, *ax.patches, *ax.collections):
                artist.remove()
            ax.containers.clear()
            ax.set(xscale="linear", yscale="linear", aspect="auto")
            ax.relim()
            ax.autoscale()
        else:
            from matplotlib.figure import Figure

            figure = Figure(figsize=(width / 72, height / 72))
            ax = figure.add_axes(
                (_LEFT / width, _BOTTOM / height, 1 - (_LEFT + _RIGHT) / width, 1 - (_TOP + _BOTTOM) / height)
            )
            figure.patch.set_visible(False)
            ax.patch.set_visible(False)
            # Fixed positions of the labels save the time to measure all tick labels.
            ax.xaxis.set_label_coords(0.5, -22 / (height - _TOP - _BOTTOM))
            ax.yaxis.set_label_coords(-36 / (width - _LEFT - _RIGHT), 0.5)
            self._figures[size] = figure
        ax.locator_params(nbins=5)
        return figure


@contextmanager
def _svg_style() -> Iterator[None]:
    """Replace the matplotlib settings of the caller by those of the project."""
    import matplotlib

    with matplotlib.rc_context(), warnings.catch_warnings():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC_PARAMS)
        # The font measures text only; the browser has the letters that it lacks.
        warnings.filterwarnings("ignore", r"Glyph .* missing from", UserWarning)
        yield


def _svg_tree(figure: Figure, key: str) -> ElementTree.Element:
    """Draw a figure as a compact SVG tree whose identifiers are hashed with `key`."""
    import matplotlib
    from matplotlib.backends.backend_svg import RendererSVG
    from matplotlib.path import Path

    class Renderer(RendererSVG):
        """Renderer that writes all dots of a series as one path; one element each is slow and large."""

        def draw_markers(
            self, gc: Any, marker_path: Any, marker_trans: Any, path: Any, trans: Any, rgbFace: Any = None
        ) -> None:
            if marker_path is not Path.unit_circle():
                super().draw_markers(gc, marker_path, marker_trans, path, trans, rgbFace)
                return
            # A line of length zero with round ends is a dot.
            dots = Path(np.repeat(path.vertices, 2, axis=0), [Path.MOVETO, Path.LINETO] * len(path.vertices))
            pen = self.new_gc()
            pen.copy_properties(gc)
            pen.set_foreground(rgbFace)
            pen.set_linewidth(marker_path.get_extents(marker_trans).width)
            pen.set_capstyle("round")
            self.draw_path(pen, dots, trans)

    matplotlib.rcParams["svg.hashsalt"] = key
    buffer = io.StringIO()
    figure.set_dpi(72)
    width, height = figure.get_size_inches() * 72
    metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    renderer = Renderer(width, height, buffer, metadata=metadata)
    figure.draw(renderer)
    renderer.finalize()
    root = ElementTree.fromstring(buffer.getvalue())
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        element.text = (element.text or "").strip() or None
        element.tail = None
        if element.tag == "g":
            name = element.attrib.pop("id", "")
            if name in SVG_CLASSES:
                element.set("class", SVG_CLASSES[name])
        if outline := element.get("d"):
            # A hundredth of a pixel is enough.
            outline = re.sub(r"(?<=\.\d\d)\d+", "", " ".join(outline.split()))
            element.set("d", re.sub(r"M (\S+ \S+) L \1 ?(?=M|$)", r"M\1h0", outline))
        if "rotate(-0 " in element.get("transform", ""):
            del element.attrib["transform"]
        for name in [name for name in element.attrib if name.startswith("{")]:
            element.set(name.rpartition("}")[2], element.attrib.pop(name))
    for child in list(root):
        # The style sheet would apply to the whole page; `_RC_PARAMS` and the page set what it sets.
        if child.tag == "metadata" or (child.tag == "defs" and child.find("style") is not None):
            root.remove(child)
    return root


# --- shared by the plots ----------------------------------------------------------------------------
def new_axes(n_panels: int = 1, size: tuple[float, float] = (6.4, 3.6)) -> list[Axes]:
    """Create axes in the style of this package, in a new figure that does not depend on a display."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    n_across = min(3, n_panels)
    n_down = math.ceil(n_panels / n_across)
    with mpl.rc_context(_RC_PARAMS):
        figure = Figure((size[0] * n_across, size[1] * n_down), layout="constrained")
        panels = list(figure.subplots(n_down, n_across, squeeze=False).flat)
    for unused in panels[n_panels:]:
        unused.set_axis_off()
    return panels[:n_panels]


def _axes(ax: Axes | None) -> Axes:
    return ax if ax is not None else new_axes()[0]


def shown_unit(unit: str) -> tuple[float, str]:
    """Return the unit in which errors are shown."""
    factor, name = SMALL_UNITS[unit]
    return factor, name.strip()


def shown_joint_unit(is_prismatic: bool) -> tuple[float, str]:
    """Return the unit in which joint positions are shown."""
    factor, name = UNITS["m" if is_prismatic else "rad"]
    return factor, name.strip()


def plot_dots(ax: Axes, x: Array, y: Array, color: str, size: float, label: str) -> None:
    """Plot dots of a diameter `size` [pt]."""
    ax.plot(
        x,
        y,
        "o",
        color=color,
        alpha=0.8,
        markersize=size,
        markeredgewidth=0,
        linestyle="none",
        label=label,
        gid="samples",
    )


def make_logarithmic(ax: Axes, name: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with plain numbers at 1, 2 and 5 in each decade if there are few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis = ax.xaxis if name == "x" else ax.yaxis
    ax.set(**{f"{name}scale": "log"})
    low, high = axis.get_data_interval()
    subs = (1.0, 2.0, 5.0) if high < 50 * low else (1.0, 3.0) if high < 1000 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12 if len(subs) > 1 else 6))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _power_text(value)))


def _power_text(value: float) -> str:
    """Return the text of a tick; distant powers of ten with a superscript."""
    mantissa, exponent = f"{value:.0e}".split("e")
    # "0.001" would reach the label of the axis.
    if 0.999e-3 < value < 1e4 and (mantissa, exponent) != ("1", "-03"):
        return f"{value:g}"
    superscript = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{superscript}" if mantissa == "1" else f"{mantissa}·10{superscript}"
