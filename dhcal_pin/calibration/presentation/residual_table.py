"""Residuals of all measurements after a calibration, one row per sample: for plots, tables and files.

A residual is the measured minus the modelled value of one component, in metres or radians. The normalised
residual of a sample with k components is

    sqrt( (1/k)·Σ_j (r_j / σ_j)² ),

with the standard deviations σ_j as the fit weighted them: those that the file states, otherwise those that
were estimated. It is about 1 for a good sample.

Shapes: N samples of all measurements, first the fitted ones in the order of `Result.data`, then the held-out
ones in the order of `Result.holdout`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.robust import ZERO_WEIGHT
from ...measurements.base import Measurement, instrument_values
from ..evaluation import fit_instrument_parameters
from ..evidence import Evidence


@frozen(eq=False)
class ResidualTable:
    """Residuals of N samples.

    Attributes:
        file: File of each sample, (N,); empty for data from Python.
        line: Line of each sample in its file, (N,); for data from Python its number, counted from 1.
        kind: Measurement kind of each sample, (N,).
        is_holdout: Whether each sample was held out, (N,).
        components: Residuals by component, such as "position_x" or "orientation_z", shape (N,) each [m or
            rad]; NaN for samples of a kind without this component.
        units: Unit of each component.
        normalised: Normalised residual of each sample, (N,); NaN if its standard deviation is unknown.
        weight: Robust weight of each fitted sample, (N,): 0 if it was rejected; NaN if it was held out.
        is_outlier: Whether each sample is an outlier, (N,), see `Result.is_counted`.
        image: Name of each sample's photograph, (N,); empty if it has none.
    """

    file: Array
    line: Array
    kind: Array
    is_holdout: Array
    components: Mapping[str, Array]
    units: Mapping[str, str]
    normalised: Array
    weight: Array
    is_outlier: Array
    image: Array

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.line)

    def __repr__(self) -> str:
        """Return the number of samples and the names of the components."""
        held = int(np.count_nonzero(self.is_holdout))
        return f"ResidualTable({len(self) - held} fitted, {held} held out; {', '.join(self.components)})"

    def norms(self, group: str) -> Array:
        """Return the length of each residual of a group, such as the distance from measured to modelled.

        Args:
            group: "position", "orientation" or another first part of the names in `components`.

        Returns:
            Euclidean norms, (N,) [m or rad]; NaN for samples without this group.

        Raises:
            KeyError: No component belongs to the group.
        """
        names = [name for name in self.components if name == group or name.startswith(f"{group}_")]
        if not names:
            raise KeyError(group)
        values = np.stack([self.components[name] for name in names])
        return np.where(np.isnan(values).all(0), np.nan, np.sqrt(np.nansum(values**2, axis=0)))

    def to_columns(self) -> dict[str, Array]:
        """Return all columns by header, (N,) each: `pandas.DataFrame(fit.residuals.to_columns())`."""
        return {
            "file": self.file,
            "line": self.line,
            **({"image": self.image} if any(self.image) else {}),
            "set": np.where(self.is_holdout, "holdout", "fit"),
            "kind": self.kind,
            **{f"{name}[{self.units[name]}]": values for name, values in self.components.items()},
            "normalised": self.normalised,
            "weight": self.weight,
            "outlier": self.is_outlier,
        }

    @property
    def file_order(self) -> Array:
        """Indices (N,) that order the samples by file and line, as in a CSV file."""
        numbers = {name: number for number, name in enumerate(dict.fromkeys(self.file.tolist()))}
        return np.lexsort(np.array([self.line, [numbers[name] for name in self.file.tolist()]]))

    def file_columns(self) -> dict[str, list[Any]]:
        """Return the columns of a CSV file, ordered by file and line; a missing value is None."""
        order = self.file_order
        columns = {name: values[order].tolist() for name, values in self.to_columns().items()}
        columns["outlier"] = [int(value) for value in columns["outlier"]]
        return {
            name: [None if value != value else value for value in values] for name, values in columns.items()
        }


def residual_table(fit: Evidence) -> ResidualTable:
    """Collect the residuals of a calibration."""
    data = [*fit.data, *fit.holdout]
    residuals = [*_fitted_residuals(fit), *_holdout_residuals(fit)]
    n_fitted = len(fit.data)
    counts = [len(item.rows) for item in data]
    starts = np.cumsum([0, *counts])
    components: dict[str, Array] = {}
    units: dict[str, str] = {}
    for start, item, (errors, _) in zip(starts, data, residuals, strict=False):
        names = iter(item.residual_names)
        for group_name, group in item.residual_groups.items():
            for column in errors[group_name].T:
                name = next(names)
                units[name] = group.unit
                into = components.setdefault(name, np.full(starts[-1], np.nan))
                into[start : start + len(column)] = column
    return ResidualTable(
        file=np.repeat(np.array([item.source for item in data], object), counts),
        line=np.concatenate([item.rows for item in data]),
        kind=np.repeat(np.array([item.kind for item in data], object), counts),
        is_holdout=np.repeat(np.arange(len(data)) >= n_fitted, counts),
        components=components,
        units=units,
        normalised=np.concatenate([normalised for _, normalised in residuals]),
        weight=np.concatenate(
            [
                *(np.where(w <= ZERO_WEIGHT, 0.0, w) for w in fit.weights),
                np.full(starts[-1] - starts[n_fitted], np.nan),
            ]
        ),
        is_outlier=~np.concatenate([*fit.is_counted, *fit.is_holdout_counted]),
        image=np.concatenate([item.photographs() for item in data]),
    )


def _fitted_residuals(fit: Evidence) -> Iterator[tuple[dict[str, Array], Array]]:
    """Yield the errors by group and the normalised residuals (m,) of each fitted measurement."""
    for item, weighted, weights in zip(fit.data, fit.problem.data, fit.weights, strict=True):
        frames = fit.chain.forward_kinematics(item.conditions())
        u = fit.problem.instrument_values_of(item, fit.x)
        # The rows of the problem are scaled by the square roots of the robust weights.
        yield item.errors(frames, u), _root_mean_square(weighted.residual(frames, u)) / np.sqrt(weights)


def _holdout_residuals(fit: Evidence) -> Iterator[tuple[dict[str, Array], Array]]:
    """Yield the errors by group and the normalised residuals (m,) of each held-out measurement."""
    data = [item.initialized(fit.chain) for item in fit.holdout]
    values = fit_instrument_parameters(fit.chain, data, fit.instruments)
    for item in data:
        frames = fit.chain.forward_kinematics(item.conditions())
        u = instrument_values(item, values)
        yield item.errors(frames, u), _root_mean_square(_with_fitted_sigma(fit, item).residual(frames, u))


def _root_mean_square(residual: Array) -> Array:
    """Return the root mean square of the residuals (k, m) of each sample, (m,)."""
    return np.sqrt(np.mean(residual**2, axis=0))


def _with_fitted_sigma(fit: Evidence, item: Measurement) -> Measurement:
    """Scale a held-out measurement as the fit scaled its file, or else its kind; by NaN without either."""
    if item.has_stated_sigma:
        return item
    same_kind = [i for i, other in enumerate(fit.data) if other.kind == item.kind]
    same_file = [i for i in same_kind if item.source and fit.data[i].source == item.source]
    for index in [*same_file, *same_kind]:
        return item.with_scaled_sigma(sigma_scales(fit, index))
    return item.with_scaled_sigma(dict.fromkeys(item.residual_groups, np.nan))


def sigma_scales(fit: Evidence, index: int) -> dict[str, float]:
    """Return the factor by which the fit scaled the standard deviations of each residual group."""
    u = fit.problem.instrument_values_of(fit.data[index], fit.x)
    frames = fit.chain.forward_kinematics(fit.data[index].conditions())
    weights = np.sqrt(fit.weights[index])
    plain, scaled = (item.data[index].residual(frames, u) for item in (fit, fit.problem))
    norms = {
        name: (np.linalg.norm(plain[group.rows]), np.linalg.norm(scaled[group.rows] / weights))
        for name, group in fit.data[index].residual_groups.items()
    }
    return {name: float(a / b) if b else 1.0 for name, (a, b) in norms.items()}
