"""Result of a calibration: identified errors, their uncertainty and the evidence of accuracy.

All statistics follow from the triangular factor R of the whitened Jacobian at the solution and from the prior
weights W (one over the prior standard deviations, 0 without a prior). With m whitened rows, p unknowns and
cost C, the sum of the squared whitened residuals:

    covariance               Σ  = (RᵀR + W²)⁻¹, as a square root S with S·Sᵀ = Σ
    effective parameters     γ  = ‖R·S‖²  (Frobenius norm; MacKay 1992)
    degrees of freedom       ν  = m - γ
    unit weight std          σ0 = sqrt(C / ν)

γ counts a parameter that the data determine as 1 and one that its prior determines as 0. σ0 is 1 if the
standard deviations of the measurements are right. If they are not stated, or if σ0² exceeds 1 by more than
three standard deviations of χ²/ν, R is divided by σ0 before the covariance is computed; the priors stay.

A result without hold-out samples is judged by cross-validation, see `cross_validation`.

Shapes: p unknowns (parameters of the robot, then of the instruments), m samples of a measurement, n joints.

Reference: D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415-447.
"""

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
from . import summary
from .arguments import as_measurements
from .cross_validation import cross_validate_folds
from .estimates import Estimate, make_estimates
from .evaluation import (
    Accuracy,
    Comparison,
    accuracy,
    compute_errors,
    remove_outliers,
)
from .initialization import fit_frames
from .partition import configuration_groups, k_fold

