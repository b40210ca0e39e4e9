"""Robust losses by iteratively reweighted least squares, and outlier detection.

A sample i has k whitened residuals r_i. Its mean square, divided by the scale s² of all samples, is χ²_k/k
distributed if the sample is good. The cube root of that is nearly normal (Wilson & Hilferty 1931):

    t_i = (∛(‖r_i‖²/(k·s²)) - μ) / √(2/(9k)),     μ = 1 - 2/(9k)

so that one threshold serves every kind of measurement, whatever its k. The scale follows from the median,
which outliers hardly change: median(χ²_k/k) ≈ μ³.

Each round of iteratively reweighted least squares (IRLS) multiplies the rows of sample i by √w(t_i). The
tuning constants of the weight functions w keep 95 % of the efficiency on normal errors (Holland & Welsch
1977):

    Huber    w = min(1, 1.345/t)
    Cauchy   w = 1/(1 + (t/2.385)²)
    Tukey    w = (1 - (t/4.685)²)²  for t < 4.685, else 0

With few measurements an outlier pulls the fit towards itself and its own residual looks small. The residuals
are therefore studentized (Cook & Weisberg 1982): instead of r_iᵀ·r_i, the sum of squares is r_iᵀ·C_i⁻¹·r_i
with the covariance C_i of the residual in a fit of good samples, which depends on the leverage of sample i.

To add a loss: add its weight function to `WEIGHT_FUNCTIONS` and a row to `LOSSES`. The command line takes
names and help texts from there.

References:
    E. B. Wilson and M. M. Hilferty, The Distribution of Chi-Square, PNAS 17, 1931.
    P. J. Huber, Robust Statistics, Wiley 1981.
    P. W. Holland and R. E. Welsch, Robust Regression Using Iteratively Reweighted Least-Squares, 1977.
    R. D. Cook and S. Weisberg, Residuals and Influence in Regression, Chapman & Hall 1982.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..measurements.base import Measurement
from .normal_equations import NormalEquations
from .priors import effective_parameters
from .problem import (
    CHUNK_SIZE,
    Chunk,
    Linearization,
    Problem,
    linear_system,
    uses_normal_equations,
    whitened_residuals,
)
from .solver import SolverResult

# Standardized residual above which a sample is an outlier: one good sample in three million exceeds it.
OUTLIER_THRESHOLD = 5.0
# Standardized residual above which loss "auto" rejects a sample if outliers are set apart from all other
# samples: one good sample in four thousand exceeds it.
REJECTION_THRESHOLD = 3.5
# The same if residuals of all sizes occur. Unmodelled errors of good samples in a far corner of the workspace
# stay below.
FAR_THRESHOLD = 12.0

# Number of equally likely parts of the distribution of squares, and largest χ² of the counts in them. It is
# exceeded by two in a hundred sets of good samples.
N_PARTS, MAX_PARTS_CHI_SQUARE = 10, 20.0
# Bounds between these parts of χ²_k/k for the usual numbers k of residuals.
CHI_SQUARE_DECILES = {
    1: (0.015791, 0.064185, 0.148472, 0.274996, 0.454936, 0.708326, 1.074194, 1.642374, 2.705543),
    2: (0.105361, 0.223144, 0.356675, 0.510826, 0.693147, 0.916291, 1.203973, 1.609438, 2.302585),
    3: (0.194791, 0.335058, 0.474551, 0.623056, 0.788658, 0.982055, 1.221624, 1.547209, 2.083796),
}
# Stages that reject outliers that are set apart from all other samples, and only those that are very far off:
# where residuals of all sizes occur, and where outliers lie together in joint space.
REJECTED, FAR_REJECTED, REGIONAL = "reject", "reject_far", "reject_regional"
# Outliers are set apart if at most this many samples per outlier lie between the thresholds, plus one.
MAX_BETWEEN = 0.2

# Ratio of the standard deviation of a normal distribution to its median absolute deviation.
MAD_TO_STD = 1.4826
# Smallest variance of a whitened residual, relative to its noise; below it the fit reproduces the sample.
MIN_VARIANCE = 1e-3
# Smallest ratio of two variances of the residuals of a sample that rounding errors leave.
ROUNDING = 1e-12
# Stages without a weight function: search for good samples, which chooses the last stage
# (`calibration.good_samples`), and unchanged weights.
TRIMMED, KEPT = "trimmed", "kept"
# Ratio of successive weight changes above which the weights oscillate.
OSCILLATION_RATIO = 0.8
# Weight of a rejected sample; small enough to have no effect, and not zero so that one can divide by it.
ZERO_WEIGHT = 1e-12
# Ratio of unknowns to rows below which leverage is negligible and residuals are not studentized.
NEGLIGIBLE_LEVERAGE = 0.01


def _uniform(t: Array) -> Array:
    """Return unit weights."""
    return np.ones_like(t)


# Weight function of each stage, and the standardized residual above which its weight is zero. Without that
# limit every outlier keeps a constant influence: with 10 % outliers the error is about 25 % larger.
WEIGHT_FUNCTIONS: dict[str, tuple[Callable[[Array], Array], float]] = {
    REJECTED: (_uniform, REJECTION_THRESHOLD),
    FAR_REJECTED: (_uniform, FAR_THRESHOLD),
    REGIONAL: (_uniform, FAR_THRESHOLD),
    "huber": (lambda t: 1.345 / np.maximum(t, 1.345), OUTLIER_THRESHOLD),
    "cauchy": (lambda t: 1 / (1 + (np.maximum(t, 0) / 2.385) ** 2), OUTLIER_THRESHOLD),
    "tukey": (lambda t: np.maximum(1 - (np.clip(t, 0, 4.685) / 4.685) ** 2, 0) ** 2, OUTLIER_THRESHOLD),
}


@frozen
class Loss:
    """Robust loss that a user can choose."""

    #: Keys of `WEIGHT_FUNCTIONS`, TRIMMED or KEPT in the order of their use, each until the weights have
    #: settled.
    stages: tuple[str, ...]
    help: str  #: One line for help texts.


# "auto" finds the samples that a majority agrees with, whatever the others are. It then fits these samples
# with unit weights.
LOSSES: dict[str, Loss] = {
    "auto": Loss((KEPT, TRIMMED), "unit weights for all samples that agree with a majority, reject outliers"),
    "linear": Loss((KEPT,), "unit weights for all samples, outliers included"),
    "huber": Loss(("huber",), "down-weight beyond 1.345 standard deviations, reject outliers"),
    "cauchy": Loss(("cauchy",), "down-weight smoothly with the size of the residual, reject outliers"),
    "tukey": Loss(("tukey",), "down-weight smoothly to zero at 4.685 standard deviations"),
}


def standardized_residuals(
    residual: Array, covariances: Array | None = None, is_good: Array | None = None
) -> Array:
    """Compute the residual t of each sample of one measurement, standard normal for good samples."""
    # Whitened residuals are (k, m), their covariances (m, k, k), up to a factor that good samples determine.
    k = len(residual)
    if covariances is None:
        return standardize_mean_squares(np.sum(residual**2, 0) / k, k, is_good)
    # A residual that the fit makes zero for any measured value must not be divided by its variance.
    trace = np.trace(covariances, axis1=1, axis2=2)
    regularized = covariances + np.fmax(MIN_VARIANCE, ROUNDING * np.abs(trace))[:, None, None] * np.eye(k)
    return standardize_mean_squares(
        np.sum(residual.T * np.linalg.solve(regularized, residual.T[..., None])[..., 0], 1) / k, k, is_good
    )


def standardize_mean_squares(mean_squares: Array, k: int, is_good: Array | None = None) -> Array:
    """Transform mean squares of k residuals to standardized residuals t (Wilson & Hilferty)."""
    mean = 1 - 2 / (9 * k)
    # The median of χ²_k/k is mean³.
    inliers = mean_squares if is_good is None else mean_squares[is_good]
    scale = np.median(inliers) / mean**3 if len(inliers) else 0.0
    if scale <= 0:
        return np.zeros(len(mean_squares))
    return standardize_ratios(mean_squares / scale, k)


def standardize_ratios(ratios: Array, k: int | Array) -> Array:
    """Transform mean squares of k residuals over the variance of good ones to standard normal t (m,)."""
    return (np.cbrt(ratios) - (1 - 2 / (9 * k))) / np.sqrt(2 / (9 * k))


def is_chi_square(mean_squares: Array, k: int) -> bool:
    """Return whether mean squares of residuals follow the distribution χ²_k/k (Pearson's test)."""
    bounds = CHI_SQUARE_DECILES.get(k)
    if bounds is None:
        from scipy.special import gammaincinv  # lazy import: slow

        bounds = gammaincinv(k / 2, np.arange(1, N_PARTS) / N_PARTS) * 2 / k
    counts = np.bincount(np.searchsorted(bounds, mean_squares), minlength=N_PARTS)
    expected = len(mean_squares) / N_PARTS
    return bool(np.sum((counts - expected) ** 2) / expected <= MAX_PARTS_CHI_SQUARE)


def rejection_stage(t: Array) -> str:
    """Choose the stage that rejects outliers, by whether they are set apart from all other samples."""
    n_far = np.sum(t > OUTLIER_THRESHOLD)
    n_between = np.sum((t > REJECTION_THRESHOLD) & (t <= OUTLIER_THRESHOLD))
    return REJECTED if n_between <= MAX_BETWEEN * n_far + 1 else FAR_REJECTED


def sample_weights(t: Array, stage: str) -> Array:
    """Compute the weights of samples."""
    weight_function, cutoff = WEIGHT_FUNCTIONS[stage]
    return np.maximum(np.where(t > cutoff, 0.0, weight_function(t)), ZERO_WEIGHT)


def reject_groups(weights: Array, t: Array, item: Measurement) -> Array:
    """Reject all samples of each group that is wrong as a whole, such as an image of another pose."""
    # Some of its samples are rejected then, and the residuals t of the others are larger than in other
    # groups. Good groups differ, too, where their samples share an error of the arm. The spread of all groups
    # is therefore estimated by the median absolute deviation.
    is_kept = weights > ZERO_WEIGHT
    if is_kept.all():
        return weights
    k, labels = item.residual_dim, item.sample_groups
    n_kept = np.bincount(labels, is_kept)
    is_judged = n_kept > 0
    # Inverse of `standardize_ratios`.
    ratios = np.fmax(t * np.sqrt(2 / (9 * k)) + 1 - 2 / (9 * k), 0.0) ** 3
    means = np.bincount(labels, ratios * is_kept)[is_judged] / n_kept[is_judged]
    scores = standardize_ratios(means, k * n_kept[is_judged])
    deviations = scores - np.median(scores)
    spread = max(1.0, MAD_TO_STD * float(np.median(np.abs(deviations))))
    is_wrong = np.zeros(len(n_kept), bool)
    is_wrong[is_judged] = deviations > REJECTION_THRESHOLD * spread
    is_wrong &= n_kept < np.bincount(labels)
    return np.where(is_wrong[labels], ZERO_WEIGHT, weights)


@frozen(eq=False)
class WeightChange:
    """Change of the weights in one round of IRLS, before damping."""

    size: float = np.inf  # Largest change of a weight
    # Changes of each measurement's weights, shape (m,) each; empty before the first round.
    steps: tuple[Array, ...] = ()
    n_reversals: int = 0  # Number of rounds of this stage that nearly undid the change of the round before
    # Samples that counted again after they had been rejected in this stage, (m,) each; empty at first.
    has_returned: tuple[Array, ...] = ()


def update_weights(
    previous: Sequence[Array], weights: Sequence[Array], stage: str, last: WeightChange
) -> tuple[list[Array], WeightChange]:
    """Compute the weights of the next round of IRLS from those that the residuals ask for."""
    # Weights whose change hardly falls alternate between two sets; their mean is used then. Weights of
    # samples with much leverage alternate again after that: from the second time on, every round makes a part
    # of the change only, half of it after each further time. A sample that is rejected for the second time
    # stays rejected: the residual of a sample near the limit may agree with neither choice.
    weights = list(weights)
    if WEIGHT_FUNCTIONS[stage][0] is _uniform:
        has_returned = last.has_returned or [np.zeros(len(w), bool) for w in weights]
        was_rejected = [w <= ZERO_WEIGHT for w in previous]
        weights = [
            np.where(rejected & returned, ZERO_WEIGHT, w)
            for w, rejected, returned in zip(weights, was_rejected, has_returned, strict=True)
        ]
        returns = tuple(
            returned | (rejected & (w > ZERO_WEIGHT))
            for w, rejected, returned in zip(weights, was_rejected, has_returned, strict=True)
        )
        return weights, replace(weight_change(weights, previous), has_returned=returns)
    change = weight_change(weights, previous)
    is_stalled = change.size > OSCILLATION_RATIO * last.size
    is_reversed = is_stalled and sum(map(np.vdot, change.steps, last.steps)) < 0
    n_reversals = last.n_reversals + is_reversed
    if damping := max(n_reversals - 1, int(is_stalled)):
        part = 0.5**damping
        weights = [part * a + (1 - part) * b for a, b in zip(weights, previous, strict=True)]
    return weights, replace(change, n_reversals=n_reversals)


def weight_change(weights: Sequence[Array], previous: Sequence[Array]) -> WeightChange:
    """Compute the change of weights."""
    steps = tuple(a - b for a, b in zip(weights, previous, strict=True))
    return WeightChange(max(float(np.abs(step).max(initial=0.0)) for step in steps), steps)


@frozen(eq=False)
class SolvedProblem:
    """Problem with its solution, and the uncertainty of its predictions."""

    problem: Problem
    solution: SolverResult

    @cached_property
    def prediction_covariances(self) -> list[Array]:
        """w_i·H_i, (m, k, k) of each measurement, with the leverages of the rows on the diagonal."""
        # H_i = J_i·C·J_iᵀ with the whitened Jacobian of a sample, without its weight, and the covariance C.
        problem, solution = self.problem, self.solution
        system, model = solution.system, problem.linearize(solution.x)
        if solution.converged and not isinstance(system, NormalEquations):
            # The system was linearized one step earlier, where other directions may be unobservable. With the
            # wide priors of frames and instruments its covariance would then not fit these rows.
            system = linear_system(problem, solution.x)
        if uses_normal_equations(problem):
            covariance = system.covariance(problem.weights)
            chunks = problem.map_chunks(partial(_structured_covariance, model, covariance))
        else:
            root = system.sqrt_covariance(problem.weights)[0]
            chunks = problem.map_chunks(partial(_prediction_covariance, model, root))
        out = []
        for item in problem.data:
            parts = [next(chunks) for _ in range(0, len(item.rows), CHUNK_SIZE)]
            out.append(np.concatenate([np.empty((0, item.residual_dim, item.residual_dim)), *parts]))
        return out


def studentized_residuals(
    solved: SolvedProblem, data: Sequence[Measurement], weights: Sequence[Array]
) -> list[Array]:
    """Compute standardized residuals that are corrected for leverage."""
    problem, solution = solved.problem, solved.solution
    n_rows = sum(np.count_nonzero(w > 0.5) * item.residual_dim for item, w in zip(data, weights, strict=True))
    n_unknowns = len(solution.x)
    if problem.temperature > 1:
        # The priors decide on many unknowns.
        n_unknowns = effective_parameters(problem, solution)
    if n_rows <= n_unknowns and n_rows <= solution.system.rank:
        return [np.zeros(len(item.rows)) for item in data]
    # Residuals of one image are whitened together. Rejected ones must not contribute to the others.
    weighted = [
        item if np.all(w == 1) else item.with_weights(w) for item, w in zip(data, weights, strict=True)
    ]
    whitened = whitened_residuals(problem.with_data(weighted), solution.x)
    residuals = [residual / np.sqrt(w) for residual, w in zip(whitened, weights, strict=True)]
    covariances = (
        residual_covariances(solved.prediction_covariances, weights)
        if n_unknowns >= NEGLIGIBLE_LEVERAGE * n_rows
        else [None] * len(data)
    )
    # Rejected samples do not count for the scale.
    return [
        standardized_residuals(residual, covariance, w > 0.5)
        for residual, covariance, w in zip(residuals, covariances, weights, strict=True)
    ]


def residual_covariances(predictions: Sequence[Array], weights: Sequence[Array]) -> list[Array]:
    """Compute the covariance of each sample's whitened residual in a fit of good samples."""
    # It is I + (1 - 2·w_i)·H_i with the predictions w_i·H_i. A sample of weight 1 has less than unit
    # covariance, as it pulls the fit towards itself. A rejected sample has more, as the fit is uncertain
    # there.
    out = []
    for covariances, weight in zip(predictions, weights, strict=True):
        w = weight[:, None, None]
        out.append(np.eye(covariances.shape[1]) + (1 - 2 * w) * covariances / w)
    return out


def _prediction_covariance(linearization: Linearization, root: Array, chunk: Chunk) -> Array:
    """Compute w_i·J_i·C·J_iᵀ of each sample of a chunk, shape (m, k, k), from a square root of C."""
    rows = np.tensordot(root, linearization.rows(chunk)[:-1], (0, 0))
    return np.einsum("rim,rjm->mij", rows, rows)


def _structured_covariance(linearization: Linearization, covariance: Array, chunk: Chunk) -> Array:
    """Compute the same, shape (m, k, k), from C (p, p) and rows whose columns have a structure."""
    return linearization.structured_rows(chunk).covariances(covariance)
