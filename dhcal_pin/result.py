"""What a calibration found, and how far to believe it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from . import observability, robust
from .chain import Chain
from .measurements import Measurement, Unknown
from .parameters import ErrorModel, Parameter
from .se3 import Array
from .solver import (
    Problem,
    Solution,
    levenberg_marquardt,
    pseudo_inverse,
    reduce,
    shared_unknowns,
    with_priors,
)


def accuracy(
    chain: Chain, data: Sequence[Measurement], known: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Errors of a chain on data: RMS and largest position error in m, RMS orientation error in rad.

    What else was measured goes to `residual_rms` and `residual_max`, with `unit`.

    Args:
        chain: base and tool included.
        data: measurements of any kinds.
        known: values of instruments' unknowns; others (a point that only these data touch) are fitted
            to the data first.
    """
    data = [item.started(chain) for item in data]
    values = _instruments(chain, data, known or {})
    groups: dict[str, list[Array]] = {}
    for item in data:
        u = np.array([values[unknown.name] for unknown in item.unknowns])
        for name, error in item.errors(chain.sweep(item.configurations()), u).items():
            group = name if name in ("position", "orientation") else "residual"
            groups.setdefault(group, []).append(np.linalg.norm(error, axis=1))
    out: dict[str, Any] = {}
    if "position" in groups:
        size = np.concatenate(groups["position"])
        out |= {"position_rms_m": float(np.sqrt(np.mean(size**2))), "position_max_m": float(size.max())}
    if "orientation" in groups:
        size = np.concatenate(groups["orientation"])
        out["orientation_rms_rad"] = float(np.sqrt(np.mean(size**2)))
    if "residual" in groups:
        size = np.concatenate(groups["residual"])
        out |= {
            "residual_rms": float(np.sqrt(np.mean(size**2))),
            "residual_max": float(size.max()),
            "unit": "m",
        }
    return out


def _instruments(chain: Chain, data: Sequence[Measurement], known: Mapping[str, float]) -> dict[str, float]:
    """Values of the data's unknowns by name, those that are not known fitted to the data alone."""
    every = shared_unknowns(data)
    given = {u.name: known[u.name] for u in every if u.name in known and not u.local}
    weights = np.array([1 / u.prior for u in every if u.name not in given])
    problem = Problem(ErrorModel(chain, ()), tuple(data), weights, given)
    if not len(weights):
        return given
    return problem.instruments(levenberg_marquardt(problem, np.zeros(len(weights)), 100, None).x)


@dataclass(frozen=True, eq=False)
class Result:
    """An identified arm and how far to believe it.

    Attributes:
        errors: the nominal chain and its unknowns.
        x: (p+s,) identified errors of the robot, then the instruments' unknowns from where they
            started; m and rad.
        chain: the calibrated chain.
        reference: the nominal chain, with base and tool as fitted to the same data where they were
            unknown, so that before and after differ by the robot alone.
        data, holdout: what was fitted, and what was kept back.
        problem: with the sigmas that were used in the end.
        solution: the loop's end.
        method: "lm" or "gn".
        weights: (m,) of each fitted measurement's samples, 1 but for a robust loss.
    """

    errors: ErrorModel
    x: Array
    chain: Chain
    reference: Chain
    data: tuple[Measurement, ...]
    holdout: tuple[Measurement, ...]
    problem: Problem
    solution: Solution
    method: str
    weights: tuple[Array, ...]

    @property
    def model(self) -> pin.Model:
        """Pinocchio's model with the calibrated joint placements."""
        return self.chain.model

    @property
    def converged(self) -> bool:
        """Whether the last step was too small to matter."""
        return self.solution.converged

    @property
    def iterations(self) -> int:
        """Steps taken."""
        return self.solution.iterations

    @property
    def samples(self) -> int:
        """Number of fitted samples."""
        return sum(len(d.rows) for d in self.data)

    @property
    def rank(self) -> int:
        """Number of directions that the data see, without priors."""
        return observability.rank(self.solution.triangle.r)

    @property
    def condition(self) -> float:
        """Largest over smallest singular value of the directions seen."""
        return observability.condition(self.solution.triangle.r)

    @property
    def unobservable(self) -> list[str]:
        """What the data cannot tell apart, one sentence a group."""
        return observability.unobservable(self.solution.triangle.r, self.parameters)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the whitened residuals, about 1 where the sigmas are right."""
        count = 0.0
        for item, weights in zip(self.data, self.weights, strict=True):
            sweep = self.chain.sweep(item.configurations())
            count += len(item.residual(sweep, self.problem.values(item, self.x))) * weights.sum()
        cost = self.solution.triangle.rest + float(np.sum(self.solution.triangle.z**2))
        freedom = count - self.rank
        return float(np.sqrt(cost / freedom)) if freedom > 0 else float("nan")

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of x; infinite on the diagonal where neither data nor a prior tell.

        NaN where there are not more rows than unknown directions and so no noise to go by.
        """
        weights = self.problem.weights
        zero = np.zeros_like(self.x)
        full = with_priors(self.solution.triangle, weights, zero, zero).r
        _, s, vt = np.linalg.svd(full)
        keep = s > observability.RANK_CUT * s[0]
        half = (vt[keep].T / s[keep]) * self.noise
        out = half @ half.T
        lost = 1 - np.sum(vt[keep] ** 2, 0) > 1e-6
        out[lost, lost] = np.inf
        return out

    @property
    def std(self) -> Array:
        """Standard deviations (p,) of x, m and rad."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def seen(self) -> Array:
        """How far the data see each parameter, (p,) between 0 and 1."""
        return observability.seen_share(self.solution.triangle.r)

    @property
    def parameters(self) -> tuple[Parameter | Unknown, ...]:
        """The robot's and the instruments' unknowns, in the order of x."""
        return (*self.errors.parameters, *self.problem.unknowns)

    @property
    def instruments(self) -> dict[str, float]:
        """Values of the instruments' unknowns by name, m and rad."""
        return self.problem.instruments(self.x)

    @cached_property
    def outliers(self) -> tuple[Array, ...]:
        """Row numbers of gross errors in each fitted measurement.

        None where few samples stand against many unknowns, as then the scatter tells nothing.
        """
        return tuple(
            robust.outliers(self.chain, item, self.problem.values(item, self.x))
            if len(item.rows) > 2 * len(self.parameters)
            else np.empty(0, int)
            for item in self.data
        )

    @property
    def portable(self) -> dict[str, float]:
        """Those of the instruments' values that hold for other measurements with it, too."""
        local = {unknown.name for unknown in self.problem.unknowns if unknown.local}
        return {name: value for name, value in self.instruments.items() if name not in local}

    def validate(self, data: Measurement | Sequence[Measurement]) -> dict[str, Any]:
        """Accuracy of the calibrated chain on other data: position in m, orientation in rad."""
        data = (data,) if not isinstance(data, Sequence) else data
        return accuracy(self.chain, data, self.instruments)

    def is_converged(self, eps: float = 1e-6) -> bool:
        """Whether a fresh Gauss-Newton step would change no whitened row by more than eps RMS."""
        full = with_priors(
            reduce(self.problem, self.x, small_angle=False),
            self.problem.weights,
            self.x,
            np.zeros_like(self.x),
        )
        step = pseudo_inverse(full.r, full.z)
        return float(np.linalg.norm(full.r @ step)) <= eps * np.sqrt(max(1, self.samples))
