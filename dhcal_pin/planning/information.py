"""Fisher information of measurements before they are taken, and the position errors that remain.

The unknowns are p kinematic errors of the robot and s' parameters of the instrument, scaled by their prior
standard deviations. To first order, knowledge is an R factor: [I] for the priors, the scaled R factor of
existing measurements, or the inverse square root of the covariance of an earlier calibration. Measuring at
joint positions q appends the whitened Jacobian rows A(q), which do not depend on the measured values:

    C = (R₀ᵀR₀ + Σ A(q_i)ᵀA(q_i))⁻¹.

The mean squared position error over a task with tool Jacobians J_t (linear part) is tr(Wᵀ·C·W), where Wᵀ is
the R factor of all J_t, divided by the square root of their number.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Self

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..calibration.cameras import held_values, image_sets, split_sets
from ..calibration.procedure import calibrate
from ..estimation import qr
from ..estimation.error_model import ErrorModel
from ..estimation.frame_gauge import frame_combinations
from ..estimation.initialization import make_problem
from ..estimation.parameters import PARAMETER_SETS, select_parameters
from ..estimation.priors import Priors, prior_weights
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.uncertainty import Uncertainty
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..measurements import KINDS
from ..measurements.base import Measurement, Noise
from ..robot.chain import Chain
from .exchange import compute_sqrt_covariance
from .instruments import CameraInstrument, Instrument, PresentModel, SimulatedInstrument
from .views import PlannedImages

# Configurations at which initial values of instrument parameters are computed.
_N_PLACEMENT_SAMPLES = 200
# Standard deviation of joint positions from pose to pose that no model describes: one arcminute of a gear,
# and a comparable length of a linear axis [m, rad].
JOINT_SCATTER = Noise(5e-5, np.deg2rad(1 / 60))
# Standard deviations below this fraction of the largest one are zero up to rounding.
ZERO_STD_RTOL = 1e-9


@frozen(eq=False)
class PlannedCalibration:
    """Calibration whose measurements are planned; the options are those of `calibrate`."""

    chain: Chain  #: Nominal robot.
    kind: str  #: Name in `KINDS`; "camera" with `images`.
    #: Standard deviations of a measurement [m, rad]; None for those of the existing measurements.
    noise: Noise | None
    #: Parameter sets; None for those of the chain, or for images the default ones.
    parameters: str | None = None
    priors: Priors = "default"  #: Prior standard deviations.
    fix: Sequence[str] = ()  #: Parameters to fix.
    free: Sequence[str] = ()  #: Parameters to free.
    data: Sequence[Measurement] = ()  #: Existing measurements.
    known: Mapping[str, float] = field(default_factory=dict)  #: Values of known instrument parameters.
    #: Uncertainty of the calibration that made the chain. It replaces the priors of the parameters that the
    #: calibration estimated.
    prior_uncertainty: Uncertainty | None = None
    #: Cameras and boards of the kind "camera"; existing measurements are images by them.
    images: PlannedImages | None = None

    def with_free_points(self, boards: Collection[str]) -> PlannedCalibration:
        """Return a copy that estimates the corners of some boards, and takes those of all others as exact."""
        if self.images is None or set(self.images.free_boards) == set(boards):
            return self
        return replace(self, images=self.images.with_free_points(boards))


@frozen(eq=False)
class Information:
    """Knowledge before a measurement, and the information of measurements at any configurations.

    Shapes: p robot parameters, s instrument parameters of the kind, s' further unknowns of instruments. The
    unknowns are the robot parameters, then the instrument parameters, in units of their prior standard
    deviations.
    """

    errors: ErrorModel  #: Error model of the robot.
    x: Array  #: Present values of the robot parameters, shape (p,) [m or rad].
    instrument: Instrument  #: Source of the measurements.
    instrument_values: Array  #: Values of the kind's instrument parameters, shape (s,).
    instrument_columns: Array  #: Column of each of them among the unknowns, -1 if it is known, shape (s,).
    prior_sigma: Array  #: Prior standard deviations of the unknowns, shape (p+s',) [m or rad].
    prior_factor: Array  #: R factor of priors and existing measurements, shape (p+s', p+s').
    data_factor: Array  #: R factor of the existing measurements alone, shape (p+s', p+s') or (0, p+s').
    fitted: Array  #: Whether the fit estimates each unknown, shape (p+s',). It takes the others as zero.

    @cached_property
    def _model(self) -> PresentModel:
        """Robot and instrument at the present values of their parameters."""
        return PresentModel(*self.errors.derivative(self.x), self.instrument_values)

    @property
    def chain(self) -> Chain:
        """Robot at the present values of its parameters."""
        return self._model.chain

    @property
    def noise(self) -> Noise:
        """Standard deviations that measurements of different configurations do not share [m, rad]."""
        return self.instrument.noise

    def rows(self, q: Array) -> Array:
        """Compute the whitened Jacobian rows of measurements."""
        return self._of_unknowns(*self.instrument.jacobians(self._model, q))

    def _of_unknowns(self, by_errors: Array, by_instrument: Array) -> Array:
        """Return the derivative (p+s', k, m) by the unknowns in units of their prior standard deviations."""
        out = np.zeros((len(self.prior_sigma), *by_errors.shape[1:]))
        out[: len(by_errors)] = by_errors
        is_unknown = self.instrument_columns >= 0
        out[self.instrument_columns[is_unknown]] = by_instrument[is_unknown]
        return out * self.prior_sigma[:, None, None]

    def task_combinations(self, q: Array) -> Array:
        """Compute combinations of the unknowns whose variances sum to the mean squared position error."""
        return np.asarray(np.linalg.qr(self._task_rows(q), mode="r")).T

    def _task_rows(self, q: Array) -> Array:
        """Compute the displacements (k, p+s') whose squares sum to the mean squared position error."""
        found = self._of_unknowns(*self.instrument.displacements(self._model, q))
        return found.reshape(len(found), -1).T / np.sqrt(len(q))

    def relative_combinations(self, q: Array, undetermined: Array) -> tuple[Array, bool]:
        """Return the errors relative to the free base and tool poses that fit the task best."""
        # Poses are free in directions (p+s', d) that measurements do not determine. Return, too, if there are
        # any.
        rows = self._task_rows(q)
        frames = self.instrument.frame_displacements(self._model, q)
        is_free = bool(undetermined.size and frames.size)
        if is_free:
            effects, largest = rows @ undetermined, float(np.linalg.norm(rows, 2))
            combined = effects @ frame_combinations(effects, frames.reshape(len(frames), -1).T, largest)
            rows, is_free = rows - combined @ (combined.T @ rows), bool(combined.size)
        return np.asarray(np.linalg.qr(rows, mode="r")).T, is_free

    def without_omitted(self) -> Information:
        """Return the knowledge about the fitted unknowns alone, as if the omitted ones were zero."""
        fitted, n_robot = self.fitted, len(self.x)
        parameters = [
            p for p, is_fitted in zip(self.errors.parameters, fitted[:n_robot], strict=True) if is_fitted
        ]
        columns = np.where(self.instrument_columns < 0, -1, np.cumsum(fitted)[self.instrument_columns] - 1)
        return replace(
            self,
            errors=replace(self.errors, parameters=tuple(parameters)),
            x=self.x[fitted[:n_robot]],
            instrument_columns=columns,
            prior_sigma=self.prior_sigma[fitted],
            prior_factor=np.asarray(np.linalg.qr(self.prior_factor[:, fitted], mode="r")),
            data_factor=self.data_factor[:, fitted],
            fitted=fitted[fitted],
        )

    def observable_directions(self, rows: Array) -> Array:
        """Compute the directions that existing and further measurements observe."""
        stacked = np.concatenate([self.data_factor, rows.reshape(-1, len(self.prior_sigma))])
        return qr.row_space(np.asarray(np.linalg.qr(stacked, mode="r")))

    def predict_error(self, rows: Array, combinations: Array) -> float:
        """Predict the RMS position error [m] over a task after measurements with rows (n, k, p+s')."""
        sqrt_covariance = compute_sqrt_covariance(self.prior_factor, rows)
        return float(np.sqrt(np.sum((combinations.T @ sqrt_covariance) ** 2)))

    @classmethod
    def from_prior(cls, planned: PlannedCalibration, q: Array, omitted_sets: Sequence[str] = ()) -> Self:
        """Collect the knowledge before measuring from priors, existing measurements or a calibration."""
        if planned.priors == "none":
            raise InvalidArgumentError(
                "priors 'none': a plan needs priors; choose default, or standard deviations by name"
            )
        known_before = (
            _before_measuring(planned, q)
            if planned.images is None
            else _before_images(planned, planned.images, q)
        )
        problem, values, template = known_before.problem, known_before.values, known_before.template
        errors, x, sigma, fitted = _add_parameter_sets(
            known_before.errors, known_before.x, known_before.sigma, omitted_sets
        )
        # Column of each instrument parameter by name, and R factor of the existing measurements.
        columns, r = {}, np.zeros((0, len(sigma)))
        if problem is not None:
            columns = {p.name: len(x) + i for i, p in enumerate(problem.instrument_parameters)}
            x_all = np.concatenate([x, known_before.differences])
            r = linearize_and_factor(replace(problem, errors=errors), x_all, small_angle=False).r
        instrument_columns = []
        for parameter in template.instrument_parameters:
            if parameter.name not in values:
                columns[parameter.name] = len(sigma)
                sigma, fitted = np.append(sigma, parameter.prior), np.append(fitted, True)
            instrument_columns.append(columns.get(parameter.name, -1))
        data_factor = np.zeros((len(r), len(sigma)))
        data_factor[:, : r.shape[1]] = r * sigma[: r.shape[1]]
        stacked = np.concatenate([data_factor, np.eye(len(sigma))])
        if planned.prior_uncertainty is not None:
            # Replace the prior rows of the robot parameters.
            rows = _information_rows(*planned.prior_uncertainty.of_parameters(errors, sigma[: len(x)]))
            stacked[len(data_factor) : len(data_factor) + len(x), : len(x)] = rows
        return cls(
            errors=errors,
            x=x,
            instrument=known_before.instrument,
            instrument_values=np.array(
                [
                    values.get(parameter.name, parameter.nominal)
                    for parameter in template.instrument_parameters
                ]
            ),
            instrument_columns=np.array(instrument_columns, int),
            prior_sigma=sigma,
            prior_factor=np.asarray(np.linalg.qr(stacked, mode="r")),
            data_factor=data_factor,
            fitted=fitted,
        )


@frozen(eq=False)
class _Before:
    """Robot, instrument and existing measurements before a plan."""

    errors: ErrorModel  # Error model of the robot
    x: Array  # Present values of its parameters, shape (p,) [m or rad]
    sigma: Array  # Prior standard deviations of these and of the unknowns in `differences`
    instrument: Instrument  # Source of the measurements
    template: Measurement  # Measurements with initial values of the instrument parameters
    # Values of instrument parameters that are known, or estimated from the existing measurements.
    values: dict[str, float]
    problem: Problem | None = None  # Least-squares problem of the existing measurements; None without any
    # Its estimated instrument parameters less their initial values.
    differences: Array = field(default_factory=lambda: np.zeros(0))


def _before_measuring(planned: PlannedCalibration, q: Array) -> _Before:
    """Return what is known before measurements of a kind at configurations like q, shape (m, n)."""
    chain, kind, noise, known = planned.chain, planned.kind, planned.noise, planned.known
    maker = _plannable_kind(kind)
    sets = planned.parameters if planned.parameters is not None else chain.parameters
    errors = select_parameters(chain, sets, planned.fix, planned.free)
    x, sigma = np.zeros(len(errors.parameters)), 1 / prior_weights(errors, planned.priors)
    fit = None
    if planned.data:
        fit = calibrate(
            chain,
            planned.data,
            planned.parameters,
            priors=planned.priors,
            fix=planned.fix,
            free=planned.free,
            known=known,
            extend="none",
        )
        errors, x, sigma = fit.errors, fit.x[: len(x)], 1 / fit.problem.prior_weights
        noise = noise or _sigma_of(fit.problem.data, kind)
    if noise is None:
        raise InvalidArgumentError(
            f"kind {kind!r}: the standard deviation is unknown; give one, for example 0.1mm,0.01deg"
        )
    instrument = SimulatedInstrument(maker, noise)
    template = instrument.template(errors.at(x), q[:_N_PLACEMENT_SAMPLES])
    if not template.has_stated_sigma:
        has_angles = any(group.unit == "rad" for group in maker.residual_groups.values())
        example = "0.1mm,0.01deg" if has_angles else "0.1mm"
        raise InvalidArgumentError(
            f"kind {kind!r}: standard deviations must be above zero; give them, for example {example}"
        )
    if fit is None:
        return _Before(errors, x, sigma, instrument, template, dict(known))
    values = dict(known) | fit.instruments
    return _Before(errors, x, sigma, instrument, template, values, fit.problem, fit.x[len(x) :])


def _before_images(planned: PlannedCalibration, images: PlannedImages, q: Array) -> _Before:
    """Return what is known before images at configurations like q, (m, n)."""
    # Existing images are linearized at the nominal robot: a plan does not depend on their measured values.
    chain = planned.chain
    robot_sets, rig_sets = split_sets(
        planned.parameters if planned.parameters is not None else image_sets(chain)
    )
    errors = ErrorModel(chain, ())
    if robot_sets or planned.free:
        errors = select_parameters(chain, robot_sets, planned.fix, planned.free)
    x, weights = np.zeros(len(errors.parameters)), prior_weights(errors, planned.priors)
    instrument = CameraInstrument(images, planned.noise or Noise())
    template = instrument.template(chain, q)
    values = held_values([template], rig_sets) | dict(planned.known)
    if not planned.data:
        return _Before(errors, x, 1 / weights, instrument, template, values)
    existing = tuple(instrument.existing(item, chain) for item in planned.data)
    problem = make_problem(errors, existing, weights, values)
    differences = np.zeros(len(problem.instrument_parameters))
    values = problem.instruments(np.concatenate([x, differences]))
    return _Before(errors, x, 1 / problem.prior_weights, instrument, template, values, problem, differences)


def _information_rows(sqrt_covariance: Array, unbounded_directions: Array) -> Array:
    """Compute rows (p, p) with the information of a covariance, given as its square root (p, r)."""
    # Unknowns, and unbounded directions (p, h), that the calibration did not estimate keep their prior.
    n_missing = max(0, len(sqrt_covariance) - sqrt_covariance.shape[1])
    axes, std, _ = np.linalg.svd(np.pad(sqrt_covariance, ((0, 0), (0, n_missing))))
    has_covariance = std > ZERO_STD_RTOL * std[0]
    rows = axes.T[has_covariance] / std[has_covariance, None]
    # Remove the part of the rows that depends on the unbounded directions.
    u, s, _ = np.linalg.svd(rows @ unbounded_directions, full_matrices=False)
    unbounded = u[:, s > ZERO_STD_RTOL * np.linalg.norm(rows)]
    return np.concatenate([rows - unbounded @ (unbounded.T @ rows), axes.T[~has_covariance]])


def _add_parameter_sets(
    errors: ErrorModel, x: Array, sigma: Array, sets: Sequence[str]
) -> tuple[ErrorModel, Array, Array, Array]:
    """Add the parameters of further sets to an error model."""
    indices = {parameter.name: i for i, parameter in enumerate(errors.parameters)}
    new = [p for name in sets for p in PARAMETER_SETS[name](errors.chain) if p.name not in indices]
    extended = errors.with_parameters(new)
    old_index = np.array([indices.get(parameter.name, -1) for parameter in extended.parameters], int)
    is_new = old_index < 0
    priors = np.where(is_new, extended.priors, sigma[old_index])
    fitted = np.concatenate([~is_new, np.full(len(sigma) - len(x), True)])
    all_priors = np.concatenate([priors, sigma[len(x) :]])
    return extended, np.where(is_new, 0.0, x[old_index]), all_priors, fitted


def add_joint_scatter(chain: Chain, q: Array, noise: Noise) -> Noise:
    """Add the effect of `JOINT_SCATTER`, averaged over joint positions (m, n), to a noise."""
    errors = select_parameters(chain, "offset")
    model, bodies, twists = errors.derivative(np.zeros(len(errors.parameters)))
    is_angle = np.array([parameter.unit == "rad" for parameter in errors.parameters])
    std = np.where(is_angle, JOINT_SCATTER.rotation, JOINT_SCATTER.position)
    effects = model.tool_jacobian(model.forward_kinematics(q), bodies, twists) * std[:, None, None]
    position, rotation = np.sqrt(np.sum(effects**2, 0).reshape(2, 3, -1).mean((1, 2)))
    return Noise(float(np.hypot(noise.position, position)), float(np.hypot(noise.rotation, rotation)))


def plannable_kinds() -> dict[str, type[Measurement]]:
    """Select the kinds whose measurements are independent."""
    return {
        name: kind
        for name, kind in KINDS.items()
        if kind.configurations_per_row == 1
        and not any(kind.columns[column] == "text" for columns in kind.required_columns for column in columns)
    }


def _plannable_kind(kind: str) -> type[Measurement]:
    """Return a kind that can be planned."""
    kinds = plannable_kinds()
    if kind not in kinds:
        raise UnknownNameError(f"kind {kind!r} cannot be planned; choose from {', '.join(kinds)}")
    return kinds[kind]


def _sigma_of(data: Sequence[Measurement], kind: str) -> Noise | None:
    """Return the RMS standard deviations of the first measurement of a kind; None if there is none."""
    for item in data:
        if item.kind == kind:
            sigmas = [getattr(item, name, np.zeros(1)) for name in ("sigma", "rotation_sigma")]
            return Noise(*(float(np.sqrt(np.mean(sigma**2))) for sigma in sigmas))
    return None
