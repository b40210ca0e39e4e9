"""Errors of a chain on measurements and their statistics.

The error of a sample is the measured minus the modelled value: a vector of components along the axes of the
measuring frame [m] for positions, a rotation vector [rad] for orientations, one or more lengths [m] for other
instruments. Statistics are taken of the Euclidean norms e_i of these errors:

    RMS = sqrt(mean(e_i²)),    standard error of the RMS = std(e_i²) / (2 · RMS · sqrt(m)).

The standard error follows from the variance of the mean of e_i² by the delta method. It assumes independent
samples, but no distribution.

Instrument parameters that are not given, such as a contact point that only these samples touch, are fitted to
the measurements before the errors are computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field, fields, replace
from typing import Any, Literal

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation import robust
from ..estimation.error_model import ErrorModel
from ..estimation.initialization import fit_frames
from ..estimation.problem import Problem, merge_instrument_parameters
from ..estimation.solver import minimize
from ..measurements.arguments import as_measurements, require_chain
from ..measurements.base import Measurement, errors_of, instrument_values
from ..measurements.groups import ERROR_GROUPS, error_group, in_order
from ..robot.chain import Chain

# With fewer samples the figures come with a note that they are not reliable.
MIN_SAMPLES = 10
# The error of a wrong measurement before a calibration is at least this fraction of that after it.
MIN_RATIO_BEFORE = 0.5
# Probability that chance makes a robot appear better that is not, of the squared errors and of their fourth
# roots, and the quantiles of Student's t for them with 9 degrees of freedom; with more they are closer to 0.
MAX_CHANCES, SURE_T = (0.005, 0.02), (-3.25, -2.4)
# Samples that a comparison judges.
Title = Literal["hold-out", "region hold-out", "cross-validated", "fitted"]


@frozen
class ErrorStatistics:
    """Statistics of the error norms of one group."""

    samples: int  #: Number of samples m
    rms: float  #: Root mean square
    rms_std: float  #: Standard error of `rms`
    mean: float  #: Mean
    p95: float  #: 95th percentile
    max: float  #: Largest
    #: RMS along each axis; None if the errors are not components along axes.
    axes_rms: tuple[float, ...] | None
    unit: str  #: Unit of all of these: "m", "rad" or "px"

    @classmethod
    def from_norms(cls, norms: Array, unit: str, axes: Sequence[Array]) -> ErrorStatistics:
        """Compute the statistics of error norms."""
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


@frozen(eq=False)
class Accuracy(Mapping[str, Any]):
    """Error statistics of each group of errors that was measured.

    It is also a read-only mapping of the flat keys of the JSON document: `accuracy["position_rms_m"]`.
    """

    #: Statistics by name of the error group, the most important group first.
    groups: Mapping[str, ErrorStatistics] = field(default_factory=dict)

    @classmethod
    def from_errors(cls, errors: Sequence[Mapping[str, Array]]) -> Accuracy:
        """Compute the statistics of errors as returned by `compute_errors`."""
        return cls(
            {
                group: ErrorStatistics.from_norms(
                    norms,
                    ERROR_GROUPS[group].unit,
                    [error for item in errors for name, error in item.items() if name == group],
                )
                for group, norms in error_norms(errors).items()
            }
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the flat keys and values of the JSON document, such as `position_rms_m`."""
        out: dict[str, Any] = {}
        for group, statistics in self.groups.items():
            prefix, ending = group, f"_{statistics.unit}"
            # The first error that is no vector along axes is called the residual, with its unit.
            if "unit" not in out and not ERROR_GROUPS[group].is_vector:
                prefix, ending = "residual", ""
            out[f"{prefix}_samples"] = statistics.samples
            for key in ("rms", "rms_std", "mean", "p95", "max", "axes_rms"):
                if (value := getattr(statistics, key)) is not None:
                    out[f"{prefix}_{key}{ending}"] = list(value) if key == "axes_rms" else value
            if prefix == "residual":
                out["unit"] = statistics.unit
        return out

    def __getitem__(self, key: str) -> Any:
        """Return the value of a key of the JSON document."""
        return self.to_dict()[key]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the keys of the JSON document."""
        return iter(self.to_dict())

    def __len__(self) -> int:
        """Return the number of keys of the JSON document."""
        return len(self.to_dict())


def fit_instrument_parameters(
    chain: Chain,
    data: Sequence[Measurement],
    known: Mapping[str, float],
    start: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Fit the instrument parameters that are not known to measurements of a given chain."""
    parameters = merge_instrument_parameters(data)
    given = {p.name: known[p.name] for p in parameters if p.name in known and not p.is_local}
    weights = np.array([1 / p.prior for p in parameters if p.name not in given])
    problem = Problem(ErrorModel(chain, ()), tuple(data), weights, given)
    if not len(weights):
        return given
    return problem.instruments(minimize(problem, x=problem.instrument_start(start or {})).x)


