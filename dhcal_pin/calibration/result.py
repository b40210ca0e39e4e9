"""What a calibration found, and how far to believe it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from .. import formatting
from .._typing import Array
from ..estimation import qr, robust
from ..estimation.error_model import ErrorModel, ErrorParameter
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.qr import TriangularSystem, append_priors, posterior_sqrt_covariance
from ..estimation.solver import SolverResult, bounded_step, minimize
from ..estimation.uncertainty import UNBOUNDED_TOL, Prediction, Uncertainty
from ..exceptions import DhcalError
from ..identifiability import explanations, observability
from ..measurements.base import InstrumentParameter, Measurement
from ..robot.chain import Chain
from . import estimates, summary
from .cross_validation import cross_validate_folds
from .estimates import Estimate
from .evaluation import (
    Accuracy,
    Comparison,
    accuracy,
    compute_errors,
    remove_outliers,
)
from .initialization import fit_frames
from .partition import configuration_groups, k_fold

# Residuals that are larger than stated by so many standard deviations of chance contradict the sigmas.
CONTRADICTION_SIGMAS = 3.0


# Exact rows are taken to scatter by this share of their sigmas.
MIN_SCALE = 1e-9


# Folds that samples are left out in where none were held out.
N_FOLDS = 10


# Most steps of a fit without them.
MAX_REFIT_ITERATIONS = 100


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """An identified arm and how far to believe it.

    Attributes:
        errors: the nominal chain, its base and tool about where they are, and its unknowns.
        x: (p+s,) identified errors of the robot, then the instruments' unknowns from where they
            started; m and rad.
        chain: the calibrated chain.
        data, holdout: what was fitted, and what was kept back.
        problem: with the sigmas that were used in the end.
        solution: the loop's end.
        method: "lm" or "gn".
        weights: (m,) of each fitted measurement's samples, 1 but for a robust loss.
        shrinkage_factor: how much of what fits the readings best, `solution.x`, x is: 1, or less where so few readings
            might leave the arm worse than nominal.
    """

    errors: ErrorModel
    x: Array
    chain: Chain
    data: tuple[Measurement, ...]
    holdout: tuple[Measurement, ...]
    problem: Problem
    solution: SolverResult
    method: str
    weights: tuple[Array, ...]
    shrinkage_factor: float = 1.0

    @property
    def model(self) -> pin.Model:
        """Pinocchio's model with the calibrated joint placements."""
        return self.chain.model

    @cached_property
    def nominal_refitted(self) -> Chain:
        """The nominal chain, with base and tool as fitted to the same data where they were unknown.

        So before and after differ by the robot alone.
        """
        if not self.shrinkage_factor:
            return self.chain
        return fit_frames(self.errors, tuple(self.inliers), self.problem.known)

    @property
    def inliers(self) -> list[Measurement]:
        """The fitted measurements without samples that count for nothing."""
        return self._inliers(self.data)

    def _inliers(self, data: Sequence[Measurement]) -> list[Measurement]:
        """Those samples of the fitted measurements that count in the fit."""
        found = [item.take(w > robust.ZERO_WEIGHT) for item, w in zip(data, self.weights, strict=True)]
        return [item for item in found if len(item.rows)]

    @property
    def converged(self) -> bool:
        """Whether the last step was too small to matter."""
        return self.solution.converged

    @property
    def iterations(self) -> int:
        """Steps taken."""
        return self.solution.iterations

    @property
    def n_samples(self) -> int:
        """Number of fitted samples."""
        return sum(len(d.rows) for d in self.data)

    @property
    def rank(self) -> int:
        """Number of directions that the data see, without priors."""
        return qr.rank(self.solution.system.r)

    @property
    def condition(self) -> float:
        """Largest over smallest singular value of the directions seen."""
        return qr.condition(self.solution.system.r)

    @property
    def observability_indices(self) -> dict[str, float]:
        """O1 to O5 of the samples, over the directions seen; see `observability.indices`."""
        return observability.observability_indices(self.solution.system.r, self.n_samples)

    @cached_property
    def unobservable(self) -> list[str]:
        """What the data cannot tell apart, why, and what would tell it; one sentence a group."""
        return explanations.explain_unobservable(self.problem, self.x, self.solution.system)

    @cached_property
    def weakly_observable(self) -> list[str]:
        """What counts in the rank but is hardly better known than before the measurement."""
        return explanations.explain_weakly_observable(
            self.problem, self.x, self.solution.system, self.prior_std, self._scale
        )

    @property
    def shrinkage_notes(self) -> list[str]:
        """What of the correction is not kept, and why; a sentence, or none."""
        if self.shrinkage_factor == 1:
            return []
        much = f"only {100 * self.shrinkage_factor:.0f} %" if self.shrinkage_factor else "nothing"
        return [
            f"{much} of the correction that fits best is kept: so few readings fit many arms, and more of it "
            "might leave this one worse than nominal; measure more poses"
        ]

    @property
    def prior_std(self) -> Array:
        """Standard deviations (p,) expected before the measurement: the priors used, or usual ones."""
        usual = np.array([parameter.prior for parameter in self.parameters])
        weights = self.problem.weights
        return np.where(weights > 0, 1 / np.where(weights > 0, weights, 1.0), usual)

    @property
    def posterior_to_prior_std(self) -> Array:
        """How much of each parameter's expected spread is left, (p,): 0 well known, 1 or more unknown."""
        return self.std / self.prior_std

    @property
    def correlation(self) -> Array:
        """Correlations (p, p) of x; NaN with what is unknown."""
        return observability.correlation(self.covariance)

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Rows left over; unknowns count as far as data and not priors tell them (MacKay's number)."""
        count = 0.0
        for item, weights in zip(self.data, self.weights, strict=True):
            frames = self.chain.forward_kinematics(item.configurations())
            count += (
                len(item.residual(frames, self.problem.instrument_values_of(item, self.x))) * weights.sum()
            )
        left = count - float(np.sum((self.solution.system.r @ self._sqrt_covariance[0]) ** 2))
        return left if left > 1e-6 * count else 0.0

    @property
    def unit_weight_std(self) -> float:
        """Standard deviation of the whitened residuals, about 1 for right sigmas; NaN if no row is left."""
        triangle = self.solution.system
        cost = triangle.min_cost + float(np.sum(triangle.z**2))
        return float(np.sqrt(cost / self.degrees_of_freedom)) if self.degrees_of_freedom else float("nan")

    @cached_property
    def _scale(self) -> float:
        """The scatter of a whitened row that is believed; NaN where nothing tells it."""
        if all(item.has_stated_sigma for item in self.data):
            surprise = (
                1 + CONTRADICTION_SIGMAS * np.sqrt(2 / self.degrees_of_freedom)
                if self.degrees_of_freedom
                else np.inf
            )
            return self.unit_weight_std if self.unit_weight_std**2 > surprise else 1.0
        return self.unit_weight_std

    @cached_property
    def _sqrt_covariance(self) -> tuple[Array, Array]:
        return posterior_sqrt_covariance(self.solution.system, self.problem.weights)

    @cached_property
    def _scaled_sqrt_covariance(self) -> tuple[Array, Array]:
        """As `_root`, with rows that scatter as was seen where no sigma or too small a one is stated."""
        root, hidden = self._sqrt_covariance
        scale, triangle = self._scale, self.solution.system
        if np.isnan(scale) or scale == 1:
            root = root * scale
        else:
            # The priors are no data: they stay.
            root, hidden = posterior_sqrt_covariance(
                TriangularSystem(triangle.rows / max(scale, MIN_SCALE)), self.problem.weights
            )
        # What the readings ask for and is not kept is an error of its own.
        given_up = (self.solution.x - self.x)[:, None]
        return (np.concatenate([root, given_up], 1) if self.shrinkage_factor < 1 else root), hidden

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p, p) of x; infinite on the diagonal where neither data nor a prior tell.

        Sigmas that instruments state are believed unless the residuals contradict them. NaN where one is
        not stated and there are not more rows than unknown directions, and so no noise to go by.
        """
        root, hidden = self._scaled_sqrt_covariance
        out = root @ root.T
        lost = np.sum(hidden**2, 1) > UNBOUNDED_TOL
        out[lost, lost] = np.inf
        return out

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """The robot's part of the covariance, as the calibrated arm alone needs it."""
        root, hidden = self._scaled_sqrt_covariance
        robot = len(self.errors.parameters)
        return Uncertainty.from_errors(self.errors, self.x[:robot], self.chain, root[:robot], hidden[:robot])

    def predict(self, q: Array) -> Prediction:
        """The calibrated tool poses at joint values q (m, n), rad or m, and how well they are known.

        The covariance is that of the identified errors carried to the tool to first order; noise of a
        future measurement is not in it.
        """
        return self.uncertainty.predict(q)

    @property
    def std(self) -> Array:
        """Standard deviations (p,) of x, m and rad."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def observable_fraction(self) -> Array:
        """How far the data see each parameter, (p,) between 0 and 1."""
        return observability.observable_fraction(self.solution.system.r)

    @property
    def parameters(self) -> tuple[ErrorParameter | InstrumentParameter, ...]:
        """The robot's and the instruments' unknowns, in the order of x."""
        return (*self.errors.parameters, *self.problem.instrument_parameters)

    @property
    def instruments(self) -> dict[str, float]:
        """Values of the instruments' unknowns by name, m and rad."""
        return self.problem.instruments(self.x)

    @cached_property
    def studentized_residuals(self) -> tuple[Array, ...]:
        """How far each fitted sample (m,) lies from its kind's scatter; see `studentized_residuals`."""
        data = [item.with_weights(1 / w) for item, w in zip(self.problem.data, self.weights, strict=True)]
        return tuple(robust.studentized_residuals(self.problem, self.solution, data, self.weights))

    @cached_property
    def outliers(self) -> tuple[Array, ...]:
        """Row numbers of gross errors in each fitted measurement."""
        return tuple(
            item.rows[score > robust.OUTLIER_THRESHOLD]
            for item, score in zip(self.data, self.studentized_residuals, strict=True)
        )

    @property
    def transferable_instruments(self) -> dict[str, float]:
        """Those of the instruments' values that hold for other measurements with it, too."""
        local = {unknown.name for unknown in self.problem.instrument_parameters if unknown.is_local}
        return {name: value for name, value in self.instruments.items() if name not in local}

    @cached_property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after: on what was not fitted first, then on the fitted.

        Where nothing was held out, every sample is judged by a fit without it and others, in ten folds.
        Gross errors that take no part in the fit are in neither; among what was held out they are.
        """
        kept = self.inliers
        count = sum(len(item.rows) for item in kept)
        aside = self.n_samples - count
        before = accuracy(self.nominal_refitted, kept)
        found = (Comparison("fitted", count, before, accuracy(self.chain, kept, self.instruments), aside),)
        if self.holdout:
            errors = compute_errors(self.chain, self.holdout, self.instruments)
            before, after = accuracy(self.nominal_refitted, self.holdout), Accuracy.from_errors(errors)
            clean, gross = remove_outliers(errors)
            held = sum(len(item.rows) for item in self.holdout)
            without = Accuracy.from_errors(clean) if gross else Accuracy()
            return (Comparison("held out", held, before, after, 0, gross, without), *found)
        n_configurations = len(np.unique(configuration_groups(kept)))
        if n_configurations < 2:
            return found
        folds = k_fold(kept, min(N_FOLDS, n_configurations))
        problem = self.problem.with_data(self._inliers(self.problem.data))
        judged = [
            item
            for fold, _ in cross_validate_folds(
                problem, self.solution.x, kept, folds, self.refit, self.shrinkage_factor
            )
            for item in fold
        ]
        return (Comparison("cross-validated", count, before, Accuracy.from_errors(judged), aside), *found)

    def refit(self, problem: Problem) -> Array:
        """Where a fit of some of the samples ends (p,); the same loop stopped as early if this one was.

        It starts from nominal: x has from all the samples what some of them do not tell.
        """
        nominal = np.zeros_like(self.x)
        if not self.converged:
            with suppress(DhcalError):  # on few samples the paper's loop may run away
                return minimize(problem, self.method, nominal, self.iterations).x
        return minimize(problem, "lm", nominal, MAX_REFIT_ITERATIONS).x

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """What was found of each unknown, then the parameters that were held.

        Base and tool are given by component of their place, the others as nominal plus error.
        """
        with np.errstate(divide="ignore"):
            priors = 1 / self.problem.weights
        figures = np.stack(
            [self.x, self.std, priors, self.observable_fraction, self.posterior_to_prior_std], 1
        )
        return estimates.estimates(self.chain, self.parameters, figures, self.errors.fixed)

    def __repr__(self) -> str:
        return f"<Result: {summary.headline(self.comparisons).text}>"

    def _repr_html_(self) -> str:
        """The headline, before and after, and the parameters, as a notebook shows them."""
        found = (summary.accuracy_table(self.comparisons), summary.estimate_table(self.estimates))
        doubts = [*([] if self.converged else ["It did not converge."]), *self.shrinkage_notes]
        doubt = "".join(f"<p>{text}</p>" for text in doubts)
        said = f"<p><strong>{summary.headline(self.comparisons).text}</strong></p>{doubt}"
        return "\n".join([said, *map(formatting.html_table, found)])

    def validate(self, data: Measurement | Sequence[Measurement]) -> Accuracy:
        """Accuracy of the calibrated chain on other data: position in m, orientation in rad."""
        data = (data,) if not isinstance(data, Sequence) else data
        return accuracy(self.chain, data, self.instruments)

    def is_converged(self, eps: float = 1e-6) -> bool:
        """Whether a fresh Gauss-Newton step would change no whitened row by more than eps RMS."""
        triangle = linearize_and_factor(self.problem, self.solution.x, small_angle=False)
        full = append_priors(triangle, self.problem.weights, self.solution.x)
        step = bounded_step(self.problem, full, self.solution.x)
        return float(np.linalg.norm(full.r @ step)) <= eps * np.sqrt(max(1, self.n_samples))
