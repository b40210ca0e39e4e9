"""Uncertainty budget of a calibration: what the position error of a certificate consists of.

Contributions are RMS distances [m]. Their squares add up to that of the error on the samples that the
certificate states, so that the model error follows from the others:

    instrument       √(mean of σ_x² + σ_y² + σ_z²), as stated
    repeatability    √(s² - instrument²), s: pooled scatter of the visits of one configuration
    parameters       √(mean variance of the tool position that follows from the covariance of the parameters)
    model error      √(error² - instrument² - repeatability² - parameters²)

A negative difference counts as zero. The combination, the root of the sum of squares, then exceeds the error.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from ..._frozen import frozen
from ...formatting import Quantity, Table
from ...measurements.configurations import group_by_configuration
from ...measurements.pose import Pose
from ...measurements.position import Position
from ...subsampling import evenly_spaced_indices
from ..evaluation import Comparison, compute_errors
from ..fitted import FittedModel

# Largest number of samples whose predicted uncertainties are averaged; they are thinned evenly.
_MAX_PREDICTED = 2000


@frozen
class UncertaintyBudget:
    """Contributions to the position error, RMS distances [m]; None for one that is not known apart."""

    instrument: float | None  #: Noise of the instrument; None if it is not stated.
    #: Scatter of the arm between visits of one configuration, with the noise of the instrument if that is not
    #: stated; None without repeated samples.
    repeatability: float | None
    parameters: float  #: Uncertainty of the estimated parameters.
    model: float  #: What remains, with the contributions that are not known apart.
    combined: float  #: Root of the sum of squares.

    @classmethod
    def from_fit(cls, fit: FittedModel, comparison: Comparison) -> UncertaintyBudget | None:
        """Compute the budget of positions or poses; None for other measurements and unknown uncertainty."""
        data = [item for item in fit.inliers if isinstance(item, (Position, Pose)) and len(item.rows)]
        errors = comparison.after.groups.get("position")
        if not data or errors is None:
            return None
        q = np.concatenate([item.q for item in data])
        q = q[evenly_spaced_indices(len(q), _MAX_PREDICTED)]
        spread = replace(fit.relative, model_std=(0.0, 0.0)).predict(q).position_std
        parameters = float(np.sqrt(np.mean(spread**2)))
        if not np.isfinite(parameters):
            return None
        instrument = None
        if all(item.has_stated_sigma for item in data):
            squares = np.concatenate([np.sum(item.sigma[:, :3] ** 2, 1) for item in data])
            instrument = float(np.sqrt(np.mean(squares)))
        scatter = _repeat_variance(fit, data)
        repeatability = None if scatter is None else _root(scatter - (instrument or 0.0) ** 2)
        known = [value for value in (instrument, repeatability, parameters) if value is not None]
        model = _root(errors.rms**2 - sum(value**2 for value in known))
        return cls(instrument, repeatability, parameters, model, float(np.linalg.norm([*known, model])))

    def to_dict(self) -> dict[str, float | None]:
        """Return the contributions for JSON [m]."""
        return {f"{name}_m": value for name, value in asdict(self).items()}

    def table(self, title: str) -> Table:
        """Return one line per contribution, in mm, for k = 1 and k = 2."""
        rest = "model error"
        if self.repeatability is None:
            noise = "instrument" if self.instrument is None else "noise above that of the instrument"
            rest += f", with repeatability and {noise}"
        entries = {
            "instrument": self.instrument,
            "sampling: repeatability of the arm"
            + (" and instrument" if self.instrument is None else ""): self.repeatability,
            "parameters": self.parameters,
            rest: self.model,
            "combined": self.combined,
        }
        rows = [[name, *(_cell(value, factor) for factor in (1, 2))] for name, value in entries.items()]
        caption = f"Uncertainty budget of the position, RMS distance on the {title} samples"
        return Table(["contribution", "k = 1", "k = 2"], rows, caption=caption)


def _cell(value: float | None, factor: int) -> str | Quantity:
    """Return the text of a contribution."""
    return "not known apart" if value is None else Quantity.error(factor * value, "m")


def _root(square: float) -> float:
    """Return the root of a square that may be negative by chance."""
    return float(np.sqrt(max(square, 0.0)))


def _repeat_variance(fit: FittedModel, data: list[Position | Pose]) -> float | None:
    """Return the pooled variance of repeated samples, sum of the axes [m²]; None without any."""
    total, freedom = 0.0, 0
    for item, errors in zip(data, compute_errors(fit.chain, data, fit.instruments), strict=True):
        conditions = [] if item.recorded is None else [item.recorded.steps]
        keys = np.column_stack([group_by_configuration(item.q), *conditions])
        labels = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        counts = np.bincount(labels)
        sums = np.zeros((len(counts), 3))
        np.add.at(sums, labels, errors["position"])
        total += float(np.sum((errors["position"] - (sums / counts[:, None])[labels]) ** 2))
        freedom += len(labels) - len(counts)
    return total / freedom if freedom else None
