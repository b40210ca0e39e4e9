"""Gate: how far images may change the arm.

Images of a small part of joint space can be fitted better by a wrong arm. Their error on random held-out
images falls then, too. The arm is therefore judged on images of left-out clusters of joint space. With N
different configurations and the temperature T = 1 + N/5 of the residuals, r is the error of their image
coordinates with the arm estimated, as a fraction of that with the nominal arm.

- r < 0.5: the arm is demonstrably wrong. It is estimated at T = 1 + N/20 with the prior widths of greatest
  evidence at T = 1, which are never below the default ones.
- Otherwise: the widths of its priors are those of greatest evidence at T = 1 + N/5, however narrow, and a
  warning says that the correction holds inside the measured region only.

In both cases the corners of an image share a displacement of the arm (`jitter`), unless independent corners
predict the left-out clusters better.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..._typing import Array
from ...estimation.error_model import ErrorModel
from ...estimation.priors import PriorGroups, effective_parameters
from ...estimation.problem import Problem
from ...estimation.qr import TriangularSystem, append_priors, posterior_sqrt_covariance, pseudo_inverse
from ...estimation.solver import minimize
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners
from ..partition import Fold, configuration_groups, different_configurations, k_fold
from ..reweighting import Fit
from .jitter import Jitter, estimate_jitter, with_jitter
from .stages import Stage, fitted_error, held_out_error

# Number of clusters of joint space that are left out in turn.
N_CLUSTERS = 5
# Number of folds of random images.
N_IMAGE_FOLDS = 5
# Configurations per unit of the temperature with an open and with a closed gate.
OPEN_SAMPLES, CLOSED_SAMPLES = 20, 5
# Largest ratio of the errors for which the arm is demonstrably wrong.
MAX_OPEN_RATIO = 0.5
# Narrowest and widest prior with a closed gate, as a fraction of the default one.
MIN_WIDTH, MAX_WIDTH = 1e-3, 1e2
# Rounds of jitter and solution, and of the evidence.
_N_JITTER_ROUNDS, _N_EVIDENCE_ROUNDS = 2, 30
_N_CLUSTER_ROUNDS = 50


@dataclass(frozen=True)
class Gate:
    """Result of the gate.

    Attributes:
        ratio: Error of left-out clusters with the arm estimated over that with the nominal arm; NaN if the
            images cannot be divided.
        jitter: Noise of corners and displacement of images.
        temperature: Temperature of the residuals in the final fit.
        n_configurations: Number of different configurations.
    """

    ratio: float
    jitter: Jitter
    temperature: float
    n_configurations: int

    @property
    def is_open(self) -> bool:
        """Whether the arm is demonstrably wrong."""
        return self.ratio < MAX_OPEN_RATIO

    @property
    def sentence(self) -> str:
        """Why the arm is corrected in full, or only as far as the priors of greatest evidence allow."""
        if self.is_open:
            return (
                "The arm is demonstrably wrong: estimating it changes the error of left-out parts of joint "
                f"space by the factor {self.ratio:.2f}."
            )
        return self.warnings[0]

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence if the arm is not demonstrably wrong."""
        if self.is_open:
            return ()
        return (
            "The images do not show that the arm is wrong: estimating it changes the error of left-out "
            f"parts of joint space by the factor {self.ratio:.2f}. Its correction holds inside the measured "
            "region only.",
        )


def fit_with_jitter(fit: Fit, max_iterations: int) -> tuple[Fit, Jitter]:
    """Estimate the displacement that the corners of an image share, and fit again.

    Args:
        fit: Fit of independent corners.
        max_iterations: Largest number of iterations of one solution.

    Returns:
        Fit with jitter, and its size.
    """
    problem, solution = fit.problem, fit.solution
    iterations = fit.iterations
    jitter = Jitter(1.0, 0.0, 0.0)
    for _ in range(_N_JITTER_ROUNDS):
        n_determined = effective_parameters(problem, solution)
        jitter = estimate_jitter(problem, solution.x, fit.data, n_determined)
        data = with_jitter(problem, solution.x, fit.data, jitter)
        weighted = [item.with_weights(w) for item, w in zip(data, fit.weights, strict=True)]
        problem = replace(problem, data=tuple(weighted))
        solution = minimize(problem, "lm", solution.x, max_iterations, loose=True)
        iterations += solution.iterations
    return replace(
        fit, problem=problem, solution=solution, previous_iterations=iterations - solution.iterations
    ), jitter


def apply_gate(fit: Fit, groups: PriorGroups, max_iterations: int) -> tuple[Fit, Gate, tuple[Stage, ...]]:
    """Fit arm, cameras and boards as far as the images show that the arm is wrong.

    Args:
        fit: Fit of independent corners at temperature 1 with the default priors, without outliers.
        groups: Parameters of the arm whose default priors share one scale.
        max_iterations: Largest number of iterations of one solution.

    Returns:
        The final fit, the gate, and the accuracy of each stage.
    """
    final, gate = _gated(fit, groups, max_iterations)
    return final, gate, _stages(fit, final, gate, max_iterations)


def _gated(fit: Fit, groups: PriorGroups, max_iterations: int) -> tuple[Fit, Gate]:
    """Return the final fit, and the gate."""
    expected = fit.problem.weights.copy()
    expected[groups.members] = groups.expected_weights[groups.group_index]
    n_configurations = len(np.unique(configuration_groups(fit.data)))
    folds = cluster_folds(fit.problem.data)
    temperature = 1 + n_configurations / CLOSED_SAMPLES
    models = [(fit, Jitter(1.0, 0.0, 0.0)), fit_with_jitter(fit, max_iterations)]
    trials = [
        _trial(model, jitter, groups, expected, temperature, folds, max_iterations)
        for model, jitter in models
    ]
    # Without clusters the corners of an image are never taken for independent.
    best = min(trials, key=lambda trial: trial.error) if len(folds) > 1 else trials[-1]
    gate = Gate(best.ratio, best.jitter, temperature, n_configurations)
    if not gate.is_open:
        return best.closed, gate
    temperature = 1 + n_configurations / OPEN_SAMPLES
    opened = _solve(best.fit, best.fit.problem, temperature, max_iterations)
    return opened, replace(gate, temperature=temperature)


