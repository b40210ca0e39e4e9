"""What a calibration found, and how far to believe it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from . import explanations, observability, robust
from .chain import Chain
from .measurements import Measurement, Unknown
from .parameters import ErrorModel, Parameter
from .problem import Problem, reduce, shared_unknowns
from .se3 import Array
from .solver import Solution, levenberg_marquardt, posterior_root, pseudo_inverse, with_priors

# A parameter, or a metre and a radian of the tool, with more than this share of itself unseen is unknown.
UNKNOWN = 1e-6
# Residuals that are larger than stated by so many standard deviations of chance contradict the sigmas.
CONTRADICTION = 3.0


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
class Prediction:
    """Tool poses of a calibrated arm, and how well they are known.

    Attributes:
        poses: (m, 4, 4) in the measuring frame.
        covariance: (m, 6, 6) of the tool point's displacement [v, ω], m and rad, in axes of the
            measuring frame; infinite on the diagonal where neither data nor a prior tell.
    """

    poses: Array
    covariance: Array

    @property
    def position_std(self) -> Array:
        """Root of the position's total variance (m,), m: the RMS distance to expect."""
        return np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))

    @property
    def orientation_std(self) -> Array:
        """Root of the rotation vector's total variance (m,), rad: the RMS angle to expect."""
        return np.sqrt(np.trace(self.covariance[:, 3:, 3:], axis1=1, axis2=2))


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
    def observability_indices(self) -> dict[str, float]:
        """O1 to O5 of the samples, over the directions seen; see `observability.indices`."""
        return observability.indices(self.solution.triangle.r, self.samples)

    @cached_property
    def unobservable(self) -> list[str]:
        """What the data cannot tell apart, why, and what would tell it; one sentence a group."""
        return explanations.unobservable(self.problem, self.x, self.solution.triangle)

    @cached_property
    def weakly_seen(self) -> list[str]:
        """What counts in the rank but is hardly better known than before the measurement."""
        return explanations.weakly_seen(
            self.problem, self.x, self.solution.triangle, self.expected, self._scale
        )

    @property
    def expected(self) -> Array:
        """Standard deviations (p,) expected before the measurement: the priors used, or usual ones."""
        usual = np.array([parameter.prior for parameter in self.parameters])
        weights = self.problem.weights
        return np.where(weights > 0, 1 / np.where(weights > 0, weights, 1.0), usual)

    @property
    def remaining(self) -> Array:
        """How much of each parameter's expected spread is left, (p,): 0 well known, 1 or more unknown."""
        return self.std / self.expected

    @property
    def correlation(self) -> Array:
        """Correlations (p, p) of x; NaN with what is unknown."""
        return observability.correlation(self.covariance)

    @cached_property
    def freedom(self) -> float:
        """Rows left over; unknowns count as far as data and not priors tell them (MacKay's number)."""
        count = 0.0
        for item, weights in zip(self.data, self.weights, strict=True):
            sweep = self.chain.sweep(item.configurations())
            count += len(item.residual(sweep, self.problem.values(item, self.x))) * weights.sum()
        left = count - float(np.sum((self.solution.triangle.r @ self._root[0]) ** 2))
        return left if left > 1e-6 * count else 0.0

    @property
    def noise(self) -> float:
        """Standard deviation of the whitened residuals, about 1 for right sigmas; NaN if no row is left."""
        triangle = self.solution.triangle
        cost = triangle.rest + float(np.sum(triangle.z**2))
        return float(np.sqrt(cost / self.freedom)) if self.freedom else float("nan")

    @cached_property
    def _scale(self) -> float:
        """The scatter of a whitened row that is believed; NaN where nothing tells it."""
        if all(item.stated for item in self.data):
            surprise = 1 + CONTRADICTION * np.sqrt(2 / self.freedom) if self.freedom else np.inf
            return self.noise if self.noise**2 > surprise else 1.0
        return self.noise

    @cached_property
    def _root(self) -> tuple[Array, Array]:
        return posterior_root(self.solution.triangle, self.problem.weights)

    @cached_property
    def _spread(self) -> tuple[Array, Array]:
        """As `_root`, scaled by the scatter that was seen where no sigma or too small a one is stated."""
        root, hidden = self._root
        return root * self._scale, hidden

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of x; infinite on the diagonal where neither data nor a prior tell.

        Sigmas that instruments state are believed unless the residuals contradict them. NaN where one is
        not stated and there are not more rows than unknown directions, and so no noise to go by.
        """
        root, hidden = self._spread
        out = root @ root.T
        lost = np.sum(hidden**2, 1) > UNKNOWN
        out[lost, lost] = np.inf
        return out

    def predict(self, q: Array) -> Prediction:
        """The calibrated tool poses at joint values q (m, n), rad or m, and how well they are known.

        The covariance is that of the identified errors carried to the tool to first order; noise of a
        future measurement is not in it.
        """
        root, hidden = self._spread
        robot = len(self.errors.parameters)
        chain, bodies, twists = self.errors.derivative(self.x[:robot])
        sweep = chain.sweep(q)
        velocities = chain.tool_velocities(sweep, bodies, twists)
        carried = np.einsum("pim,pr->mir", velocities, root[:robot])
        covariance = carried @ np.swapaxes(carried, 1, 2)
        lost = np.einsum("pim,pr->mir", velocities, hidden[:robot])
        rows, axes = np.nonzero(np.sum(lost**2, -1) > UNKNOWN)
        covariance[rows, axes, axes] = np.inf
        return Prediction(sweep.poses(), covariance)

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
