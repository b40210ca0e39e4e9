"""How far measurements lie from what a chain says, and what that says of its accuracy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from .._typing import Array
from ..estimation import robust
from ..estimation.error_model import ErrorModel
from ..estimation.problem import Problem, merge_instrument_parameters
from ..estimation.solver import minimize
from ..measurements.base import Measurement
from ..robot.chain import Chain

# Unit of each group of errors, in the order of importance.
GROUP_UNITS = {"position": "m", "orientation": "rad", "residual": "m"}


def error_group(name: str) -> str:
    """Return the group of `GROUP_UNITS` of the errors that a measurement kind calls by this name."""
    return name if name in GROUP_UNITS else "residual"


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of the error norms of one group.

    Attributes:
        samples: Number of samples m.
        rms: Root mean square.
        rms_std: Standard error of `rms`.
        mean: Mean.
        p95: 95th percentile.
        max: Largest.
        axes_rms: RMS along each axis; None if the errors are not components along axes.
        unit: Unit of all of these: "m" or "rad".
    """

    samples: int
    rms: float
    rms_std: float
    mean: float
    p95: float
    max: float
    axes_rms: tuple[float, ...] | None
    unit: str

    @classmethod
    def from_norms(cls, norms: Array, unit: str, axes: Sequence[Array] = ()) -> ErrorStatistics:
        """Compute the statistics of error norms.

        Args:
            norms: Error norms, shape (m,).
            unit: Their unit.
            axes: Error components, arrays of shape (·, 3).

        Returns:
            The statistics.
        """
        square = norms**2
        rms = float(np.sqrt(np.mean(square)))
        return cls(
            samples=len(norms),
            rms=rms,
            rms_std=float(np.std(square) / np.sqrt(len(norms)) / (2 * rms)) if rms else 0.0,
            mean=float(np.mean(norms)),
            p95=float(np.quantile(norms, 0.95)),
            max=float(norms.max()),
            axes_rms=tuple(np.sqrt(np.mean(np.concatenate(axes) ** 2, 0)).tolist()) if axes else None,
            unit=unit,
        )


@dataclass(frozen=True, eq=False)
class Accuracy(Mapping[str, Any]):
    """Error statistics of each group of errors, None for a group that was not measured.

    It is also a read-only mapping of the flat keys of the JSON document: `accuracy["position_rms_m"]`.

    Attributes:
        position: Of positions [m].
        orientation: Of orientations [rad].
        residual: Of other residuals, such as lengths and distances.
    """

    position: ErrorStatistics | None = None
    orientation: ErrorStatistics | None = None
    residual: ErrorStatistics | None = None

    @classmethod
    def from_errors(cls, errors: Sequence[Mapping[str, Array]]) -> Accuracy:
        """Compute the statistics of errors as returned by `compute_errors`.

        Args:
            errors: Errors by name of each measurement, arrays of shape (m, ·) [m or rad].

        Returns:
            The statistics of all measurements together.
        """
        return cls(
            **{
                group: ErrorStatistics.from_norms(
                    norms,
                    GROUP_UNITS[group],
                    [error for item in errors for name, error in item.items() if name == group],
                )
                for group, norms in error_norms(errors).items()
            }
        )

    @property
    def groups(self) -> dict[str, ErrorStatistics]:
        """Statistics of the measured groups by name, the most important group first."""
        found = {group: getattr(self, group) for group in GROUP_UNITS}
        return {group: statistics for group, statistics in found.items() if statistics is not None}

    def to_dict(self) -> dict[str, Any]:
        """Return the flat keys and values of the JSON document, such as `position_rms_m`."""
        endings = {"position": "_m", "orientation": "_rad", "residual": ""}
        out: dict[str, Any] = {}
        for group, statistics in self.groups.items():
            out[f"{group}_samples"] = statistics.samples
            for key in ("rms", "rms_std", "mean", "p95", "max", "axes_rms"):
                if (value := getattr(statistics, key)) is not None:
                    out[f"{group}_{key}{endings[group]}"] = list(value) if key == "axes_rms" else value
            if group == "residual":
                out["unit"] = statistics.unit
        return out

    def __getitem__(self, key: str) -> Any:
        return self.to_dict()[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.to_dict())

    def __len__(self) -> int:
        return len(self.to_dict())


