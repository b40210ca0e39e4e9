"""Fitted model: identified errors of a robot, their uncertainty and the statistics of the fit.

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

Shapes: p unknowns (parameters of the robot, then of the instruments), m samples of a measurement, n joints.

Reference: D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415-447.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from .._frozen import frozen
from .._typing import Array
from ..estimation import robust
from ..estimation.bare_geometry import BareGeometry
from ..estimation.error_model import ErrorModel, ErrorParameter
from ..estimation.frame_gauge import separate_frames
from ..estimation.information import Information, Samples
from ..estimation.parameters import redundant
from ..estimation.problem import Problem, UnfactoredSystem, linearize_and_factor
from ..estimation.qr import TriangularSystem, merge_r_factors
from ..estimation.solver import SolverResult
from ..estimation.uncertainty import MAX_COLUMNS, UNBOUNDED_TOL, ModelFit, Prediction, Uncertainty
from ..identifiability import observability
from ..measurements.base import InstrumentParameter, Measurement, residual_of
from ..measurements.mounting import MountedRig
from ..robot.chain import Chain
from .cameras.sets import has_joint_values
from .evaluation import compute_errors, find_inliers, fit_nominal
from .model_selection import Extension, family_gains
from .partition import different_configurations

# Stated standard deviations are rejected if the reduced cost exceeds 1 by this many standard deviations.
CONTRADICTION_SIGMAS = 3.0
# Upper limit of the interval that holds 95 %, as a quantile of Student's t and of the normal distribution.
CONFIDENCE = 0.975
# Smallest scale of standard deviations, for residuals that are exactly zero.
MIN_SCALE = 1e-9
# Rows left over by no more than this fraction of all count as none: rounding.
MIN_FREEDOM_RATIO = 1e-6
# Smallest share of the variance of correlated residuals that counts as an error of the model. Stated standard
# deviations of an instrument may be too large.
MIN_MODEL_SHARE = 0.5
# Largest number of unknowns with which further families of joint errors are tested: correction curves, which
# take long, explain what the families would.
MAX_TESTED = 200


@frozen(eq=False)
class FittedModel:
    """Model that was fitted to measurements, with the uncertainty of its parameters."""

    #: Nominal chain and its p_robot unknown error parameters; unknown base and tool frames are initialized
    #: from the data.
    errors: ErrorModel
    #: Identified errors of the robot, then of the instruments relative to their initial values, shape (p,) [m
    #: or rad, or the unit of the parameter].
    x: Array
    chain: Chain  #: Calibrated chain
    data: tuple[Measurement, ...]  #: Fitted measurements
    holdout: tuple[Measurement, ...]  #: Measurements that were held out
    problem: Problem  #: Least-squares problem with the final standard deviations, sample weights and priors
    solution: SolverResult  #: Solution of `problem`
    method: str  #: "lm" or "gn"
    #: Robust weight of each fitted sample, one array of shape (m,) per measurement; 0 if rejected.
    weights: tuple[Array, ...]
    #: Factor c in `x = c · solution.x`; below 1 if there are too few measurements, see `shrinkage`.
    shrinkage_factor: float = 1.0
    #: Families of joint errors that were added, and how much the samples count; None if nothing was tried.
    extension: Extension | None = None
    #: Geometry that fits best without joint errors, which the URDF has; None without joint errors.
    bare: BareGeometry | None = None
    stage: str = robust.KEPT  #: Robust stage that the weights are from, see `robust.WEIGHT_FUNCTIONS`

    @property
    def urdf_alone(self) -> Chain:
        """The robot that the URDF describes without its sidecar, with the base and the tool that fit best."""
        return self.bare.chain if self.bare else self.chain

    @property
    def robot(self) -> Chain:
        """The calibrated robot, `chain`."""
        return self.chain

    @property
    def model(self) -> pin.Model:
        """Pinocchio model of the calibrated URDF."""
        return self.chain.urdf_alone.model

    @cached_property
    def nominal_refitted(self) -> Chain:
        """Nominal chain with unknown base and tool fitted to the same inliers.

        The accuracy before and after a calibration thus differs by the errors of the robot alone.
        """
        return self._nominal[0]

    @cached_property
    def _nominal(self) -> tuple[Chain, dict[str, float]]:
        """`nominal_refitted` and the instrument parameters that fit it best."""
        nominal = self.errors if self.shrinkage_factor else ErrorModel(self.chain, ())
        return fit_nominal(nominal, self.inliers, self.problem.known)

    @property
    def nominal_instruments(self) -> dict[str, float]:
        """Values of the instrument parameters that fit `nominal_refitted` best, by name [m or rad]."""
        return self._nominal[1]

    @cached_property
    def inlier_problem(self) -> Problem:
        """`problem` without rejected samples; its measurements correspond to `inliers`."""
        return self.problem.with_data(self._without_rejected(self.problem.data))

    @cached_property
    def inliers(self) -> list[Measurement]:
        """Fitted measurements without rejected samples."""
        return self._without_rejected(self.data)

    @cached_property
    def _different_configurations(self) -> tuple[Array, Array]:
        """Different configurations of the inliers, (m, n) [rad or m], and the number of a sample of each."""
        return different_configurations(self.inliers)

    def _without_rejected(self, data: Sequence[Measurement]) -> list[Measurement]:
        """Remove the samples of zero weight from measurements that correspond to `data`."""
        return take_samples(data, [w > robust.ZERO_WEIGHT for w in self.weights])

    @cached_property
    def studentized_residuals(self) -> tuple[Array, ...]:
        """Studentized residual of each fitted sample, one array of shape (m,) per measurement."""
        data = [item.with_weights(1 / w) for item, w in zip(self.problem.data, self.weights, strict=True)]
        solved = robust.SolvedProblem(self.problem, self.solution)
        return tuple(robust.studentized_residuals(solved, data, self.weights))

    @cached_property
    def is_counted(self) -> tuple[Array, ...]:
        """Whether figures of the accuracy contain each fitted sample, shape (m,) per measurement.

        They contain all but the outliers: the samples that were rejected and those whose studentized residual
        is large.
        """
        return tuple(
            (residuals <= robust.OUTLIER_THRESHOLD) & (weights > robust.ZERO_WEIGHT)
            for residuals, weights in zip(self.studentized_residuals, self.weights, strict=True)
        )

    @cached_property
    def is_holdout_counted(self) -> tuple[Array, ...]:
        """The same for each held-out sample: outliers are far from most other samples of its measurement."""
        return find_inliers(compute_errors(self.chain, self.holdout, self.instruments))

    @property
    def outliers(self) -> tuple[Array, ...]:
        """Lines of the outliers of each fitted measurement; numbers from 1 for samples from Python."""
        return tuple(item.rows[~mask] for item, mask in zip(self.data, self.is_counted, strict=True))

    @property
    def holdout_outliers(self) -> tuple[Array, ...]:
        """Lines of the outliers of each held-out measurement."""
        return tuple(
            item.rows[~mask] for item, mask in zip(self.holdout, self.is_holdout_counted, strict=True)
        )

    @property
    def counted(self) -> list[Measurement]:
        """Fitted measurements without outliers."""
        return take_samples(self.data, self.is_counted)

    @property
    def counted_holdout(self) -> list[Measurement]:
        """Held-out measurements without outliers."""
        return take_samples(self.holdout, self.is_holdout_counted)

    @property
    def n_outliers(self) -> int:
        """Number of outliers among the fitted samples."""
        return sum(map(len, self.outliers))

    @property
    def has_joint_values(self) -> bool:
        """Whether the joint positions of all samples were measured, so that joint space has a meaning."""
        return has_joint_values(self.data)

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
        """Number of fitted samples, rejected ones included."""
        return sum(len(d.rows) for d in self.data)

    @property
    def n_inliers(self) -> int:
        """Number of fitted samples without rejected ones."""
        return sum(len(item.rows) for item in self.inliers)

    @cached_property
    def _shown_system(self) -> TriangularSystem:
        """Triangular system of what was measured; the uncertainty follows from it, see `Problem.shown`."""
        problem = self.problem.shown
        if problem is self.problem:
            return self.solution.system
        return linearize_and_factor(problem, self.solution.x, small_angle=False)

    @cached_property
    def _system_at_x(self) -> TriangularSystem:
        """Triangular system of the data at x. Even a small last step rotates the null space."""
        system = self._shown_system
        if isinstance(system, UnfactoredSystem) and np.array_equal(system.x, self.x):
            return system
        return linearize_and_factor(self.problem.shown, self.x, small_angle=False)

    @cached_property
    def rank(self) -> int:
        """Number of observable directions in parameter space, without priors."""
        return self._shown_system.rank

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest singular value of the observable directions."""
        return self.solution.system.condition

    @property
    def observability_indices(self) -> dict[str, float]:
        """Observability indices O1 to O5; see `identifiability.observability_indices`."""
        return observability.observability_indices(self.solution.system, self.n_inliers)

    @property
    def prior_std(self) -> Array:
        """Standard deviations before the measurement, (p,): of the priors used, else of the default ones."""
        default = np.array([parameter.prior for parameter in self.parameters])
        weights = self.problem.prior_weights
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
        count = sum(n_rows for _, _, n_rows in self._row_counts)
        freedom = count - self._shown_system.predicted_variance(self._sqrt_covariance[0])
        return freedom if freedom > MIN_FREEDOM_RATIO * count else 0.0

    @cached_property
    def _row_counts(self) -> list[tuple[str, bool, float]]:
        """Unit, whether sigmas are stated, and weighted number of rows of each residual group."""
        counts = []
        for item, weights in zip(self.data, self.weights, strict=True):
            residual = residual_of(item, self.chain, self.problem.instruments(self.x))
            counts += [
                (group.unit, item.has_stated_sigma, len(residual[group.rows]) * weights.sum())
                for group in item.residual_groups.values()
            ]
        return counts

    @property
    def noise_degrees_of_freedom(self) -> float:
        """Degrees of freedom of the least known noise scale; infinite if all sigmas are stated.

        The residual groups share the loss of degrees of freedom in proportion to their rows. A group with few
        rows takes the common scale of its unit, as in `reweighting.estimate_variance_components`.
        """
        estimated = [(unit, count) for unit, is_stated, count in self._row_counts if not is_stated]
        if not estimated:
            return np.inf
        least = min(
            count
            if count > self.rank
            else sum(other for other_unit, other in estimated if other_unit == unit)
            for unit, count in estimated
        )
        return self.degrees_of_freedom * least / sum(count for _, _, count in self._row_counts)

    @property
    def unit_weight_std(self) -> float:
        """Standard deviation σ0 of the whitened residuals, about 1; NaN without degrees of freedom."""
        freedom = self.degrees_of_freedom
        return float(np.sqrt(self.solution.system.cost / freedom)) if freedom else float("nan")

    @cached_property
    def _squared_residuals(self) -> list[float]:
        """Weighted sum of the squared residuals of each measurement, in units of its own sigmas."""
        # Those of the problem are scaled where joint errors were added.
        residuals = self.problem.residuals(self.solution.x, self.data)
        return [float(np.sum(r**2 * w)) for r, w in zip(residuals, self.weights, strict=True)]

    @property
    def contradicts_sigma(self) -> bool:
        """Whether the residuals are larger than the standard deviations explain, if all are stated."""
        freedom = self.degrees_of_freedom
        return bool(freedom) and _exceeds_one(sum(self._squared_residuals) / freedom, freedom)

    @property
    def sigma_ratios(self) -> tuple[float | None, ...]:
        """Residuals of each measurement over its stated sigmas; None unless the sigmas are too small."""
        if not all(item.has_stated_sigma for item in self.data) or not self.contradicts_sigma:
            return (None,) * len(self.data)
        n_rows = [item.residual_dim * w.sum() for item, w in zip(self.data, self.weights, strict=True)]
        share = self.degrees_of_freedom / sum(n_rows)
        return tuple(
            float(np.sqrt(squares / (share * count))) if count else None
            for squares, count in zip(self._squared_residuals, n_rows, strict=True)
        )

    @cached_property
    def _sigma_scale(self) -> float:
        """Factor to the standard deviations of the whitened rows; NaN if it cannot be determined."""
        # A noise scale from few rows is uncertain itself: ±1.96 of the standard deviations contain 95 % of a
        # t distribution.
        if all(item.has_stated_sigma for item in self.data):
            freedom = self.degrees_of_freedom
            if not freedom or not _exceeds_one(self.unit_weight_std**2, freedom):
                return 1.0
            return self.unit_weight_std * _student_ratio(self.degrees_of_freedom)
        return self.unit_weight_std * _student_ratio(self.noise_degrees_of_freedom)

    @cached_property
    def _sqrt_covariance(self) -> tuple[Array, Array]:
        """Square root of the covariance (p, r) and unbounded directions (p, h), with sigmas as fitted."""
        return self._shown_system.sqrt_covariance(self.problem.weights)

    @cached_property
    def _scaled_sqrt_covariance(self) -> tuple[Array, Array]:
        """As `_sqrt_covariance`, with the sigmas scaled and the error of shrinkage as a further column."""
        root, unbounded = self._scaled_root(self._shown_system, self.problem.weights)
        # The part of the correction that was not applied is an error of its own.
        not_applied = (self.solution.x - self.x)[:, None]
        return (np.concatenate([root, not_applied], 1) if self.shrinkage_factor < 1 else root), unbounded

    def _scaled_root(self, system: TriangularSystem, weights: Array) -> tuple[Array, Array]:
        """Return the square root of the covariance with a system and priors, and unbounded directions."""
        scale = self._sigma_scale
        if np.isnan(scale) or scale == 1:
            is_own = system is self._shown_system
            root, unbounded = self._sqrt_covariance if is_own else system.sqrt_covariance(weights)
            root = root * scale
        else:
            # Scale the measured rows only; priors are not measurements.
            root, unbounded = system.scaled(1 / max(scale, MIN_SCALE)).sqrt_covariance(weights)
        # The variance of correlated residuals counts T times against the priors.
        return root * np.sqrt(self.problem.temperature), unbounded

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

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Uncertainty of the robot without that of the instruments, for predictions and for the sidecar."""
        root, unbounded = self._scaled_sqrt_covariance
        robot = len(self.errors.parameters)
        # Predictions agree with the errors of left-out regions, see `model_selection`.
        scale = self.extension.prediction_scale if self.extension else 1.0
        # What the fit held, because no measurement shows it, is uncertain, too.
        held = self.errors.undetermined
        errors = self.errors.with_parameters(held) if held else self.errors
        is_held = np.array([p in held for p in errors.parameters], bool)
        held_axes = np.eye(len(is_held))[:, is_held]

        def of_all(rows: Array) -> Array:
            out = np.zeros((len(is_held), rows.shape[1]))
            out[~is_held] = rows[:robot]
            return out

        x = of_all(self.x[:, None])[:, 0]
        uncertainty = Uncertainty.from_errors(
            errors,
            x,
            self.chain,
            np.concatenate([of_all(scale * root), errors.priors[:, None] * held_axes], 1),
            of_all(unbounded),
            self.problem.temperature,
            self._residual_std(self._model_share) if self.problem.temperature > 1 else (0.0, 0.0),
        )
        uncertainty = replace(uncertainty, fit=self._model_fit)
        if len(self.x) > MAX_COLUMNS and not held:
            uncertainty = replace(uncertainty, information=self._information(scale, root))
        if (self.rank == len(self.x) and not held) or not robot:
            return uncertainty
        null_space = np.concatenate([of_all(self._system_at_x.null_space), held_axes], 1)
        undetermined = Uncertainty.from_errors(errors, x, self.chain, null_space, null_space[:, :0])
        q, _ = self._different_configurations
        return separate_frames(uncertainty, undetermined.sqrt_covariance, q)

    @property
    def _complete_uncertainty(self) -> Uncertainty:
        """Uncertainty with the errors, too, that the minimal set leaves out as others imitate them."""
        errors = replace(self.errors, chain=self.chain)
        left_out = redundant(errors)
        if not left_out or len(self.x) > MAX_COLUMNS or errors.undetermined:
            return self.uncertainty
        robot, n, count = len(errors.parameters), len(self.x), len(left_out)
        alone = ErrorModel(self.chain, ()).with_parameters(left_out)
        imitated = Uncertainty.from_errors(
            alone, np.zeros(count), self.chain, np.eye(count), np.empty((count, 0))
        )
        # Errors of the model with the same effects, (p, c).
        same = np.zeros((n, count))
        same[:robot] = errors.priors[:, None] * imitated.of_parameters(errors, errors.priors)[0]
        # Priors that grew with the measurements contain these errors already.
        weights = np.append(self.problem.weights, [self._prior_weight_like(p) for p in alone.parameters])
        rows = self._shown_system.rows
        columns = np.concatenate([rows[:, :-1], rows[:, :-1] @ same, rows[:, -1:]], 1)
        system = TriangularSystem(merge_r_factors([columns, np.zeros((count, columns.shape[1]))]))
        parts = (part[:n] + same @ part[n:] for part in self._scaled_root(system, weights))
        root, unbounded = (part[:robot] for part in parts)
        not_applied = (self.solution.x - self.x)[:robot, None]
        scale = self.extension.prediction_scale if self.extension else 1.0
        root = scale * np.concatenate([root, not_applied], 1)
        return Uncertainty.from_errors(self.errors, self.x[:robot], self.chain, root, unbounded)

    def _prior_weight_like(self, parameter: ErrorParameter) -> float:
        """Return the prior weight of a further error: that of errors of its unit, at least their default."""
        members = [
            i
            for i, p in enumerate(self.errors.parameters)
            if p.unit == parameter.unit and p.coefficient_index is None and self.errors.is_of_arm[i]
        ]
        if not members:
            return np.sqrt(self.problem.temperature) / parameter.prior
        weight = float(np.median(self.problem.weights[members]))
        default = np.sqrt(self.problem.temperature) / float(np.median(self.errors.priors[members]))
        return max(weight, default) if weight else 0.0

    @property
    def _model_fit(self) -> ModelFit:
        """How well the model explains the measurements."""
        # Correlated residuals are errors of the model, which the uncertainty contains.
        is_stated = self.problem.temperature == 1 and all(item.has_stated_sigma for item in self.data)
        chi_square = self.unit_weight_std**2 * self.degrees_of_freedom
        has_chi_square = is_stated and np.isfinite(chi_square)
        is_tested = self.degrees_of_freedom > 0 and len(self.x) <= MAX_TESTED
        gains = family_gains(self.problem, self.x, self.weights) if is_tested else {}
        return ModelFit(
            float(chi_square) if has_chi_square else None,
            float(self.degrees_of_freedom),
            gains,
            self._residual_std(lambda *_: 1.0),
        )

    def _information(self, scale: float, root: Array) -> Information | None:
        """Return what the covariance scale²·root·rootᵀ of the parameters follows from."""
        samples = Samples.of(self.problem, self.x)
        if samples is None:
            return None
        robot = len(self.errors.parameters)
        rows = Uncertainty.from_errors(
            self.errors, self.x[:robot], self.chain, np.eye(robot), np.empty((robot, 0))
        )
        n_coefficients = len(rows.entries)
        n_bodies, n_geometric = len(rows.sqrt_covariance) - n_coefficients, robot - n_coefficients
        factor = 1 / (scale**2 * self.problem.temperature)
        return Information(
            samples,
            rows.sqrt_covariance[:n_bodies, :n_geometric],
            np.sqrt(factor) * self.problem.weights[:robot],
            factor / max(self._sigma_scale, MIN_SCALE) ** 2,
            root=scale * root[:robot],
        )

    @property
    def has_free_frames(self) -> bool:
        """Whether the measurements leave the pose of base or tool free, at least in part."""
        return self.uncertainty.has_free_frames

    @property
    def relative(self) -> Uncertainty:
        """Uncertainty relative to the base and tool poses that fit the fitted samples best.

        It is that of `predict` if the measurements determine these poses. Images of a board do not.
        """
        return self.uncertainty.relative

    def _residual_std(self, share: Callable[[Measurement, slice], float]) -> tuple[float, float]:
        """Return the standard deviation of a share of the residuals per axis [m], [rad]."""
        # The residuals are those of the inliers. The share of their squares is given by measurement and rows.
        squares: dict[str, list[Array]] = {"m": [], "rad": []}
        errors = compute_errors(self.chain, self.inliers, self.instruments)
        for item, by_group in zip(self.inliers, errors, strict=True):
            for name, group in item.residual_groups.items():
                part = share(item, group.rows) * np.ravel(by_group[name]) ** 2
                squares.get(group.unit, []).append(part)
        length, angle = (
            float(np.sqrt(self._rows_per_freedom * np.mean(np.concatenate(parts)))) if parts else 0.0
            for parts in squares.values()
        )
        return length, angle

    def _model_share(self, item: Measurement, rows: slice) -> float:
        """Return the share of squared residuals that the stated noise of the instrument does not explain."""
        if not item.has_stated_sigma:
            return 1.0
        whitened = residual_of(item, self.chain, self.instruments)[rows]
        noise = 1 / (self._rows_per_freedom * max(float(np.mean(whitened**2)), 1.0))
        return max(1 - noise, MIN_MODEL_SHARE)

    @property
    def _rows_per_freedom(self) -> float:
        """Number of rows per degree of freedom."""
        n_rows = sum(count for _, _, count in self._row_counts)
        return n_rows / self.degrees_of_freedom if self.degrees_of_freedom else 1.0

    def predict(self, q: Array) -> Prediction:
        """Predict tool poses and their covariance.

        The covariance of the identified errors is propagated to the tool to first order. Where residuals are
        correlated, errors that the model lacks are added. Noise of a future measurement is not included.

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
        return observability.observable_fraction(self._shown_system)

    @property
    def parameters(self) -> tuple[ErrorParameter | InstrumentParameter, ...]:
        """Parameters of the robot, then of the instruments, in the order of x."""
        return self.problem.parameters

    @property
    def instruments(self) -> dict[str, float]:
        """Values of the instrument parameters by name [m or rad].

        A parameter that no fitted sample depends on, such as a point that only hold-out samples touch, is not
        among them.
        """
        is_unused = self.solution.system.is_unobserved[len(self.errors.parameters) :]
        unused = {
            p.name for p, never in zip(self.problem.instrument_parameters, is_unused, strict=True) if never
        }
        return {name: v for name, v in self.problem.instruments(self.x).items() if name not in unused}

    @property
    def transferable_instruments(self) -> dict[str, float]:
        """Values of the instrument parameters that hold for other measurements, too, by name [m or rad]."""
        local = {parameter.name for parameter in self.problem.instrument_parameters if parameter.is_local}
        return {name: value for name, value in self.instruments.items() if name not in local}

    @property
    def rig(self) -> MountedRig | None:
        """Cameras and boards with their estimated poses and lenses; None without image coordinates."""
        rigs = (item.solved_rig(self.instruments) for item in self.data)
        return next((rig for rig in rigs if rig is not None), None)


def take_samples(data: Sequence[Measurement], masks: Sequence[Array]) -> list[Measurement]:
    """Take some samples of each measurement; measurements without any are left out."""
    return [item.take(mask) for item, mask in zip(data, masks, strict=True) if mask.any()]


def _exceeds_one(variance: float, freedom: float) -> bool:
    """Return whether the variance of whitened residuals is significantly larger than 1."""
    return variance > 1 + CONTRADICTION_SIGMAS * np.sqrt(2 / freedom)


def _student_ratio(degrees_of_freedom: float) -> float:
    """Return the 97.5 % quantile of Student's t distribution relative to that of the normal distribution."""
    from scipy.special import ndtri, stdtrit  # lazy import: a third of the import time of this package

    if not degrees_of_freedom:
        return np.nan
    return float(stdtrit(degrees_of_freedom, CONFIDENCE) / ndtri(CONFIDENCE))
