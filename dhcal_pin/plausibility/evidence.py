"""Evidence of measurements for a robot with small errors, by which hypotheses about the data are compared.

The whitened measurements, with base, tool and instrument parameters eliminated, are y = A·x + ε. The errors
x of the robot have the prior x ~ N(0, w²·P) with the default variances P and an unknown width w, and the
noise is ε ~ N(0, σ²·I) with an unknown scale σ. With the singular values s_i of A·√P, the components y_i of y
along its left singular vectors, and the rest ρ² = ‖y‖² - Σ y_i² of dimension m,

    log p(y | w, σ) = -½·Σ [log(σ² + w²·s_i²) + y_i²/(σ² + w²·s_i²)] - m·log σ - ρ²/(2·σ²) + const.

Eliminating base, tool and instrument parameters b, whose rows are F·b, divides the density by the volume
√det(FᵀF) of their flat priors. The evidence is the maximum over grids of w and σ, with ln w ~ N(0, 1.5²) as
in `calibration.shrinkage` (MacKay 1992). It prices a correction that is larger than manufacturing errors as
well as residuals that are larger than noise, so that a model with more parameters than equations is judged
as well.

Standard deviations are scaled by the residuals, separately for lengths and angles. The scale is the quantile
(n + p)/(2·n) of the residuals of n rows and p unknowns: p rows can be fitted exactly, and half of the others
may be outliers. A sample whose residual is far above that scale gets a larger standard deviation of its own.
The determinants of both are part of the evidence, so that evidence of the same samples with other changes can
be compared.

Reference: D. J. C. MacKay, Bayesian Interpolation, Neural Computation 4, 1992.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation.contacts import log_volume
from ..estimation.error_model import ErrorModel
from ..estimation.initialization import compare_tools, initialize_frames, make_problem
from ..estimation.parameters import LOW_COST, select_parameters
from ..estimation.problem import Problem
from ..estimation.qr import RANK_RTOL, TriangularSystem, left_singular_vectors
from ..estimation.robust import ZERO_WEIGHT
from ..estimation.solver import SolverResult, minimize
from ..estimation.trimmed_squares import find_initial_outliers
from ..measurements.base import ANGLE_SIGMA, LENGTH_SIGMA, Measurement, residual_of
from ..measurements.pose import PoseMeasurement
from ..measurements.position import PointMeasurement
from ..robot.chain import Chain

# Errors that the robot may have; base and tool are free, so that instrument and target may be anywhere.
MANUFACTURED = "minimal,base,tool"
HAND_BUILT = f"{LOW_COST},base,tool"
# Widths w of the priors, and logarithm of the standard deviation of ln w.
_WIDTHS = 2.0 ** np.arange(-1, 5)
_LOG_WIDTH_STD = 1.5
# Width of the priors while the robot is fitted: errors of some centimetres and degrees. The priors of a
# low-cost arm are as wide as its errors.
_FIT_WIDTHS = {MANUFACTURED: 4.0, HAND_BUILT: 1.0}
# Residuals of a robot, relative to those of a manufactured one: joints of a hand-built arm have play.
_RESIDUAL_FACTORS = {MANUFACTURED: 1.0, HAND_BUILT: 2.0}
# Noise scales σ around the residuals of the fit.
_NOISE_SCALES = 10.0 ** np.arange(-1, 5.01, 0.25)
# Largest number of iterations of a fit, and of one of base and tool alone.
_N_ITERATIONS, _N_FRAME_ITERATIONS = 12, 20
# Largest number of fits with new noise scales. They end when the scales fall by less than this, on the mean
# of the logarithms.
_N_ROUNDS, _MIN_CHANGE = 20, 0.1
# Fits whose evidence is smaller than that of an earlier one by more than this logarithm have not converged:
# few rows are fitted exactly, so that their scales fall to the smallest one.
_MAX_LOSS = 1.0
# Largest share of samples that are single errors; more of them are a sign of one mistake in many samples.
_MAX_GROSS_SHARE = 0.2
# Smallest and largest scale of the placeholder standard deviations. Residuals below the smallest one count as
# exact: how small they are says nothing about a hypothesis.
_MIN_SCALE, _MAX_SCALE = 1e-4, 1e7
# Samples with residuals above this multiple of the scale get a standard deviation of their own.
_OUTLIER_RATIO = 4.0


def usual_errors(chain: Chain, data: Sequence[Measurement]) -> str:
    """Return the parameter sets of the errors that such a robot usually has."""
    is_hand_built = chain.parameters == HAND_BUILT or any(item.has_counts for item in data)
    return HAND_BUILT if is_hand_built else MANUFACTURED


@frozen
class Evidence:
    """Evidence of measurements for a robot with small errors."""

    #: Logarithm of the evidence, up to a constant that depends on number and kind of the samples only.
    log: float
    width: float  #: Errors of the robot, in default standard deviations.
    length_scale: float  #: Standard deviation of a length residual [m]; NaN if no lengths are measured.
    angle_scale: float  #: Standard deviation of an angle residual [rad]; NaN if no angles are measured.
    #: Robot that was fitted, with base and tool; None without a fit.
    chain: Chain | None = field(default=None, repr=False, compare=False)
    #: Errors of the robot, base and tool by name [m or rad].
    errors: Mapping[str, float] = field(default_factory=dict, repr=False, compare=False)
    #: Values of the instrument parameters by name [m or rad].
    instruments: Mapping[str, float] = field(default_factory=dict, repr=False, compare=False)
    residual_factor: float = 1.0  #: Residuals that such a robot may leave, relative to a manufactured one.
    #: Stated standard deviations of the measured lengths [m] and angles [rad]; 0 if none are stated.
    stated_noise: tuple[float, float] = (0.0, 0.0)

    def residuals(self, item: Measurement) -> list[tuple[str, Array]] | None:
        """Compute unit and rows (k, m) of each group of residuals, relative to the noise."""
        # None without a fit, for another instrument and for another unit.
        if self.chain is None:
            return None
        equal = _with_equal_sigmas(item).matched_to(self.instruments).mounted(self.chain)
        scales = {"m": self.length_scale / LENGTH_SIGMA, "rad": self.angle_scale / ANGLE_SIGMA}
        is_known = all(p.name in self.instruments and not p.is_local for p in equal.instrument_parameters)
        groups = equal.residual_groups.values()
        if not is_known or any(not scales.get(group.unit, 0.0) > 0 for group in groups):
            return None
        r = residual_of(equal, self.chain, self.instruments)
        return [(g.unit, r[g.rows] / scales[g.unit]) for g in groups]

    def misfits(self, item: Measurement) -> Array | None:
        """Compute the residuals (m,) of samples relative to the noise; None for another instrument."""
        residuals = self.residuals(item)
        if residuals is None:
            return None
        return np.max([np.sqrt(np.mean(rows**2, 0)) for _, rows in residuals], 0)


def with_noise_of(
    chain: Chain, instruments: Mapping[str, float], data: Sequence[Measurement]
) -> Evidence | None:
    """Return a fitted robot with the RMS residuals of measurements as noise; None for other instruments."""
    model = Evidence(0.0, 1.0, LENGTH_SIGMA, ANGLE_SIGMA, chain, instruments=instruments)
    squares: dict[str, list[Array]] = {"m": [], "rad": []}
    for item in data:
        residuals = model.residuals(item)
        if residuals is None:
            return None
        for unit, rows in residuals:
            squares[unit].append(np.mean(rows**2, 0))
    scales = [
        max(float(np.sqrt(np.mean(np.concatenate(each)))), _MIN_SCALE) if each else np.nan
        for each in squares.values()
    ]
    return replace(model, length_scale=scales[0] * LENGTH_SIGMA, angle_scale=scales[1] * ANGLE_SIGMA)


def fit_evidence(chain: Chain, data: Sequence[Measurement], sets: str) -> Evidence:
    """Fit a robot with errors of one of the keys of `_FIT_WIDTHS` and compute the evidence."""
    equal = tuple(_with_equal_sigmas(item) for item in data)
    return _with_stated_noise(_fit_initialized(_initialized_frames(chain, equal, sets), equal, sets), data)


def fit_evidence_near(near: Evidence, chain: Chain, data: Sequence[Measurement], sets: str) -> Evidence:
    """Compute the evidence of a fit that begins with the base and the tool of another fit."""
    assert near.chain is not None
    started = chain.with_base_and_tool(near.chain.base, near.chain.tool)
    equal = tuple(_with_equal_sigmas(item) for item in data)
    return _with_stated_noise(_fit_initialized(select_parameters(started, sets), equal, sets), data)


def fit_without_gross_outliers(chain: Chain, data: Sequence[Measurement], sets: str) -> Evidence | None:
    """Compute the evidence of a fit that starts without a few samples that are far off; None without any."""
    # A fit to few samples for each unknown adapts to an outlier that it starts with.
    equal = tuple(_with_equal_sigmas(item) for item in data)
    errors = _initialized_frames(chain, equal, sets)
    is_gross = find_initial_outliers(select_parameters(chain, sets), equal, {}, errors.chain)
    if not 0 < np.mean(np.concatenate(is_gross)) <= _MAX_GROSS_SHARE:
        return None
    kept = tuple(item.take(~each) for item, each in zip(equal, is_gross, strict=True))
    errors = _initialized_frames(chain, kept, sets)
    started = tuple(
        item.initialized_from(errors.chain, ~each).with_weights(np.where(each, ZERO_WEIGHT, 1.0))
        for item, each in zip(equal, is_gross, strict=True)
    )
    return _with_stated_noise(_fit(errors, started, sets), data)


def _initialized_frames(chain: Chain, data: tuple[Measurement, ...], sets: str) -> ErrorModel:
    """Return the unknown errors of a robot with base and tool that are initialized from measurements."""
    errors = initialize_frames(select_parameters(chain, sets), data, {}, _N_FRAME_ITERATIONS)
    if any(item.is_contact for item in data):
        errors = compare_tools(errors, data, {}, _N_FRAME_ITERATIONS)
    return errors


def _fit_initialized(errors: ErrorModel, data: tuple[Measurement, ...], sets: str) -> Evidence:
    """Fit errors of a robot to measurements that are initialized from it and compute the evidence."""
    return _fit(errors, tuple(item.initialized(errors.chain) for item in data), sets)


def _fit(errors: ErrorModel, data: tuple[Measurement, ...], sets: str) -> Evidence:
    """Fit errors of a robot to initialized measurements and compute the evidence."""
    is_robot = errors.is_of_arm
    n_rows = sum(item.residual_dim * len(item.rows) for item in data)
    problem = make_problem(errors, data, 1 / (errors.priors * np.where(is_robot, _FIT_WIDTHS[sets], 1.0)), {})
    solution = minimize(problem, max_iterations=_N_ITERATIONS, loose=True)
    noise, best = _estimate_noise(problem, solution.x), None
    prior_std = np.pad(np.where(is_robot, errors.priors, 0.0), (0, len(solution.x) - len(is_robot)))
    for _ in range(_N_ROUNDS):
        weighted = problem.with_data(noise.data)
        solution = minimize(weighted, x=solution.x, max_iterations=_N_ITERATIONS, loose=True)
        found = _evidence_of(problem, solution, noise, prior_std)
        if best is None or found.log >= best.log - _MAX_LOSS:
            best = found
        new = _estimate_noise(problem, solution.x)
        if new.log_determinant > noise.log_determinant - _MIN_CHANGE * n_rows:
            break
        noise = new
    assert best is not None
    return replace(best, residual_factor=_RESIDUAL_FACTORS[sets])


def _evidence_of(problem: Problem, solution: SolverResult, noise: _Noise, prior_std: Array) -> Evidence:
    """Compute the evidence of a fit with the noise that it was made with."""
    n_rows = sum(item.residual_dim * len(item.rows) for item in problem.data)
    log, width, factor = _maximize(solution.system, solution.x, prior_std, n_rows, noise.min_factor)
    # The joint values of contacts contain the noise.
    log += sum(log_volume(problem, solution.x, item) for item in problem.data if item.is_contact)
    return Evidence(
        log - noise.log_determinant,
        width,
        factor * noise.length_scale,
        factor * noise.angle_scale,
        problem.chain(solution.x),
        dict(zip((p.name for p in problem.errors.parameters), solution.x.tolist(), strict=False)),
        problem.instruments(solution.x),
    )


def _with_stated_noise(evidence: Evidence, data: Sequence[Measurement]) -> Evidence:
    """Return evidence with the largest noise that measurements state."""
    stated = [item for item in data if item.has_stated_sigma]
    lengths = [item.sigma for item in stated if isinstance(item, PoseMeasurement | PointMeasurement)]
    angles = [item.rotation_sigma for item in stated if isinstance(item, PoseMeasurement)]
    length, angle = (
        max((float(np.sqrt(np.mean(each**2))) for each in sigmas), default=0.0)
        for sigmas in (lengths, angles)
    )
    return replace(evidence, stated_noise=(length, angle))


def _with_equal_sigmas(item: Measurement) -> Measurement:
    """Return measurements with the placeholder standard deviations."""
    values: dict[str, Array] = {}
    if isinstance(item, PoseMeasurement):
        values["rotation_sigma"] = np.full_like(item.rotation_sigma, ANGLE_SIGMA)
    if isinstance(item, PoseMeasurement | PointMeasurement):
        values["sigma"] = np.full_like(item.sigma, LENGTH_SIGMA)
    return item.replace(**values)


@frozen(eq=False)
class _Noise:
    """Noise of measurements as estimated from the residuals of a fit."""

    data: tuple[Measurement, ...]  # Measurements with these standard deviations
    log_determinant: float  # Sum of the logarithms of all factors to the standard deviations of the rows
    length_scale: float  # Standard deviation of a length residual [m]; NaN if no lengths are measured
    angle_scale: float  # Standard deviation of an angle residual [rad]; NaN if no angles are measured
    min_factor: float  # Smallest common factor to the standard deviations that leaves none below `_MIN_SCALE`


def _estimate_noise(problem: Problem, x: Array) -> _Noise:
    """Estimate scales of lengths and angles, and the weights of outliers, from the residuals at x."""
    # Mean square of each sample (m,) by item and name of the residual group.
    squares: list[dict[str, Array]] = []
    for item, r in zip(problem.data, problem.residuals(x, problem.data), strict=True):
        squares.append({name: np.mean(r[g.rows] ** 2, 0) for name, g in item.residual_groups.items()})
    n_rows = sum(item.residual_dim * len(item.rows) for item in problem.data)
    share = min(1.0, 0.5 * (1 + len(x) / n_rows))
    scales = {}
    units = {name: g.unit for item in problem.data for name, g in item.residual_groups.items()}
    for unit in set(units.values()):
        values = [v for item in squares for name, v in item.items() if units[name] == unit]
        typical = np.quantile(np.concatenate(values), share)
        scales[unit] = float(np.clip(np.sqrt(typical), _MIN_SCALE, _MAX_SCALE))
    data, log_determinant = [], 0.0
    for item, by_name in zip(problem.data, squares, strict=True):
        factors = {name: scales[units[name]] for name in by_name}
        ratio = np.max([np.sqrt(v) / factors[name] for name, v in by_name.items()], 0)
        excess = np.fmax(ratio / _OUTLIER_RATIO, 1.0)
        data.append(item.with_scaled_sigma(factors).with_weights(excess**-2))
        rows_per_sample = {
            name: len(range(item.residual_dim)[g.rows]) for name, g in item.residual_groups.items()
        }
        log_determinant += len(item.rows) * sum(
            count * np.log(factors[name]) for name, count in rows_per_sample.items()
        )
        log_determinant += item.residual_dim * float(np.sum(np.log(excess)))
    return _Noise(
        tuple(data),
        log_determinant,
        LENGTH_SIGMA * scales.get("m", np.nan),
        ANGLE_SIGMA * scales.get("rad", np.nan),
        _MIN_SCALE / np.nanmin([*scales.values()]),
    )


def _maximize(
    system: TriangularSystem, x: Array, prior_std: Array, n_rows: int, min_factor: float
) -> tuple[float, float, float]:
    """Maximize the evidence over the width of the priors and the scale of the noise."""
    robot = prior_std > 0
    measured, rows = system.z + system.r @ x, system.r[:, robot] * prior_std[robot]
    u, s = left_singular_vectors(system.r[:, ~robot])
    is_observable = s > RANK_RTOL * s.max(initial=0.0)
    u, log_frames = u[:, is_observable], float(np.sum(np.log(s[is_observable])))
    rows, measured = rows - u @ (u.T @ rows), measured - u @ (u.T @ measured)
    left, singular_values = left_singular_vectors(rows)
    components = left.T @ measured
    rest = system.min_cost + max(0.0, float(measured @ measured - components @ components))
    n_rest = max(0, n_rows - u.shape[1] - len(singular_values))
    noise, width = np.meshgrid(np.fmax(_NOISE_SCALES, min_factor), _WIDTHS)
    variance = noise[..., None] ** 2 + (width[..., None] * singular_values) ** 2
    log = -0.5 * (
        np.sum(np.log(variance) + components**2 / variance, -1)
        + 2 * n_rest * np.log(noise)
        + rest / noise**2
        + (np.log(width) / _LOG_WIDTH_STD) ** 2
    )
    best = np.unravel_index(np.argmax(log), log.shape)
    return float(log[best]) - log_frames, float(width[best]), float(noise[best])