# Stated standard deviations are rejected if the reduced cost exceeds 1 by this many standard deviations.
CONTRADICTION_SIGMAS = 3.0
# Smallest scale of standard deviations, for residuals that are exactly zero.
MIN_SCALE = 1e-9
# Number of folds of the cross-validation without hold-out samples.
N_FOLDS = 10
# Largest number of iterations of a fold's own fit.
MAX_REFIT_ITERATIONS = 100
# Rows left over by no more than this fraction of all count as none: rounding.
MIN_FREEDOM_RATIO = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Calibrated robot with the uncertainty of its parameters and its accuracy.

    Attributes:
        errors: Nominal chain and its p_robot unknown error parameters; unknown base and tool frames are
            initialized from the data.
        x: Identified errors of the robot, then of the instruments relative to their initial values, shape
            (p,) [m or rad, or the unit of the parameter].
        chain: Calibrated chain.
        data: Fitted measurements.
        holdout: Measurements that were held out.
        problem: Least-squares problem with the final standard deviations, sample weights and priors.
        solution: Solution of `problem`.
        method: "lm" or "gn".
        weights: Robust weight of each fitted sample, one array of shape (m,) per measurement; 0 if rejected.
        shrinkage_factor: Factor c in `x = c · solution.x`; below 1 if there are too few measurements, see
            `shrinkage`.
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
        """Pinocchio model with the calibrated joint placements."""
        return self.chain.model

    @cached_property
    def nominal_refitted(self) -> Chain:
        """Nominal chain with unknown base and tool fitted to the same inliers.

        The accuracy before and after a calibration thus differs by the errors of the robot alone.
        """
        if not self.shrinkage_factor:
            return self.chain
        return fit_frames(self.errors, tuple(self.inliers), self.problem.known)

    @property
    def inliers(self) -> list[Measurement]:
        """Fitted measurements without rejected samples."""
        return self._without_rejected(self.data)

    def _without_rejected(self, data: Sequence[Measurement]) -> list[Measurement]:
        """Remove the samples of zero weight from measurements that correspond to `data`."""
        inliers = [item.take(w > robust.ZERO_WEIGHT) for item, w in zip(data, self.weights, strict=True)]
        return [item for item in inliers if len(item.rows)]

    @property
    def converged(self) -> bool:
        """Whether the last step was negligible."""
        return self.solution.converged

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return self.solution.iterations

    @property
    def n_samples(self) -> int:
        """Number of fitted samples."""
        return sum(len(d.rows) for d in self.data)

    @property
    def rank(self) -> int:
        """Number of observable directions in parameter space, without priors."""
        return qr.rank(self.solution.system.r)

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest singular value of the observable directions."""
        return qr.condition(self.solution.system.r)

    @property
    def observability_indices(self) -> dict[str, float]:
        """Observability indices O1 to O5; see `identifiability.observability_indices`."""
        return observability.observability_indices(self.solution.system.r, self.n_samples)

    @cached_property
    def unobservable(self) -> list[str]:
        """One sentence per group of parameters that the data cannot distinguish, with the reason."""
        return explanations.explain_unobservable(self.problem, self.x, self.solution.system)

    @cached_property
    def weakly_observable(self) -> list[str]:
        """One sentence per group of parameters that are hardly better known than before the measurement."""
        return explanations.explain_weakly_observable(
            self.problem, self.x, self.solution.system, self.prior_std, self._sigma_scale
        )

    @property
    def shrinkage_notes(self) -> list[str]:
        """One sentence if the correction was not applied in full, else empty."""
        if self.shrinkage_factor == 1:
            return []
        applied = f"only {100 * self.shrinkage_factor:.0f} % of the" if self.shrinkage_factor else "no"
        return [f"Too few measurements: {applied} correction applied. Measure more poses."]

    @property
    def prior_std(self) -> Array:
        """Standard deviations before the measurement, (p,): of the priors used, else of the default ones."""
        default = np.array([parameter.prior for parameter in self.parameters])
        weights = self.problem.weights
        return np.where(weights > 0, 1 / np.where(weights > 0, weights, 1.0), default)

    @property
    def posterior_to_prior_std(self) -> Array:
        """Ratio of `std` to `prior_std`, (p,): 0 for a well-known parameter, 1 or more for an unknown one."""
        return self.std / self.prior_std

    @property
    def correlation(self) -> Array:
        """Correlation matrix of x, (p, p); NaN for parameters of infinite variance."""
        return observability.correlation(self.covariance)

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Number of weighted rows minus the effective number of parameters that the data determine."""
        count = 0.0
        for item, weights in zip(self.data, self.weights, strict=True):
            frames = self.chain.forward_kinematics(item.configurations())
            count += (
                len(item.residual(frames, self.problem.instrument_values_of(item, self.x))) * weights.sum()
            )
        freedom = count - float(np.sum((self.solution.system.r @ self._sqrt_covariance[0]) ** 2))
        return freedom if freedom > MIN_FREEDOM_RATIO * count else 0.0

    @property
    def unit_weight_std(self) -> float:
        """Standard deviation σ0 of the whitened residuals, about 1; NaN without degrees of freedom."""
        system = self.solution.system
        cost = system.min_cost + float(np.sum(system.z**2))
        return float(np.sqrt(cost / self.degrees_of_freedom)) if self.degrees_of_freedom else float("nan")

    @cached_property
    def _sigma_scale(self) -> float:
        """Factor to the standard deviations of the whitened rows; NaN if it cannot be determined."""
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
        """Square root of the covariance (p, r) and unbounded directions (p, h), with sigmas as fitted."""
        return posterior_sqrt_covariance(self.solution.system, self.problem.weights)

    @cached_property
    def _scaled_sqrt_covariance(self) -> tuple[Array, Array]:
        """As `_sqrt_covariance`, with the sigmas scaled and the error of shrinkage as a further column."""
        root, unbounded = self._sqrt_covariance
        scale, system = self._sigma_scale, self.solution.system
        if np.isnan(scale) or scale == 1:
            root = root * scale
        else:
            # Scale the measured rows only; priors are not measurements.
            root, unbounded = posterior_sqrt_covariance(
                TriangularSystem(system.rows / max(scale, MIN_SCALE)), self.problem.weights
            )
        # The part of the correction that was not applied is an error of its own.
        not_applied = (self.solution.x - self.x)[:, None]
        return (np.concatenate([root, not_applied], 1) if self.shrinkage_factor < 1 else root), unbounded

    @cached_property
    def covariance(self) -> Array:
        """Covariance matrix of x, (p, p); infinite on the diagonal if nothing determines a parameter.

        Stated standard deviations are used unless the residuals contradict them. NaN if standard deviations
        are not stated and there are no degrees of freedom to estimate the noise.
        """
        root, unbounded = self._scaled_sqrt_covariance
        out = root @ root.T
        unknown = np.sum(unbounded**2, 1) > UNBOUNDED_TOL
        out[unknown, unknown] = np.inf
        return out

    @property
    def uncertainty(self) -> Uncertainty:
        """Uncertainty of the robot without that of the instruments, for predictions and for the sidecar."""
        return self._uncertainty

    @cached_property
    def _uncertainty(self) -> Uncertainty:
        root, unbounded = self._scaled_sqrt_covariance
        robot = len(self.errors.parameters)
        return Uncertainty.from_errors(
            self.errors, self.x[:robot], self.chain, root[:robot], unbounded[:robot]
        )

    def predict(self, q: Array) -> Prediction:
        """Predict tool poses and their covariance.

        The covariance of the identified errors is propagated to the tool to first order. Noise of a future
        measurement is not included.

        Args:
            q: Joint positions, (m, n) [rad or m].

        Returns:
            Poses in the measuring frame with their covariances.
        """
        return self.uncertainty.predict(q)

    @property
    def std(self) -> Array:
        """Standard deviations of x, (p,) [m or rad, or the unit of the parameter]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def observable_fraction(self) -> Array:
        """Fraction of each parameter that lies in the observable directions, (p,), 0 to 1."""
        return observability.observable_fraction(self.solution.system.r)

    @property
    def parameters(self) -> tuple[ErrorParameter | InstrumentParameter, ...]:
        """Parameters of the robot, then of the instruments, in the order of x."""
        return (*self.errors.parameters, *self.problem.instrument_parameters)

    @property
    def instruments(self) -> dict[str, float]:
        """Values of all instrument parameters by name [m or rad]."""
        return self.problem.instruments(self.x)

    @cached_property
    def studentized_residuals(self) -> tuple[Array, ...]:
        """Studentized residual of each fitted sample, one array of shape (m,) per measurement."""
        data = [item.with_weights(1 / w) for item, w in zip(self.problem.data, self.weights, strict=True)]
        return tuple(robust.studentized_residuals(self.problem, self.solution, data, self.weights))

    @cached_property
    def outliers(self) -> tuple[Array, ...]:
        """Row numbers of the outliers of each fitted measurement."""
        return tuple(
            item.rows[residuals > robust.OUTLIER_THRESHOLD]
            for item, residuals in zip(self.data, self.studentized_residuals, strict=True)
        )

    @property
    def transferable_instruments(self) -> dict[str, float]:
        """Values of the instrument parameters that hold for other measurements, too, by name [m or rad]."""
        local = {parameter.name for parameter in self.problem.instrument_parameters if parameter.is_local}
        return {name: value for name, value in self.instruments.items() if name not in local}

    @cached_property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Accuracy before and after: of hold-out or cross-validated samples, then of the fitted ones.

        Without hold-out samples, ten-fold cross-validation judges each sample by a fit without it. Rejected
        samples are in neither; outliers among the hold-out samples are included.
        """
        inliers = self.inliers
        count = sum(len(item.rows) for item in inliers)
        n_rejected = self.n_samples - count
        before = accuracy(self.nominal_refitted, inliers)
        after = accuracy(self.chain, inliers, self.instruments)
        fitted = Comparison("fitted", count, before, after, n_rejected)
        if self.holdout:
            return (self._compare_holdout(), fitted)
        n_configurations = len(np.unique(configuration_groups(inliers)))
        if n_configurations < 2:
            return (fitted,)
        folds = k_fold(inliers, min(N_FOLDS, n_configurations))
        problem = self.problem.with_data(self._without_rejected(self.problem.data))
        errors = [
            item
            for fold_errors, _ in cross_validate_folds(
                problem, self.solution.x, inliers, folds, self.refit, self.shrinkage_factor
            )
            for item in fold_errors
        ]
        after = Accuracy.from_errors(errors)
        return (Comparison("cross-validated", count, before, after, n_rejected), fitted)

    def _compare_holdout(self) -> Comparison:
        """Compare the accuracy before and after on the hold-out samples."""
        errors = compute_errors(self.chain, self.holdout, self.instruments)
        inliers, n_outliers = remove_outliers(errors)
        return Comparison(
            "hold-out",
            sum(len(item.rows) for item in self.holdout),
            accuracy(self.nominal_refitted, self.holdout),
            Accuracy.from_errors(errors),
            n_outliers=n_outliers,
            after_without_outliers=Accuracy.from_errors(inliers) if n_outliers else Accuracy(),
        )

    def refit(self, problem: Problem) -> Array:
        """Fit some of the samples by the same method.

        The fit starts from the nominal robot, as x contains information of all samples. If this calibration
        did not converge, the fit stops after as many iterations.

        Args:
            problem: `self.problem` with a part of its samples.

        Returns:
            Solution x, shape (p,) [m or rad].
        """
        nominal = np.zeros_like(self.x)
        if not self.converged:
            with suppress(DhcalError):  # method "gn" may diverge on few samples
                return minimize(problem, self.method, nominal, self.iterations).x
        return minimize(problem, "lm", nominal, MAX_REFIT_ITERATIONS).x

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """Estimates of all identified parameters, then of the fixed ones."""
        with np.errstate(divide="ignore"):
            priors = 1 / self.problem.weights
        figures = np.stack(
            [self.x, self.std, priors, self.observable_fraction, self.posterior_to_prior_std], 1
        )
        return make_estimates(self.chain, self.parameters, figures, self.errors.fixed)

    def __repr__(self) -> str:
        """Return the size of the fit and its most important figure in one line."""
        head = summary.headline(self.comparisons)
        label = summary.GROUP_LABELS[head.group]
        return (
            f"Result({len(self.parameters)} parameters, {self.n_samples} samples, "
            f"RMS {label} {head.before} before, {head.after} after, {head.comparison.title})"
        )

    def _repr_html_(self) -> str:
        """Return the headline, the accuracy and the estimates, as a notebook shows them."""
        notes = [*([] if self.converged else ["It did not converge."]), *self.shrinkage_notes]
        paragraphs = [f"<strong>{summary.headline(self.comparisons).text}</strong>", *notes]
        tables = (summary.accuracy_table(self.comparisons), summary.estimate_table(self.estimates))
        html = "".join(f"<p>{text}</p>" for text in paragraphs)
        return "\n".join([html, *map(formatting.html_table, tables)])

    def validate(self, data: Measurement | Sequence[Measurement]) -> Accuracy:
        """Compute the accuracy of the calibrated chain on other measurements.

        Args:
            data: One measurement or several, in the frames of the fitted ones.

        Returns:
            Error statistics, which can also be indexed by the keys of the JSON document, such as
            "position_rms_m" [m] and "orientation_rms_rad" [rad].
        """
        return accuracy(self.chain, as_measurements(data), self.instruments)

    def is_converged(self, eps: float = 1e-6) -> bool:
        """Check convergence with a fresh Gauss-Newton step from the solution.

        Args:
            eps: Largest RMS change of the whitened rows by that step, in standard deviations.

        Returns:
            Whether the step changes them by less.
        """
        system = linearize_and_factor(self.problem, self.solution.x, small_angle=False)
        with_priors = append_priors(system, self.problem.weights, self.solution.x)
        step = bounded_step(self.problem, with_priors, self.solution.x)
        return float(np.linalg.norm(with_priors.r @ step)) <= eps * np.sqrt(max(1, self.n_samples))
