"""How far measurements lie from what a chain says, and what that says of its accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._typing import Array
from ..estimation import robust
from ..estimation.error_model import ErrorModel
from ..estimation.problem import Problem, merge_instrument_parameters
from ..estimation.solver import levenberg_marquardt
from ..measurements.base import Measurement
from ..robot.chain import Chain

# What a kind calls its errors, where not position or orientation, counts as residual; and its key's ending.
UNIT_SUFFIXES = {"position": "_m", "orientation": "_rad", "residual": ""}


def error_group(name: str) -> str:
    """The group of ENDINGS that a kind's errors of that name belong to."""
    return name if name in UNIT_SUFFIXES else "residual"


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
    return problem.instruments(levenberg_marquardt(problem, np.zeros(len(weights)), 100, None).x)


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


def error_norms(found: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Sizes (m,) of deviations by group, those of all items in a row."""
    out: dict[str, list[Array]] = {}
    for item in found:
        for name, error in item.items():
            out.setdefault(error_group(name), []).append(np.linalg.norm(error, axis=1))
    return {group: np.concatenate(out[group]) for group in UNIT_SUFFIXES if group in out}


def accuracy(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Errors of a chain on data, in m and rad: by group their number, RMS with its standard error, mean,
    95th percentile, largest, and RMS along each axis.

    The keys are `position_rms_m`, `orientation_p95_rad` and so on. What else was measured goes to
    `residual_rms` and so on, with `unit`.

    Args:
        chain: base and tool included.
        data: measurements of any kinds.
        known: values of instruments' unknowns; others are fitted to the data first.
    """  # noqa: D205
    return error_statistics(compute_errors(chain, data, known))


def error_statistics(found: Sequence[Mapping[str, Array]]) -> dict[str, Any]:
    """What `accuracy` says, of deviations."""
    out: dict[str, Any] = {}
    for group, size in error_norms(found).items():
        end = UNIT_SUFFIXES[group]
        square = size**2
        rms = float(np.sqrt(np.mean(square)))
        out |= {
            f"{group}_samples": len(size),
            f"{group}_rms{end}": rms,
            f"{group}_rms_std{end}": float(np.std(square) / np.sqrt(len(size)) / (2 * rms)) if rms else 0.0,
            f"{group}_mean{end}": float(np.mean(size)),
            f"{group}_p95{end}": float(np.quantile(size, 0.95)),
            f"{group}_max{end}": float(size.max()),
        }
        axes = [error for item in found for name, error in item.items() if name == group]
        if axes:
            out[f"{group}_axes_rms{end}"] = np.sqrt(np.mean(np.concatenate(axes) ** 2, 0)).tolist()
        if group == "residual":
            out["unit"] = "m"
    return out


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
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    n_rejected: int = 0
    n_outliers: int = 0
    after_without_outliers: Mapping[str, Any] = field(default_factory=dict)
