"""Plots of corners in images, with the axes of an image: u to the right and v down."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .. import plots
from .._typing import Array
from ..plots import COLORS, DOT_SIZES

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_reprojection(
    pixels: Array, errors: Array, size: tuple[int, int], magnification: float, ax: Axes | None = None
) -> Axes:
    """Plot the errors (m, 2) of corners (m, 2) [px], magnified, as lines over the image plane."""
    ax = ax if ax is not None else plots.new_axes()[0]
    ends = pixels - magnification * errors
    lines = np.stack([pixels, ends, np.full_like(ends, np.nan)], 1).reshape(-1, 2)
    ax.plot(lines[:, 0], lines[:, 1], color=COLORS["after"], linewidth=0.8)
    plots.plot_dots(ax, pixels[:, 0], pixels[:, 1], COLORS["sample"], DOT_SIZES[0], label="corner")
    width, height = size
    ax.plot([0, width, width, 0, 0], [0, 0, height, height, 0], color=COLORS["grid"], linewidth=1.2)
    ax.set(xlabel="u, px", ylabel="v, px", aspect="equal")
    ax.set(xlim=(-0.02 * width, 1.02 * width), ylim=(1.02 * height, -0.02 * height))
    return ax


def plot_image_errors(before: Array, after: Array, ax: Axes | None = None) -> Axes:
    """Plot the RMS error of each image over its place, the fitted images before the held-out ones."""
    ax = ax if ax is not None else plots.new_axes()[0]
    numbers = np.arange(1, len(after) + 1)
    for label, values in (("before", before), ("after", after)):
        plots.plot_dots(ax, numbers, values, COLORS[label], DOT_SIZES[1], label=label)
    ax.set(xlabel="images, fitted ones first", ylabel="RMS error, px")
    ratio = float(np.median(before)) / max(float(np.median(after)), 1e-12)
    if min(float(before.min()), float(after.min())) > 0 and ratio > plots.MAX_MEDIAN_RATIO:
        plots.make_logarithmic(ax, "y")
    else:
        ax.set_ylim(bottom=0.0)
    return ax
