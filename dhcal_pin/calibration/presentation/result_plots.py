"""Plots and tables that a result makes of itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

from ... import formatting
from ..._typing import Array
from ...exceptions import InvalidArgumentError
from .. import presentation
from ..summary import describe_convergence, generalization_lines, headline, largest_corrections

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..evidence import Evidence


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
        return presentation.plot_accuracy(self._result, ax, group=group)

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
        return presentation.plot_residuals(self._result, ax, over=over, group=group)

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
        from ... import plots  # lazy import: slow to load

        curves = presentation.joint_curves(self._result)
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

    def plot_parameters(self, ax: Axes | None = None, *, count: int = 40) -> Axes:
        """Plot the corrections of the robot with two standard deviations, relative to their priors.

        Example:
            `fit.plot_parameters().figure.savefig("parameters.png")`

        Args:
            ax: Axes to draw into; a new figure if None.
            count: Largest number of parameters; those with the largest corrections are drawn.

        Returns:
            The axes.
        """
        return presentation.plot_parameters(self._result, ax, count=count)

    def plot_singular_values(self, ax: Axes | None = None) -> Axes:
        """Plot the singular values of the whitened Jacobian relative to the largest one.

        Example:
            `fit.plot_singular_values().figure.savefig("singular_values.png")`

        Args:
            ax: Axes to draw into; a new figure if None.

        Returns:
            The axes.
        """
        return presentation.plot_singular_values(self._result, ax)

    def plot_correlation(self, ax: Axes | None = None) -> Axes:
        """Plot the correlation matrix of all estimated parameters.

        Example:
            `fit.plot_correlation().figure.savefig("correlation.png")`

        Args:
            ax: Axes to draw into; a new figure if None.

        Returns:
            The axes.
        """
        return presentation.plot_correlation(self._result, ax)

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
        workspace = presentation.predict_workspace(self._result, self._result.inliers)
        return presentation.plot_workspace(
            workspace.points, workspace.std, workspace.measured, ax, plane=plane
        )

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
        names = "name unit nominal value change std prior observability fixed category frame direction".split()
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
