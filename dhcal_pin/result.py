"""What a calibration found, and how far to believe it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from . import observability
from .chain import Chain
from .measurements import Measurement
from .parameters import ErrorModel, Parameter
from .se3 import Array
from .solver import Problem, Solution, pseudo_inverse, reduce, with_priors


def accuracy(chain: Chain, data: Sequence[Measurement]) -> dict[str, float]:
    """RMS and largest position error in m, and RMS orientation error in rad, of a chain on data."""
    groups: dict[str, list[Array]] = {}
    for item in data:
        for name, error in item.errors(chain.sweep(item.q)).items():
            groups.setdefault(name, []).append(np.linalg.norm(error, axis=1))
    out: dict[str, float] = {}
    if "position" in groups:
        size = np.concatenate(groups["position"])
        out |= {"position_rms_m": float(np.sqrt(np.mean(size**2))), "position_max_m": float(size.max())}
    if "orientation" in groups:
        size = np.concatenate(groups["orientation"])
        out["orientation_rms_rad"] = float(np.sqrt(np.mean(size**2)))
    return out


@dataclass(frozen=True, eq=False)
class Result:
    """An identified arm and how far to believe it.

    Attributes:
        errors: the nominal chain and its unknowns.
        x: (p,) identified errors, m and rad.
        chain: the calibrated chain.
        reference: the nominal chain, with base and tool as fitted to the same data where they were
            unknown, so that before and after differ by the robot alone.
        data, holdout: what was fitted, and what was kept back.
        problem: with the sigmas that were used in the end.
        solution: the loop's end.
        method: "lm" or "gn".
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
        return sum(len(d.q) for d in self.data)

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
        return observability.unobservable(self.solution.triangle.r, self.errors.parameters)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the whitened residuals, about 1 where the sigmas are right."""
        count = sum(d.residual(self.chain.sweep(d.q)).size for d in self.data)
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
    def parameters(self) -> tuple[Parameter, ...]:
        """The unknowns, in the order of x."""
        return self.errors.parameters

    def validate(self, data: Measurement | Sequence[Measurement]) -> dict[str, float]:
        """Accuracy of the calibrated chain on other data: position in m, orientation in rad."""
        return accuracy(self.chain, (data,) if not isinstance(data, Sequence) else data)

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