def fit_nominal(
    nominal: ErrorModel,
    data: Sequence[Measurement],
    known: Mapping[str, float],
    start: Mapping[str, float] | None = None,
) -> tuple[Chain, dict[str, float]]:
    """Fit base, tool and instrument parameters of the nominal robot to measurements, from a start if any."""
    chain = fit_frames(nominal, tuple(data), known)
    data = [item.initialized(chain) for item in data]
    values = fit_instrument_parameters(chain, data, known, start)
    used = {
        parameter.name
        for item in data
        if item.instrument_parameters
        for parameter, jacobian in zip(
            item.instrument_parameters,
            item.instrument_jacobian(
                chain.forward_kinematics(item.conditions()),
                instrument_values(item, values),
            ),
            strict=True,
        )
        if jacobian.any()
    }
    return chain, {name: value for name, value in values.items() if name in used}


def compute_errors(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> list[dict[str, Array]]:
    """Compute the errors of all samples, measured minus modelled, without weights."""
    known = known or {}
    data = [item.matched_to(known) for item in data]
    data = [
        item.mounted(chain)
        if all(p.name in known and not p.is_local for p in item.instrument_parameters)
        else item.initialized(chain)
        for item in data
    ]
    values = fit_instrument_parameters(chain, data, known)
    return [errors_of(item, chain, values) for item in data]


def position_errors(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> tuple[Array, Array]:
    """Compute the position errors of all measurements that contain positions."""
    q, norms = [np.empty((0, chain.n_joints))], [np.empty(0)]
    with_positions = [item for item in data if len(item.positions())]
    for item, errors in zip(with_positions, compute_errors(chain, with_positions, known), strict=True):
        q.append(item.configurations())
        norms.append(np.linalg.norm(errors["position"], axis=1))
    return np.concatenate(q), np.concatenate(norms)


def error_norms(errors: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Return the error norms (m,) of all measurements by group."""
    out: dict[str, list[Array]] = {}
    for item in errors:
        for name, error in item.items():
            out.setdefault(error_group(name), []).append(np.linalg.norm(error, axis=1))
    return {group: np.concatenate(out[group]) for group in in_order(out)}


def aligned_norms(errors: Sequence[Mapping[str, Array]], data: Sequence[Measurement]) -> dict[str, Array]:
    """Return the error norms of all samples by group, (N,) each; NaN for samples without this group."""
    parts = [error_norms([each]) for each in errors]
    unknown = [np.full(len(item.rows), np.nan) for item in data]
    return {
        group: np.concatenate([norms.get(group, nan) for norms, nan in zip(parts, unknown, strict=True)])
        for group in dict.fromkeys(group for norms in parts for group in norms)
    }


def accuracy(
    chain: Chain, data: Measurement | Sequence[Measurement], known: Mapping[str, float] | None = None
) -> Accuracy:
    """Compute the error statistics of a chain on measurements.

    Args:
        chain: Chain with base and tool.
        data: One measurement or several of any kinds.
        known: Values of instrument parameters by name [m or rad]; the others are fitted to the data first.

    Returns:
        Number of samples, RMS with its standard error, mean, 95th percentile, maximum and RMS along each
        axis, for each group of errors. It can also be indexed by the keys of the JSON document, such as
        "position_rms_m".
    """
    require_chain(chain)
    return Accuracy.from_errors(compute_errors(chain, as_measurements(data), known))


def find_inliers(errors: Sequence[Mapping[str, Array]]) -> tuple[Array, ...]:
    """Find the samples whose errors are no outliers among those of their measurement, (m,) each."""
    # Only the first group of errors of a measurement is tested: of a pose, the position.
    tested = [next(iter(item.values())) for item in errors]
    return tuple(
        robust.standardize_mean_squares(np.mean(each**2, 1), each.shape[1]) <= robust.OUTLIER_THRESHOLD
        for each in tested
    )


def take_errors(errors: Iterable[Mapping[str, Array]], masks: Iterable[Array]) -> list[dict[str, Array]]:
    """Take some samples of each measurement; measurements without any are left out."""
    return [
        {name: error[mask] for name, error in item.items()}
        for item, mask in zip(errors, masks, strict=True)
        if mask.any()
    ]


@frozen(eq=False)
class PairedErrors:
    """Mean squared errors of the same configurations before and after a calibration."""

    before: Array  # Of each of u configurations, shape (u,) [m² or rad²]
    after: Array  # The same after the calibration
    n_components: int  # Number of components of an error

    @classmethod
    def from_errors(
        cls, before: Sequence[Mapping[str, Array]], after: Sequence[Mapping[str, Array]], labels: Array
    ) -> PairedErrors:
        """Average the squared errors of the most important group over the samples of each configuration."""
        group = next(iter(error_norms(before)))
        squares, kept, start, n_components = [], [], 0, 1
        for items in zip(before, after, strict=True):
            stop = start + len(next(iter(items[0].values())))
            names = [name for name in items[0] if error_group(name) == group]
            if names:
                n_components = items[0][names[0]].shape[1]
                squares.append([np.sum(item[names[0]] ** 2, 1) for item in items])
                kept.append(labels[start:stop])
            start = stop
        _, index, counts = np.unique(np.concatenate(kept), return_inverse=True, return_counts=True)
        values = np.concatenate(squares, 1)
        mean_squares = [np.bincount(index, row) / counts for row in values]
        return cls(*mean_squares, n_components=n_components)

    def without_outliers(self) -> PairedErrors:
        """Leave out outliers after the calibration whose error was large before, too: wrong measurements."""
        t = robust.standardize_mean_squares(self.after, self.n_components)
        is_outlier = (t > robust.OUTLIER_THRESHOLD) & (self.before > MIN_RATIO_BEFORE**2 * self.after)
        return replace(self, before=self.before[~is_outlier], after=self.after[~is_outlier])

    @property
    def ratio(self) -> float:
        """RMS error after relative to the RMS error before."""
        return float(np.sqrt(np.mean(self.after) / max(np.mean(self.before), np.finfo(float).tiny)))

    @property
    def t(self) -> float:
        """Student's t of the paired change of the squared error: negative if it fell; NaN if unknown."""
        return _student_t(self.after - self.before)

    @property
    def is_better(self) -> bool:
        """Whether the RMS error fell, and errors of robots that are equally wrong rarely change so much.

        One large squared error of few samples hides the change of all others, as they are far from normal.
        The fourth root of a chi-square with one to three degrees of freedom is nearly normal: D. M. Hawkins
        and R. A. J. Wixley, A Note on the Transformation of Chi-Squared Variables to Normality, The American
        Statistician 40, 1986. Both are tested.
        """
        if self.ratio >= 1 or len(self.before) < 2:
            return False
        t = self.t, _student_t(self.after**0.25 - self.before**0.25)
        if len(self.before) >= MIN_SAMPLES and np.any(t < np.array(SURE_T)):
            return True
        from scipy.special import stdtrit  # lazy import: slow

        return bool(np.any(t < stdtrit(len(self.before) - 1, MAX_CHANCES)))


def _student_t(change: Array) -> float:
    """Return Student's t of the mean of changes; NaN for fewer than two."""
    if len(change) < 2:
        return np.nan
    error = np.std(change, ddof=1) / np.sqrt(len(change))
    return float(np.mean(change) / error) if error > 0 else 0.0


@frozen
class Comparison:
    """Accuracy before and after a calibration on the same samples."""

    #: "hold-out", "region hold-out" (regions of joint space are judged by a fit without them, and may
    #: overlap), "cross-validated" (each sample is judged by a fit without it) or "fitted".
    title: Title
    n_samples: int  #: Number of samples, without outliers
    #: Accuracy of the nominal robot. Its base, tool and instrument parameters are fitted to the same samples
    #: as those of the calibrated robot.
    before: Accuracy
    after: Accuracy  #: Accuracy of the calibrated robot
    n_outliers: int = 0  #: Number of outliers; they are not in the figures
    #: `after` of hold-out samples with outliers; empty if there are none.
    after_with_outliers: Accuracy = field(default_factory=Accuracy)
    #: Accuracy of the calibrated URDF without its sidecar, with the base and the tool that fit it best; None
    #: if the sidecar has no errors of the arm.
    after_alone: Accuracy | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes for the JSON document, the accuracies by their flat keys."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {
            name: value.to_dict() if isinstance(value, Accuracy) else value for name, value in values.items()
        }
