"""Gate: whether images may change the arm.

Images of a small part of joint space can be fitted better by a wrong arm. Their error on random held-out
images falls then, too. The arm is therefore judged on images of left-out clusters of joint space. With N
different configurations, r is the error of their image coordinates with the arm estimated, as a fraction of
that with the nominal arm. For r, the residuals have the temperature T = 1 + N/5, and the widths of the priors
of the arm are those of greatest evidence at T, however narrow.

- r < 0.5 if the arm's errors explain the images up to the noise of the corners, and r < 0.25 if not: the arm
  is demonstrably wrong. It is estimated at T = 1 + N/20 with the prior widths of greatest evidence at T = 1,
  which are never below the default ones.
- r < 0.8 for a low-cost arm, whose zeros are wrong by degrees, and whose play and sag displace the images
  (`arm_types`).
- r < 0.8 for the n whitened rows of other instruments beside the images, such as positions of a tracker, or
  r² < 1 - 3·√(2/n), if the mean square of the rows falls by three of its standard deviations: the arm is
  demonstrably wrong, too, whatever the images show. Here it is estimated at T = 1.
- Otherwise the nominal arm is kept, unless joint errors complete the model (`joint_errors`). Errors of
  another kind, such as periodic ones of the joints, can be imitated by errors of the links where images were
  taken, with a ratio of 0.3 to 0.5, but not elsewhere.

The corners of an image share a displacement of the arm (`jitter`), unless corners that are displaced
independently (`corner_noise`) predict the left-out clusters better. Then T is larger by the number of image
coordinates per component of the displacement of an image.

The temperature protects the arm from errors that the model lacks. If a shared displacement does not raise the
likelihood of the images after the arm was estimated, T = 1, and the images count with the errors of the
joints that they do not exclude (`joint_scatter`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.error_model import ErrorModel
from ...estimation.folds import factor_partition
from ...estimation.priors import PriorGroups, determined_fractions, effective_parameters
from ...estimation.problem import Problem
from ...estimation.solver import minimize
from ...measurements.base import Measurement
from ...measurements.camera import select_images
from ...measurements.images.camera_parameters import POINTS_SET
from ..partition import Fold, configuration_groups, k_fold
from ..reweighting import Fit
from .arm_types import CORNERS, IMAGES, INDUSTRIAL, ArmType
from .corner_noise import fit_with_corner_noise
from .jitter import Jitter, estimate_jitter, with_jitter
from .joint_scatter import fit_with_joint_scatter
from .sets import MAX_POINTS, count_corners
from .stages import Stage, fitted_error, format_ratio, held_out_error
from .target_points import TargetPoints, boards_of, try_target_points, with_free_points

# Number of clusters of joint space that are left out in turn.
N_CLUSTERS = 5
# Number of folds of random images.
N_IMAGE_FOLDS = 5
# Configurations per unit of the temperature with an open and with a closed gate.
OPEN_SAMPLES, CLOSED_SAMPLES = 20, 5
# Largest ratio of the errors of other instruments for which the arm is demonstrably wrong. A larger ratio is
# enough if the mean square of the rows falls by this number of its standard deviations.
MAX_OTHERS_RATIO, MIN_DEVIATIONS = 0.8, 3.0
# Narrowest and widest prior with a closed gate, as a fraction of the default one.
MIN_WIDTH, MAX_WIDTH = 1e-3, 1e2
# Rounds of jitter and solution, and of the evidence.
_N_JITTER_ROUNDS, _N_EVIDENCE_ROUNDS = 2, 30
_N_CLUSTER_ROUNDS = 50


@frozen
class Gate:
    """Result of the gate."""

    # Error of left-out clusters with the arm estimated over that with the nominal arm; NaN if the images
    # cannot be divided.
    ratio: float
    temperature: float  # Temperature of the residuals in the final fit
    n_configurations: int  # Number of different configurations
    is_right: bool  # Whether the corners of an image share no displacement with the nominal arm
    is_complete: bool  # Whether they share none with the estimated arm
    arm_type: ArmType = INDUSTRIAL
    others_ratio: float = float("nan")  # The same as `ratio` for other instruments; NaN if there are none
    n_others: int = 0  # Number of rows of other instruments

    @property
    def is_open(self) -> bool:
        """Whether the arm is demonstrably wrong."""
        return self._is_shown_by_others or (self.ratio < self.max_ratio and not self.is_right)

    @property
    def _is_shown_by_others(self) -> bool:
        """Whether measurements of other instruments show that the arm is wrong."""
        return self.others_ratio < self.max_others_ratio

    @property
    def max_others_ratio(self) -> float:
        """Largest ratio of the errors of other instruments for which the arm is demonstrably wrong."""
        # The mean square of n normal values has a relative standard deviation of √(2/n).
        least_fall = MIN_DEVIATIONS * np.sqrt(2 / max(self.n_others, 1))
        return max(MAX_OTHERS_RATIO, float(np.sqrt(max(1 - least_fall, 0.0))))

    @property
    def max_ratio(self) -> float:
        """Largest ratio for which the arm is demonstrably wrong."""
        limits = self.arm_type
        return limits.max_complete_ratio if self.is_complete else limits.max_incomplete_ratio

    @property
    def sentence(self) -> str:
        """Why the arm is estimated or kept."""
        effect = "estimating it changes the error of left-out parts of joint space to"
        if self._is_shown_by_others:
            ratio = format_ratio(self.others_ratio)
            return f"The arm is demonstrably wrong: {effect} {ratio} for the measurements without images."
        if self.is_open:
            return f"The arm is demonstrably wrong: {effect} {format_ratio(self.ratio)}."
        start = "The nominal arm is kept, as the images do not show that the arm is wrong:"
        if self.is_right and self.n_configurations >= N_CLUSTERS:
            return f"{start} the noise of the corners explains them with the nominal arm."
        if np.isnan(self.ratio):
            return (
                f"{start} {self.n_configurations} configurations are too few to leave out parts of joint "
                f"space; expected at least {2 * N_CLUSTERS}."
            )
        # Images of a larger part of joint space seldom open the gate: in 4 of 23 simulated cases.
        return f"{start} {effect} {format_ratio(self.ratio)}, not below {format_ratio(self.max_ratio)}."


@frozen(eq=False)
class GatedFit:
    """Fits with and without errors of the arm, and the gate between them."""

    fit: Fit
    nominal: Fit  # Fit of independent corners with the nominal arm
    with_arm: Fit  # Fit with the arm estimated
    gate: Gate  # Whether the arm is estimated in the final fit
    # Fit with the arm estimated and a displacement of each image; None if the images share none with it.
    displaced: Fit | None = None


def fit_with_jitter(fit: Fit, max_iterations: int) -> tuple[Fit, Jitter]:
    """Estimate the displacement that the corners of an image share, and fit again."""
    jitter = Jitter(1.0, 0.0, 0.0)
    for _ in range(_N_JITTER_ROUNDS):
        jitter = residual_jitter(fit)
        fit = fit.solved_with(with_jitter(fit.problem, fit.solution.x, fit.data, jitter), max_iterations)
    return fit, jitter


def judge_target_points(fit: Fit, max_iterations: int) -> TargetPoints | None:
    """Judge whether the corners of boards are where the rig states them; see `target_points`."""
    clusters = cluster_folds(fit.data)
    if not clusters or not fit.problem.errors.has_arm:
        return None
    return try_target_points(fit, k_fold(fit.data, N_IMAGE_FOLDS), clusters, max_iterations)


def apply_gate(fit: Fit, groups: PriorGroups, max_iterations: int, arm_type: ArmType) -> GatedFit:
    """Fit arm, cameras and boards as far as the images show that the arm is wrong."""
    n_configurations = len(np.unique(configuration_groups(fit.without_rejected().data)))
    folds = cluster_folds(fit.problem.data)
    nominal = without_arm(fit, max_iterations)
    is_right = not residual_jitter(nominal).is_significant
    if not fit.problem.errors.has_arm:
        gate = Gate(float("nan"), 1.0, n_configurations, is_right, is_right, arm_type)
        kept = _kept_fit(nominal, is_right, folds, max_iterations)
        return GatedFit(kept, nominal, kept, gate)
    shared, jitter = fit_with_jitter(fit, max_iterations)
    is_complete = not jitter.is_significant
    # If the images share no displacement, their corners are independent, and none of them counts as too many.
    share = 1.0 if is_complete else rows_per_displacement(fit.without_rejected().data)
    models = [(fit, share)]
    if not is_complete:
        fits = {
            CORNERS: lambda: (fit_with_corner_noise(fit, max_iterations), share),
            IMAGES: lambda: (shared, 1.0),
        }
        models = [fits[name]() for name in arm_type.noise_models]
    trials = [
        _trial(model, groups, factor * temperature(n_configurations, CLOSED_SAMPLES), folds, max_iterations)
        for model, factor in models
    ]
    best = min(trials, key=lambda trial: trial.error) if folds else trials[-1]
    # The temperature protects from errors that images show, and other instruments do not.
    others = _others_ratio(best.model, max_iterations)
    gate = Gate(best.ratio, 1.0, n_configurations, is_right, is_complete, arm_type, *others)
    if not gate.is_open:
        kept = _kept_fit(nominal, is_right, folds, max_iterations)
        return GatedFit(kept, nominal, best.closed, gate, None if is_complete else shared)
    model, opened_at = best.model, temperature(n_configurations, OPEN_SAMPLES)
    if is_complete:
        model, opened_at = fit_with_joint_scatter(fit, jitter.noise, opened_at, max_iterations), 1.0
    elif model is not shared:
        opened_at *= share
    opened = _solve(model, model.problem, opened_at, max_iterations)
    gate = replace(gate, temperature=opened_at)
    return GatedFit(opened, nominal, opened, gate, None if is_complete else shared)


def open_fit(fit: Fit, gate: Gate, max_iterations: int) -> tuple[Fit, float]:
    """Estimate the displacement of images anew, fit with it, and return the temperature of the fit."""
    fit, jitter = fit_with_jitter(fit, max_iterations)
    n_configurations = gate.n_configurations if jitter.is_significant else 0
    opened_at = temperature(n_configurations, OPEN_SAMPLES)
    return _solve(fit, fit.problem, opened_at, max_iterations), opened_at


def _kept_fit(nominal: Fit, is_right: bool, folds: Sequence[Fold], max_iterations: int) -> Fit:
    """Fit the nominal arm with the noise that predicts left-out clusters best."""
    if not is_right:
        shared, _ = fit_with_jitter(nominal, max_iterations)
        nominal = _best((fit_with_corner_noise(nominal, max_iterations), shared), folds)
    return _solve(nominal, nominal.problem, 1.0, max_iterations)


def _best(fits: Sequence[Fit], folds: Sequence[Fold]) -> Fit:
    """Return the fit that predicts left-out clusters best, the last one without clusters."""
    errors = [held_out_error(fit, folds) for fit in fits]
    known = [(error.pixels, i) for i, error in enumerate(errors) if error is not None]
    return fits[min(known)[1]] if known else fits[-1]


def temperature(n_configurations: int, samples: int) -> float:
    """Return the temperature of configurations with errors of the arm that the model lacks."""
    return 1 + n_configurations / samples


def rows_per_displacement(data: Sequence[Measurement]) -> float:
    """Return the number of image coordinates per component of the displacement of an image, at least 1."""
    images = select_images(data)
    n_configurations = len(np.unique(configuration_groups(images)))
    # Corners that share a displacement contain six independent values per image, however many they are.
    return max(sum(2 * len(item.rows) for item in images) / (6 * n_configurations), 1.0)


def residual_jitter(fit: Fit) -> Jitter:
    """Estimate the displacement of images from the residuals of a fit of independent corners."""
    n_determined = effective_parameters(fit.problem, fit.solution)
    return estimate_jitter(fit.problem, fit.solution.x, fit.data, fit.weights, n_determined)


@frozen(eq=False)
class _Trial:
    """Arm estimated with one model of the noise, as the gate judges it."""

    model: Fit  # Fit at temperature 1
    closed: Fit  # Fit with the prior widths of greatest evidence at the temperature of the gate
    error: float  # Error of left-out clusters with that fit [px]; NaN without clusters
    ratio: float  # The same as a fraction of the error with the nominal arm


def _trial(
    model: Fit, groups: PriorGroups, temperature: float, folds: Sequence[Fold], max_iterations: int
) -> _Trial:
    """Judge a model of the noise on left-out clusters."""
    closed = _with_evidence(model, groups, temperature, max_iterations)
    error = held_out_error(closed, folds)
    nominal = held_out_error(without_arm(model, max_iterations), folds)
    if error is None or nominal is None:
        return _Trial(model, closed, float("nan"), float("nan"))
    return _Trial(model, closed, error.pixels, error.pixels / nominal.pixels)


def _others_ratio(fit: Fit, max_iterations: int) -> tuple[float, int]:
    """Return the ratio of the errors of left-out rows of other instruments, and the number of these rows."""
    # It is the error with the arm of the fit over that with the nominal arm; NaN if the rows are too few.
    others = [item for item in fit.problem.data if not item.n_images]
    folds = []
    for fold in cluster_folds(others) if others else ():
        masks = iter(fold)
        folds.append(
            [np.zeros(len(item.rows), bool) if item.n_images else next(masks) for item in fit.problem.data]
        )
    if not folds:
        return float("nan"), 0
    squares, n_rows = [], 0
    for each in (fit, without_arm(fit, max_iterations)):
        problem, x = each.problem, each.solution.x
        columns = np.ones(len(x), bool)
        systems = list(factor_partition(problem, x, folds))
        squares.append(sum(one.n_rows * one.error(problem.weights, x, columns) ** 2 for one in systems))
        n_rows = sum(one.n_rows for one in systems)
    return (float(np.sqrt(squares[0] / squares[1])) if squares[1] else float("nan")), n_rows


def _solve(fit: Fit, problem: Problem, temperature: float, max_iterations: int) -> Fit:
    """Solve a problem, whose priors count at temperature 1, at a temperature."""
    problem = problem.at_temperature(temperature)
    solution = minimize(problem, "lm", fit.solution.x, max_iterations)
    return replace(fit, problem=problem, solution=solution, previous_iterations=fit.iterations)


def _with_evidence(fit: Fit, groups: PriorGroups, temperature: float, max_iterations: int) -> Fit:
    """Fit with the prior widths of greatest evidence at a temperature, however narrow."""
    expected = fit.problem.weights.copy()
    for group in groups:
        expected[group.members] = group.expected_weight
    weights = expected.copy()
    system, x = fit.solution.system, fit.solution.x
    rows = system.scaled(1 / np.sqrt(temperature))
    for _ in range(_N_EVIDENCE_ROUNDS if groups else 0):
        sizes = (x + rows.solve(weights, x)[0]) * expected
        determined = determined_fractions(rows, weights)
        for members in (group.members for group in groups):
            width = np.sqrt(np.sum(sizes[members] ** 2) / max(np.sum(determined[members]), 1e-9))
            weights[members] = expected[members] / np.clip(width, MIN_WIDTH, MAX_WIDTH)
    return _solve(fit, fit.problem.with_prior_weights(weights), temperature, max_iterations)


def without_arm(fit: Fit, max_iterations: int, held: Collection[str] = ()) -> Fit:
    """Fit poses, lenses and target points with the nominal arm."""
    problem = fit.problem
    errors = nominal_arm(problem.errors)
    values = {
        p.name: p.nominal
        for item in select_images(problem.data)
        for p in item.instrument_parameters
        if item.set_of(p.name) in held
    }
    is_free = np.array(
        [
            *(p in errors.parameters for p in problem.errors.parameters),
            *(p.name not in values for p in problem.instrument_parameters),
        ],
        bool,
    )
    plain = replace(
        problem,
        errors=errors,
        weights=problem.weights[is_free],
        known=values | dict(problem.known),
        bounds=None,
    )
    solution = minimize(plain, "lm", fit.solution.x[is_free], max_iterations, loose=True)
    return replace(fit, problem=plain, solution=solution)


def nominal_arm(errors: ErrorModel) -> ErrorModel:
    """Return the model of the nominal arm, with the unknowns of base and tool alone."""
    return errors.only_frames or ErrorModel(errors.chain, ())


def judge_stages(
    fit: Fit, gated: GatedFit, judged_points: TargetPoints | None, max_iterations: int
) -> tuple[Stage, ...]:
    """Judge the stages of a calibration: frames, intrinsics, target points, arm."""
    folds = cluster_folds(fit.data)
    images = k_fold(fit.data, N_IMAGE_FOLDS) if folds else ()

    def judged(name: str, each: Fit, is_kept: bool, reason: str) -> Stage:
        n_unknowns = len(each.problem.weights)
        errors = fitted_error(each), held_out_error(each, images), held_out_error(each, folds)
        return Stage(name, is_kept, n_unknowns, *errors, reason)

    frames = without_arm(fit, max_iterations, ("intrinsics", POINTS_SET))
    out = [judged("frames", frames, True, "Poses of cameras and boards are always estimated.")]
    points = lenses = gated.nominal
    sets = {item.set_of(p.name) for item in fit.data for p in item.instrument_parameters}
    has_points = POINTS_SET in sets
    if has_points:
        lenses = without_arm(fit, max_iterations, (POINTS_SET,))
    if len(lenses.problem.weights) > len(frames.problem.weights):
        stage = judged("intrinsics", lenses, True, "The rig does not fix them.")
        out.append(replace(stage, reason=f"{stage.reason} {_change(out[-1], stage)}".strip()))
    if not has_points and count_corners(fit.data) <= MAX_POINTS:
        freed = with_free_points(lenses, [board.name for board in boards_of(fit.data)])
        solution = minimize(freed.problem, "lm", freed.solution.x, max_iterations, loose=True)
        points = replace(freed, solution=solution)
    if len(points.problem.weights) > len(lenses.problem.weights):
        reason = (
            "The rig leaves them free."
            if has_points
            else 'The rig fixes them; `points = "prior"` frees them.'
        )
        if judged_points is not None:
            out.append(judged("target points", points, has_points, judged_points.sentence))
        else:
            stage = judged("target points", points, has_points, reason)
            out.append(replace(stage, reason=f"{stage.reason} {_change(out[-1], stage)}".strip()))
    if gated.with_arm.problem.errors.has_arm:
        out.append(judged("arm", gated.with_arm, gated.gate.is_open, gated.gate.sentence))
    return tuple(out)


def _change(before: Stage, after: Stage) -> str:
    """Say to which share a stage changes the error of left-out regions; empty if that is unknown."""
    if before.by_region is None or after.by_region is None or not before.by_region.pixels:
        return ""
    ratio = format_ratio(after.by_region.pixels / before.by_region.pixels)
    return f"Estimating them changes the error of left-out parts of joint space to {ratio}."


def cluster_folds(data: Sequence[Measurement]) -> tuple[Fold, ...]:
    """Divide the configurations of measurements into clusters of joint space."""
    label = configuration_groups(data)
    # Samples of two configurations, such as relative poses, are in the cluster of the first one.
    q = np.concatenate([item.q for item in data])[np.unique(label, return_index=True)[1]]
    if len(q) < 2 * N_CLUSTERS:
        return ()
    std = q.std(0)
    points = (q - q.mean(0))[:, std > 0] / std[std > 0]
    centres = points[_far_points(points)]
    nearest = np.zeros(len(points), int)
    for _ in range(_N_CLUSTER_ROUNDS):
        updated = np.argmin(((points[:, None] - centres[None]) ** 2).sum(2), 1)
        if np.array_equal(updated, nearest):
            break
        nearest = updated
        centres = np.array(
            [points[nearest == i].mean(0) if np.any(nearest == i) else c for i, c in enumerate(centres)]
        )
    counts = np.cumsum([len(item.rows) for item in data])[:-1]
    return tuple(
        tuple(np.split((nearest == i)[label], counts)) for i in range(N_CLUSTERS) if np.any(nearest == i)
    )


def _far_points(points: Array) -> list[int]:
    """Return the numbers of points that are far from each other, the first one near the mean."""
    chosen = [int(np.argmin(np.sum(points**2, 1)))]
    while len(chosen) < N_CLUSTERS:
        distance = np.min([np.sum((points - points[i]) ** 2, 1) for i in chosen], 0)
        chosen.append(int(np.argmax(distance)))
    return chosen