@dataclass(frozen=True, eq=False)
class _Trial:
    """Fits with independent corners, or with jitter.

    Attributes:
        fit: Fit at temperature 1.
        jitter: Noise of corners and displacement of images.
        closed: Fit for a closed gate.
        error: Error of left-out clusters with that fit [px]; NaN without clusters.
        ratio: The same as a fraction of the error with the nominal arm.
    """

    fit: Fit
    jitter: Jitter
    closed: Fit
    error: float
    ratio: float


def _trial(
    fit: Fit,
    jitter: Jitter,
    groups: PriorGroups,
    expected: Array,
    temperature: float,
    folds: Sequence[Fold],
    max_iterations: int,
) -> _Trial:
    """Judge a model of the noise on left-out clusters."""
    closed = _with_evidence(fit, groups, expected, temperature, max_iterations)
    error = held_out_error(closed, folds)
    nominal = held_out_error(_without_arm(fit, max_iterations), folds)
    if error is None or nominal is None:
        return _Trial(fit, jitter, closed, float("nan"), float("nan"))
    return _Trial(fit, jitter, closed, error.pixels, error.pixels / nominal.pixels)


def _solve(fit: Fit, problem: Problem, temperature: float, max_iterations: int) -> Fit:
    """Solve a problem, whose priors count at temperature 1, at a temperature."""
    problem = problem.at_temperature(temperature)
    solution = minimize(problem, "lm", fit.solution.x, max_iterations)
    return replace(fit, problem=problem, solution=solution, previous_iterations=fit.iterations)


def _with_evidence(
    fit: Fit, groups: PriorGroups, expected: Array, temperature: float, max_iterations: int
) -> Fit:
    """Fit with the prior widths of greatest evidence at a temperature, however narrow."""
    weights = expected.copy()
    system, x = fit.solution.system, fit.solution.x
    rows = TriangularSystem(system.rows / np.sqrt(temperature))
    members, group_index = groups.members, groups.group_index
    for _ in range(_N_EVIDENCE_ROUNDS if len(members) else 0):
        posterior = append_priors(rows, weights, x)
        values = (x + pseudo_inverse(posterior.r, posterior.z))[members]
        root = posterior_sqrt_covariance(rows, weights)[0][members]
        determined = np.fmax(1 - np.einsum("ij,ij->i", root, root) * weights[members] ** 2, 0.0)
        squares = np.bincount(group_index, (values * expected[members]) ** 2)
        count = np.fmax(np.bincount(group_index, determined), 1e-9)
        widths = np.clip(np.sqrt(squares / count), MIN_WIDTH, MAX_WIDTH)
        weights[members] = expected[members] / widths[group_index]
    return _solve(fit, fit.problem.with_prior_weights(weights), temperature, max_iterations)


def _without_arm(fit: Fit, max_iterations: int, held: Collection[str] = ()) -> Fit:
    """Fit cameras and boards with the nominal arm; the parameter sets `held` keep their first values."""
    problem = fit.problem
    robot = len(problem.errors.parameters)
    values = {
        p.name: p.nominal
        for item in problem.data
        if isinstance(item, CameraCorners)
        for p in item.instrument_parameters
        if item.set_of(p.name) in held
    }
    is_free = np.array([p.name not in values for p in problem.instrument_parameters], bool)
    plain = replace(
        problem,
        errors=ErrorModel(problem.errors.chain, ()),
        weights=problem.weights[robot:][is_free],
        known=values | dict(problem.known),
        bounds=None,
    )
    solution = minimize(plain, "lm", fit.solution.x[robot:][is_free], max_iterations, loose=True)
    return replace(fit, problem=plain, solution=solution)


def _stages(fit: Fit, final: Fit, gate: Gate, max_iterations: int) -> tuple[Stage, ...]:
    """Judge the stages of a calibration: frames, intrinsics, arm."""
    folds = cluster_folds(fit.data)
    images = k_fold(fit.data, N_IMAGE_FOLDS) if folds else ()

    def judged(name: str, each: Fit, is_kept: bool, reason: str) -> Stage:
        n_unknowns = len(each.problem.weights)
        errors = fitted_error(each), held_out_error(each, images), held_out_error(each, folds)
        return Stage(name, is_kept, n_unknowns, *errors, reason)

    frames = _without_arm(fit, max_iterations, ("intrinsics",))
    out = [judged("frames", frames, True, "Poses of cameras and boards are always estimated.")]
    lenses = _without_arm(fit, max_iterations)
    if len(lenses.problem.weights) > len(frames.problem.weights):
        out.append(judged("intrinsics", lenses, True, "The rig does not fix them."))
    if final.problem.errors.parameters:
        out.append(judged("arm", final, gate.is_open, gate.sentence))
    return tuple(out)


def cluster_folds(data: Sequence[Measurement]) -> tuple[Fold, ...]:
    """Divide the configurations of measurements into clusters of joint space.

    Args:
        data: Measurements.

    Returns:
        Folds that hold out one cluster each; empty for too few configurations.
    """
    label = configuration_groups(data)
    q, _ = different_configurations(data)
    if len(q) < 2 * N_CLUSTERS or len(q) != label.max() + 1:
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