def instrument_values(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float]
) -> dict[str, float]:
    """Values of started data's unknowns by name, those that are not known fitted to the data alone."""
    every = merge_instrument_parameters(data)
    given = {u.name: known[u.name] for u in every if u.name in known and not u.is_local}
    weights = np.array([1 / u.prior for u in every if u.name not in given])
    problem = Problem(ErrorModel(chain, ()), tuple(data), weights, given)
    if not len(weights):
        return given
    return problem.instruments(minimize(problem).x)


def compute_errors(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> list[dict[str, Array]]:
    """Measured minus modelled: for each item its unweighted errors (m, ·) by name, m or rad.

    Args:
        chain: base and tool included.
        data: measurements of any kinds.
        known: values of instruments' unknowns; others (a point that only these data touch) are fitted
            to the data first.
    """
    data = [item.initialized(chain) for item in data]
    values = instrument_values(chain, data, known or {})
    return [
        item.errors(
            chain.forward_kinematics(item.configurations()),
            np.array([values[unknown.name] for unknown in item.instrument_parameters]),
        )
        for item in data
    ]


def position_errors(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> tuple[Array, Array]:
    """Joint values (m, n) of all measured positions, and how far the chain is from each (m,), m."""
    q, sizes = [np.empty((0, chain.n_joints))], [np.empty(0)]
    placed = [item for item in data if len(item.positions())]
    for item, errors in zip(placed, compute_errors(chain, placed, known), strict=True):
        q.append(item.configurations())
        sizes.append(np.linalg.norm(errors["position"], axis=1))
    return np.concatenate(q), np.concatenate(sizes)


def error_norms(errors: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Return the error norms (m,) of all measurements by group.

    Args:
        errors: Errors by name of each measurement, arrays of shape (m, ·) [m or rad].

    Returns:
        Norms by group of `GROUP_UNITS`, in its order.
    """
    out: dict[str, list[Array]] = {}
    for item in errors:
        for name, error in item.items():
            out.setdefault(error_group(name), []).append(np.linalg.norm(error, axis=1))
    return {group: np.concatenate(out[group]) for group in GROUP_UNITS if group in out}


def accuracy(chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None) -> Accuracy:
    """Compute the errors of a chain on measurements.

    Args:
        chain: Chain with base and tool.
        data: Measurements of any kinds.
        known: Values of instrument parameters by name; the others are fitted to the data first.

    Returns:
        Number of samples, RMS with its standard error, mean, 95th percentile, maximum and RMS along each
        axis, for each group of errors.
    """
    return Accuracy.from_errors(compute_errors(chain, data, known))


def remove_outliers(found: Sequence[Mapping[str, Array]]) -> tuple[list[dict[str, Array]], int]:
    """Deviations without the samples that stand out of all others, and how many those are.

    Of several groups the first, the position, tells.
    """
    clean, gross = [], 0
    for item in found:
        first = next(iter(item.values()))
        good = (
            robust.standardize_mean_squares(np.mean(first**2, 1), first.shape[1]) <= robust.OUTLIER_THRESHOLD
        )
        gross += int(np.sum(~good))
        clean.append({name: error[good] for name, error in item.items()})
    return clean, gross


@dataclass(frozen=True)
class Comparison:
    """Accuracy before and after a calibration on the same samples.

    Attributes:
        title: "held out", "cross-validated" (each sample of a fit without it) or "fitted".
        n_samples: how many.
        before, after: as from `accuracy`.
        n_rejected: gross errors among the samples of a fit that they take no part in; not in the figures.
        n_outliers: gross errors that are in the figures.
        after_without_outliers: `after` without those, where there are any.
    """

    title: str
    n_samples: int
    before: Accuracy
    after: Accuracy
    n_rejected: int = 0
    n_outliers: int = 0
    after_without_outliers: Accuracy = field(default_factory=Accuracy)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for the JSON document, the accuracies by their flat keys."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            name: value.to_dict() if isinstance(value, Accuracy) else value for name, value in values.items()
        }
