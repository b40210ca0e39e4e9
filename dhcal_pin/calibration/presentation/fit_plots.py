"""Plots and tables that a result makes of itself, for people who explore it in Python.

Long series are thinned evenly, so that a plot of many samples is as fast as one of few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ... import formatting, plots
from ..._frozen import frozen
from ..._typing import Array
from ...exceptions import InvalidArgumentError, UnknownNameError
from ...measurements.groups import ERROR_GROUPS, in_order
from ...plots import COLORS, DOT_SIZES, MAX_DOTS, new_axes
from ...subsampling import evenly_spaced_indices
from ..evaluation import Comparison
from ..summary import describe_convergence, generalization_lines, headline, largest_corrections
from .curves import joint_curves
from .workspace import predict_workspace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

    from ..evaluation import ErrorStatistics
    from ..evidence import Evidence

# Largest number of rows of a plot of parameters, and of names beside a matrix.
MAX_PARAMETERS, _MAX_NAMES = 40, 60
# Widths of the bands of the prior, in its standard deviations.
_PRIOR_BANDS = (2.0, 1.0)
# Longest text of a legend with several texts in a row.
_MAX_LABEL_CHARS = 25


@frozen(eq=False)
class SampleErrors:
    """Errors of N samples before and after a calibration, in one group of errors."""

    group: str  # "position", "orientation" or "residual"
    unit: str  # SI unit of the errors
    before: Array  # Error norms of the nominal robot, shape (N,) [`unit`]
    after: Array  # Error norms of the calibrated robot, shape (N,) [`unit`]
    is_holdout: Array  # Whether each sample was held out, shape (N,)
    is_outlier: Array  # Whether each sample is an outlier, shape (N,)
    index: Array  # Index of each sample among all samples, fitted ones first, shape (N,)

    @classmethod
    def from_fit(cls, fit: Evidence, group: str | None) -> SampleErrors:
        """Compute the errors of the fitted and the held-out samples."""
        norms, table = fit.error_norms, fit.residuals
        name = _chosen_group(group, in_order(norms))
        before, after = norms[name]
        index = np.flatnonzero(np.isfinite(after))
        return cls(
            name,
            ERROR_GROUPS[name].unit,
            before[index],
            after[index],
            table.is_holdout[index],
            table.is_outlier[index],
            index,
        )

    @property
    def label(self) -> str:
        """Text of an axis with these errors."""
        return f"{ERROR_GROUPS[self.group].label}, {plots.shown_unit(self.unit)[1]}"

    @property
    def is_wide(self) -> bool:
        """Whether an axis with the errors before and after needs a logarithmic scale."""
        small, large = sorted(float(np.median(each)) for each in (self.before, self.after))
        return small > 0 and large > plots.MAX_MEDIAN_RATIO * small

    def series(self) -> Iterator[tuple[str, str, Array, Array]]:
        """Yield label, colour, choice of samples (N,) and errors (N,) [shown unit] of each series of dots."""
        factor = plots.shown_unit(self.unit)[0]
        has_holdout = bool(self.is_holdout.any())
        everything = np.ones(len(self.after), bool)
        yield "before", COLORS["before"], everything, factor * self.before
        fitted = ~self.is_holdout & ~self.is_outlier
        yield "after, fitted", COLORS["sample" if has_holdout else "after"], fitted, factor * self.after
        for label, color, chosen in (
            ("after, hold-out", COLORS["after"], self.is_holdout & ~self.is_outlier),
            ("after, outlier", COLORS["outlier"], self.is_outlier),
        ):
            if chosen.any():
                yield label, color, chosen, factor * self.after


def _chosen_group(group: str | None, choices: Sequence[str]) -> str:
    """Return a group of errors that was measured, the first one if none is chosen."""
    if group is not None and group not in choices:
        raise UnknownNameError(f"group {group!r}: not measured; choose from {', '.join(choices)}")
    return group or choices[0]


def _comparison_label(comparison: Comparison, group: str) -> str:
    """Describe the samples of a comparison."""
    if comparison.title == "region hold-out":
        return "left-out regions"
    return f"{comparison.after.groups[group].samples} {comparison.title}"


def _abscissa(fit: Evidence, over: str | Array) -> tuple[Array, str]:
    """Return the horizontal coordinate of each sample (N,) and its label."""
    n_samples = len(fit.residuals)
    if not isinstance(over, str):
        values = np.asarray(over, float)
        if values.shape != (n_samples,):
            raise UnknownNameError(
                f"over: shape {values.shape}; expected one number per sample, ({n_samples},)"
            )
        return values, ""
    if over == "sample":
        return np.arange(1, n_samples + 1, dtype=float), "sample"
    names = fit.chain.joint_names
    if over not in names:
        choices = ", ".join(["sample", "histogram", *names])
        raise UnknownNameError(
            f"over {over!r}: unknown; choose from {choices}, or give one number per sample"
        )
    joint = names.index(over)
    scale, unit = plots.shown_joint_unit(bool(fit.chain.is_prismatic[joint]))
    columns = []
    for item in (*fit.data, *fit.holdout):
        q = item.configurations()
        is_single = item.configurations_per_row == 1
        columns.append(q[:, joint] if is_single else np.full(len(item.rows), np.nan))
    return scale * np.concatenate(columns), f"{over}, {unit}"


def _plot_medians(ax: Axes, x: Array, values: Array, state: str, unit: str) -> None:
    """Plot the medians of the errors in equal parts of the horizontal axis."""
    if not len(x):
        return
    centres, medians = plots.medians_by_part(x, values)
    if len(centres) > 1:
        medians = plots.shown_unit(unit)[0] * medians
        ax.plot(centres, medians, color=COLORS[state], linewidth=2.0, label=f"{state}, median")


def _plot_histogram(errors: SampleErrors, ax: Axes) -> None:
    """Plot histograms of the errors, as shares of the fitted and of the held-out samples."""
    factor = plots.shown_unit(errors.unit)[0]
    edges, is_log = plots.histogram_edges(factor * errors.before, factor * errors.after)
    for state, values in (("before", errors.before), ("after", errors.after)):
        for title, chosen in (("fitted", ~errors.is_holdout), ("hold-out", errors.is_holdout)):
            if not chosen.any():
                continue
            inside = np.clip(factor * values[chosen], edges[0], edges[-1])
            share = 100 * np.histogram(inside, edges)[0] / chosen.sum()
            is_fitted = title == "fitted"
            ax.stairs(
                share,
                edges,
                fill=is_fitted,
                facecolor=(COLORS[state], 0.25 if is_fitted else 0.0),
                edgecolor=COLORS[state],
                linewidth=0.8 if is_fitted else 1.6,
                label=f"{state}, {title}",
            )
    if is_log:
        plots.make_logarithmic(ax, "x")
    ax.set(xlabel=errors.label, ylabel="share of the samples, %", xlim=(edges[0], edges[-1]))
    _legend(ax)


def _add_scale(ax: Axes, image: ScalarMappable, label: str) -> None:
    """Add a scale of colours beside the axes."""
    if ax.figure is None:
        return
    scale = ax.figure.colorbar(image, ax=ax, shrink=0.8)
    scale.set_label(label, color=COLORS["text"])
    scale.ax.tick_params(colors=COLORS["text"])
    scale.outline.set_visible(False)  # pyright: ignore


def _legend(ax: Axes) -> None:
    """Add a legend above the axes if there is more than one series."""
    handles, labels = ax.get_legend_handles_labels()
    # Long labels in a row would squeeze the axes.
    is_long = max(map(len, labels), default=0) > _MAX_LABEL_CHARS
    if len(handles) > 1:
        ax.legend(
            handles,
            labels,
            frameon=False,
            fontsize="small",
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=1 if is_long else 3,
            borderaxespad=0.2,
            handlelength=1.4,
            columnspacing=1.2,
        )


class ResultPlots:
    """Methods of `Result` that draw or tabulate it.

    Every plot is drawn into the axes `ax`, or into a new figure if `ax` is None, and the axes are returned:

        ax = fit.plot_accuracy()
        ax.figure.savefig("accuracy.png")

    A notebook shows the figure of the axes, `fit.plot_accuracy().figure`.
    """

    @property
    def _result(self) -> Evidence:
        return cast("Evidence", self)

    def plot_accuracy(self, ax: Axes | None = None, *, group: str | None = None) -> Axes:
        """Plot the error before and after: RMS as a dot, and a line up to the 95th percentile.

        Example:
            `fit.plot_accuracy().figure.savefig("accuracy.png")`

        Args:
            ax: Axes to draw into; a new figure if None.
            group: "position", "orientation" or "residual"; the first that was measured if None.

        Returns:
            The axes.
        """
        fit = self._result
        ax = ax or new_axes()[0]
        regions = fit.generalization.region_holdout
        comparisons = list(fit.comparisons)
        if regions is not None and all(each.title != "region hold-out" for each in comparisons):
            comparisons.insert(-1, regions)
        name = _chosen_group(group, list(comparisons[0].after.groups))
        rows = [each for each in comparisons if name in each.after.groups]
        factor, unit = plots.shown_unit(ERROR_GROUPS[name].unit)
        values = []
        for state, offset in (("before", -0.14), ("after", 0.14)):
            sides: list[ErrorStatistics] = [getattr(each, state).groups[name] for each in rows]
            height = np.arange(len(rows)) + offset
            rms, p95 = (factor * np.array([getattr(side, key) for side in sides]) for key in ("rms", "p95"))
            ax.hlines(height, rms, p95, color=COLORS[state], linewidth=1.6)
            plots.plot_dots(ax, rms, height, COLORS[state], 7.0, label=f"{state}, RMS")
            ax.plot(p95, height, "|", color=COLORS[state], markersize=9, label=f"{state}, 95th percentile")
            values += [*rms, *p95]
        ax.set_yticks(range(len(rows)), [_comparison_label(each, name) for each in rows])
        ax.set(xlabel=f"{ERROR_GROUPS[name].label}, {unit}", ylim=(len(rows) - 0.5, -0.5))
        if 0 < min(values) and max(values) > plots.MAX_MEDIAN_RATIO * min(values):
            plots.make_logarithmic(ax, "x")
        else:
            ax.set_xlim(left=0.0)
        _legend(ax)
        return ax

    def plot_residuals(
        self, ax: Axes | None = None, *, over: str | Array = "sample", group: str | None = None
    ) -> Axes:
        """Plot the errors of all samples before and after, fitted and held-out ones on the same axes.

        Example:
            `fit.plot_residuals(over="elbow_joint").figure.savefig("elbow.png")`

        Args:
            ax: Axes to draw into; a new figure if None.
            over: "sample" (in the order of the files), "histogram", the name of a joint, or a number per
                sample, shape (N,), such as the time [s]; fitted samples come first, as in `residuals`.
            group: "position", "orientation" or "residual"; the first that was measured if None.

        Returns:
            The axes.
        """
        fit = self._result
        ax = ax or new_axes()[0]
        errors = SampleErrors.from_fit(fit, group)
        if isinstance(over, str) and over == "histogram":
            _plot_histogram(errors, ax)
            return ax
        x, label = _abscissa(fit, over)
        x = x[errors.index]
        errors_known = np.isfinite(x)
        for name, color, chosen, values in errors.series():
            picked = np.flatnonzero(chosen & errors_known)
            picked = picked[evenly_spaced_indices(len(picked), MAX_DOTS)] if len(picked) else picked
            size = DOT_SIZES[name == "after, outlier" or len(picked) < 100]
            plots.plot_dots(ax, x[picked], values[picked], color, size, label=name)
        if not (isinstance(over, str) and over == "sample"):
            for state, values in (("before", errors.before), ("after", errors.after)):
                _plot_medians(ax, x[errors_known], values[errors_known], state, errors.unit)
        ax.set(xlabel=label, ylabel=errors.label)
        if errors.is_wide:
            plots.make_logarithmic(ax, "y")
        else:
            ax.set_ylim(bottom=0.0)
        _legend(ax)
        return ax

    def plot_joint_corrections(self, ax: Sequence[Axes] | None = None) -> list[Axes]:
        """Plot the correction curve of each joint with its 95 % band and the gaps between measurements.

        Example:
            `fit.plot_joint_corrections()[0].figure.savefig("curves.png")`

        Args:
            ax: Axes to draw into, one per joint with a curve; a new figure if None.

        Returns:
            The axes, one per joint with harmonics.

        Raises:
            InvalidArgumentError: No joint has a correction curve, or the number of axes is another one.
        """
        curves = joint_curves(self._result)
        if not curves:
            raise InvalidArgumentError(
                "no joint has a correction curve; estimate harmonics with parameters or extend"
            )
        panels = plots.new_axes(len(curves), (3.6, 2.6)) if ax is None else list(ax)
        if len(panels) != len(curves):
            raise InvalidArgumentError(f"ax: {len(panels)} axes; expected one per curve, {len(curves)}")
        for panel, curve in zip(panels, curves, strict=True):
            coverage = curve.coverage
            plots.plot_joint_corrections(
                curve.values,
                curve.correction,
                curve.std,
                panel,
                gaps=coverage.gaps,
                joint=coverage.joint,
            )
        return panels

    def plot_parameters(self, ax: Axes | None = None, *, count: int = MAX_PARAMETERS) -> Axes:
        """Plot the corrections of the robot with two standard deviations, relative to their priors.

        A prior is drawn as a band of one and of two of its standard deviations. A line as long as the band
        belongs to a parameter that the measurements do not determine.

        Example:
            `fit.plot_parameters().figure.savefig("parameters.png")`

        Args:
            ax: Axes to draw into; a new figure if None.
            count: Largest number of parameters; those with the largest corrections are drawn.

        Returns:
            The axes.
        """
        fit = self._result
        prior = fit.prior_std
        names = [estimate.name for estimate in fit.estimates[: len(fit.x)]]
        robot = [i for i, estimate in enumerate(fit.estimates[: len(fit.x)]) if estimate.category == "robot"]
        change, std = fit.x / prior, np.minimum(fit.std / prior, 10.0)
        chosen = sorted(sorted(robot, key=lambda i: -abs(change[i]))[:count])
        ax = ax or new_axes(size=(6.4, max(2.0, 0.22 * len(chosen) + 0.9)))[0]
        height = np.arange(len(chosen))
        for width, color in zip(_PRIOR_BANDS, ("#eef1f4", "#dfe5ea"), strict=True):
            label = f"prior, {width:g} standard deviation{'s' if width > 1 else ''}"
            ax.axvspan(-width, width, color=color, linewidth=0, label=label)
        ax.axvline(0.0, color=COLORS["text"], linewidth=1.0)
        ax.errorbar(
            change[chosen],
            height,
            xerr=2 * std[chosen],
            fmt="o",
            color=COLORS["after"],
            markersize=DOT_SIZES[1],
            label="correction, 2 standard deviations",
        )
        ax.set_yticks(height, [names[i] for i in chosen])
        reach = float(np.max(np.abs(change[chosen]) + 2 * np.minimum(std[chosen], 1.5), initial=2.2))
        ax.set(xlabel="correction / standard deviation of the prior", xlim=(-reach, reach))
        ax.set_ylim(max(len(chosen), 1) - 0.4, -0.6)
        if len(chosen) < len(robot):
            ax.set_ylabel(f"{len(chosen)} largest of {len(robot)} corrections")
        _legend(ax)
        return ax

    def plot_singular_values(self, ax: Axes | None = None) -> Axes:
        """Plot the singular values of the whitened Jacobian relative to the largest one.

        Example:
            `fit.plot_singular_values().figure.savefig("singular_values.png")`

        Args:
            ax: Axes to draw into; a new figure if None.

        Returns:
            The axes.
        """
        fit = self._result
        ax = ax or new_axes()[0]
        plots.plot_singular_values(fit.solution.system.singular_values, fit.rank, ax)
        _legend(ax)
        return ax

    def plot_correlation(self, ax: Axes | None = None) -> Axes:
        """Plot the correlation matrix of all estimated parameters.

        Example:
            `fit.plot_correlation().figure.savefig("correlation.png")`

        Args:
            ax: Axes to draw into; a new figure if None.

        Returns:
            The axes.
        """
        from matplotlib.colors import LinearSegmentedColormap

        fit = self._result
        correlation = fit.correlation
        names = [parameter.name for parameter in fit.parameters]
        side = min(9.0, 3.0 + 0.14 * len(names))
        ax = ax or new_axes(size=(side, side * 0.86))[0]
        colors = LinearSegmentedColormap.from_list("dhcal", [COLORS["before"], "#ffffff", COLORS["after"]])
        colors = colors.with_extremes(bad=COLORS["unknown"])
        image = ax.imshow(np.ma.masked_invalid(correlation), cmap=colors, vmin=-1.0, vmax=1.0)
        ax.grid(visible=False)
        if len(names) <= _MAX_NAMES:
            ax.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
            ax.set_yticks(range(len(names)), names, fontsize=7)
        else:
            ax.set(xlabel="parameter", ylabel="parameter")
        _add_scale(ax, image, "correlation")
        return ax

    def plot_workspace(self, ax: Axes | None = None, *, plane: str = "xz") -> Axes:
        """Plot a map of the predicted standard deviation of the tool position, with the measured positions.

        Example:
            `fit.plot_workspace(plane="xy").figure.savefig("map.png")`

        Args:
            ax: Axes to draw into; a new figure if None.
            plane: Horizontal and vertical coordinate in the base frame: "xy", "xz" or "yz".

        Returns:
            The axes.
        """
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import BoundaryNorm, ListedColormap

        if plane not in ("xy", "xz", "yz"):
            raise UnknownNameError(f"plane {plane!r}: unknown; choose from xy, xz, yz")
        ax = ax or new_axes(size=(5.6, 4.6))[0]
        found = predict_workspace(self._result, self._result.inliers)
        plots.plot_position_std_map(found.points, found.std, ax, plane=plane, measured=found.measured)
        colors = ListedColormap([COLORS[f"level-{k}"] for k in range(plots.N_LEVELS)])
        scale = ScalarMappable(BoundaryNorm(1e3 * plots.std_levels(found.std), plots.N_LEVELS), colors)
        _add_scale(ax, scale, "predicted standard deviation, mm")
        return ax

    def to_dataframe(self) -> Any:
        """Return the estimates of all parameters as a `pandas.DataFrame`, one row per parameter.

        Example:
            `fit.to_dataframe().sort_values("change").to_csv("parameters.csv")`

        Returns:
            Data frame with the name of the parameter as index and the attributes of `Estimate` as columns, in
            SI units.

        Raises:
            InvalidArgumentError: pandas is not installed.
        """
        try:
            import pandas as pd  # lazy import: an optional package
        except ModuleNotFoundError:
            raise InvalidArgumentError("to_dataframe: pandas is not installed; pip install pandas") from None
        names = (
            "name unit nominal value change std prior observability fixed category frame direction".split()
        )
        rows = [{name: getattr(e, name) for name in names} for e in self._result.estimates]
        return pd.DataFrame(rows).set_index("name")

    def summary(self) -> str:
        """Summarize the result in a few sentences: verdict, accuracy, where it holds, and what was estimated.

        Example:
            `print(fit.summary())`

        Returns:
            Text of several lines.
        """
        fit = self._result
        count = len(fit.parameters)
        lines = [
            f"Verdict: {fit.verdict.status}.",
            *fit.verdict.reasons,
            headline(fit.comparisons).text,
            *generalization_lines(fit.generalization, fit.comparisons),
            f"{count} parameters from {fit.sample_count}; {fit.rank} combinations are identifiable; "
            f"{describe_convergence(fit.converged, fit.iterations)}.",
        ]
        largest = largest_corrections(fit.estimates, fit.x, fit.solution.system)[:5]
        if largest:
            texts = [
                f"{e.name} {formatting.format_quantity(e.change, e.unit, e.std, small=True)}" for e in largest
            ]
            lines.append(f"Largest corrections: {', '.join(texts)}.")
        return "\n".join(lines)
