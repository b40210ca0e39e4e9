"""Find the samples that a majority agrees with, whatever the others are.

With many outliers, a fit to all samples lies between good and bad ones. Its residuals are then large for all
samples, and their sizes do not show which samples are wrong. The good samples are found in three steps:

1. Linearize the rows at the solution, and search the majorities of samples that agree best
   (`estimation.trimmed_squares.search`).
2. Extend the samples of each of the best fits by all whose studentized residual is small, and fit again,
   until they do not change.
3. These fits compete by a likelihood in which good samples have one unknown noise
   scale and each bad block b has its own: with ν₀ and ν_g degrees of freedom of fits to all and to the good
   samples, mean squares s₀² and s_g², and n_b rows of a bad block with mean square b²,

       ½·ν_g·log(s_g²) + Σ_b ½·n_b·log(b²) + log C        against        ½·ν₀·log(s₀²)

   C is the number of ways to choose as many good samples.

   Degrees of freedom are rows minus the effective number of coordinates that the data, not the priors,
   determine.

   All samples are good unless the left side is smaller and there is at least one clear outlier.

Outliers by mistakes are set apart from good samples, and occur anywhere in joint space. If errors of all
sizes occur instead, or outliers lie together in joint space, the model is incomplete: a fit to a part of
joint space is then too good there and wrong elsewhere. In both cases samples are only rejected if they are
very far off.

The search is skipped if there are many data and the residuals of the fit to all samples look like noise. With
many rows per unknown, independent outliers hardly change the fit: unknowns divided by rows is the fraction of
their squares that spreads over all samples. Outliers that agree with each other can change it much.
The residuals of good and bad samples then differ by multiples of a common shift. In both cases the squares do
not follow the χ² distribution of noise: a few are far too large, or too many or too few of them are in some
tenth of the distribution.

Only the selection is used further. Module `estimation.robust` judges it with the nonlinear model, and the
solution is an ordinary least-squares fit of the good samples.

Shapes: m samples of k residuals each, b blocks (one per sample and residual group), c classes, u coordinates
y, a fits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation import robust
from ..estimation.problem import Problem, linearize_and_factor, whitened_residuals
from ..estimation.solver import SolverResult
from ..estimation.trimmed_squares import MIN_SCALE, LinearizedRows, linearize_rows, search_majorities
from ..measurements.base import Measurement
from ..measurements.measured_region import MIN_SPREAD
from ..session.linear_model import inverse

# Smallest number of rows per unknown, and of samples of each measurement, with which the search may be
# skipped. The rows of one configuration count once.
MIN_ROWS_PER_UNKNOWN, MIN_TESTED_SAMPLES = 30, 100
# Singular values of the rows of one configuration below this share of the largest are those of repetitions.
SAME_ROWS = 1e-2
# Largest number of samples that take part in the search.
MAX_SAMPLES = 200
# Largest number of coordinates; the matrices of the search take 8·b·u² bytes.
MAX_COORDINATES = 200
# Standardized residual above which a sample does not extend the good ones: one good sample in a thousand.
STRICT_THRESHOLD = 3.0
# Log-likelihood by which good samples of an earlier search must be more likely than new ones. The rows are
# linearized at their own solution, so that the likelihood of others is not exact.
MIN_ADVANTAGE = 10.0
# Number of majorities that the search for a hidden one extends, probability that chance makes one, and
# largest number of samples.
N_HIDDEN, MAX_CHANCE, MAX_FEW = 40, 0.01, 100
# Largest number of extensions of the good samples.
MAX_EXTENSIONS = 20
# Number of permutations that show how far apart outliers and other samples are by chance.
N_PERMUTATIONS = 1000


def find_good_samples(
    problem: Problem,
    solution: SolverResult,
    data: Sequence[Measurement],
    groups: Array,
    previous: Sequence[Array],
) -> tuple[list[Array], str]:
    """Find the samples that agree with a majority; those of an earlier search may stay."""
    # Weights (m,) of each measurement are 1 for good samples and ZERO_WEIGHT for others. The robust stage
    # judges the samples with the nonlinear model: it is "reject" if outliers were found that are set apart
    # from the other samples, "reject_regional" if these lie together in joint space, else "reject_far".
    counts = [len(item.rows) for item in data]
    all_good = [np.ones(count) for count in counts], robust.FAR_REJECTED
    # Data and priors determine at least the coordinates that have priors.
    is_large = np.count_nonzero(problem.weights) > MAX_COORDINATES
    if is_large or _looks_like_noise(problem.with_data(data), solution.x, groups):
        return all_good
    drawn = _draw_samples(sum(counts))
    starts = np.cumsum([0, *counts])
    taken = [drawn[(drawn >= a) & (drawn < b)] - a for a, b in pairwise(starts)]
    part = problem.with_data([item.take(index) for item, index in zip(data, taken, strict=True)])
    system = linearize_and_factor(part, solution.x, small_angle=False)
    root = system.sqrt_covariance(problem.weights)[0]
    if root.shape[1] > MAX_COORDINATES:
        return all_good
    n_determined, n_rows = system.rank, sum(item.residual_dim * len(item.rows) for item in part.data)
    if not 0 < 2 * n_determined <= n_rows:
        return all_good
    rows = linearize_rows(part, solution.x, root)
    redundancy = n_rows / independent_rows([item[:-1] for item in rows.items], groups[drawn])
    if 2 * n_determined > n_rows / redundancy:
        return all_good
    was_good = np.concatenate([np.empty(0), *previous])[drawn] > robust.ZERO_WEIGHT
    core = _best_core(rows, search_majorities(rows, groups[drawn], n_determined), was_good, redundancy)
    if core is None:
        return all_good
    stage = robust.rejection_stage(core.t)
    if stage == robust.REJECTED and _are_regional(
        part.data, groups[drawn], core.t > robust.REJECTION_THRESHOLD
    ):
        stage = robust.REGIONAL
    threshold = robust.WEIGHT_FUNCTIONS[stage][1]
    if len(drawn) < len(groups):
        x = solution.x + root @ core.y
        return _judge(problem.with_data(data), x, rows, core.scales, threshold), stage
    weights = np.where(core.t > threshold, robust.ZERO_WEIGHT, 1.0)
    return [weights[a:b] for a, b in pairwise(starts)], stage


def find_hidden_majority(problem: Problem, x: Array, groups: Array) -> tuple[int, float] | None:
    """Find a hidden majority; return the number of other samples, and how much better it agrees."""
    # With few samples, a fit adapts to many outliers so far that the likelihood does not prefer the good
    # samples. If all m samples had the variance s₀² of a fit to all, the mean square s_g² of n_g chosen ones
    # would be as small with a probability of at most C(m, n_g)·P(χ²_ν ≤ ν·s_g²/s₀²), with ν degrees of
    # freedom.
    if len(groups) > MAX_FEW:
        return None
    from scipy.special import gammainc  # lazy import: slow

    system = linearize_and_factor(problem, x, small_angle=False)
    root, n_determined = system.sqrt_covariance(problem.weights)[0], system.rank
    if not 0 < root.shape[1] <= MAX_COORDINATES:
        return None
    rows = linearize_rows(problem, x, root)
    redundancy = rows.counts.sum() / independent_rows([item[:-1] for item in rows.items], groups)

    def mean_square(is_good: Array, scales: Array) -> tuple[float, float]:
        squares = rows.residual_squares(rows.solve(is_good[None] * 1.0, scales[None]))[0]
        fitted = is_good[rows.sample]
        freedom = float(rows.counts[fitted].sum()) / redundancy - rows.n_determined
        return float(squares[fitted].sum()) / redundancy / max(freedom, 1e-9), freedom

    everything = np.ones(rows.n_samples, bool)
    total, freedom = mean_square(everything, np.ones(len(rows.is_estimated)))
    best, cores = (math.log(MAX_CHANCE), None), []
    for is_good, noise in search_majorities(rows, groups, n_determined, N_HIDDEN) if freedom > 0 else ():
        if any((core.t[is_good] <= STRICT_THRESHOLD).all() for core in cores):
            continue
        cores.append(core := _extend(rows, is_good, noise, redundancy))
        chosen = core.t <= robust.REJECTION_THRESHOLD
        square, freedom = mean_square(chosen, core.scales)
        if chosen.all() or freedom < 1 or not square < total:
            continue
        chance = float(gammainc(freedom / 2, freedom * square / total / 2))
        log_chance = math.log(max(chance, 1e-300)) + _log_choices(len(chosen), int(chosen.sum()))
        if log_chance < best[0]:
            best = log_chance, (int(np.sum(~chosen)), float(np.sqrt(total / max(square, MIN_SCALE**2))))
    return best[1]


def _looks_like_noise(problem: Problem, x: Array, groups: Array) -> bool:
    """Return whether many residuals of a fit to all samples follow the distribution of noise."""
    starts = np.cumsum([0, *(len(item.rows) for item in problem.data)])
    n_rows = sum(
        item.residual_dim * len(np.unique(groups[a:b]))
        for item, (a, b) in zip(problem.data, pairwise(starts), strict=True)
    )
    if n_rows < MIN_ROWS_PER_UNKNOWN * len(x) or min(np.diff(starts)) < MIN_TESTED_SAMPLES:
        return False
    for item, residual in zip(problem.data, whitened_residuals(problem, x), strict=True):
        for rows in (group.rows for group in item.residual_groups.values()):
            k = np.arange(len(residual))[rows].size
            mean_squares = np.mean(residual[rows] ** 2, 0)
            t = robust.standardize_ratios(mean_squares, k)
            if t.max() > robust.OUTLIER_THRESHOLD or not robust.is_chi_square(mean_squares, k):
                return False
    return True


def _judge(problem: Problem, x: Array, rows: LinearizedRows, scales: Array, threshold: float) -> list[Array]:
    """Judge all samples by a solution x (p+s,) of some: weight 1 for good ones, ZERO_WEIGHT for others."""
    weights = []
    for residual, classes in zip(whitened_residuals(problem, x), rows.row_classes, strict=True):
        residual = residual / scales[classes][:, None]
        t = robust.standardize_ratios(np.mean(residual**2, 0), len(residual))
        weights.append(np.where(t > threshold, robust.ZERO_WEIGHT, 1.0))
    return weights


def _are_regional(data: Sequence[Measurement], groups: Array, is_outlier: Array) -> bool:
    """Return whether outliers (m,) are in other places of joint space than the other samples."""
    # Energy test of two samples (Szekely & Rizzo 2013): 2·E‖a - b‖ - E‖a - a'‖ - E‖b - b'‖ is zero for
    # configurations a and b of one distribution. A configuration is an outlier if half of its samples are.
    rng, first = np.random.default_rng(0), 0
    energies = np.zeros(N_PERMUTATIONS + 1)
    for item in data:
        part = slice(first, first + len(item.rows))
        first = part.stop
        _, rows, labels = np.unique(groups[part], return_index=True, return_inverse=True)
        outlying = np.bincount(labels, is_outlier[part]) >= 0.5 * np.bincount(labels)
        if not item.configurations_per_row or outlying.all() or not outlying.any():
            continue
        q = np.concatenate(np.split(item.configurations(), item.configurations_per_row), 1)[rows]
        scaled = q / np.fmax(q.std(0), MIN_SPREAD)
        distances = np.linalg.norm(scaled[:, None] - scaled, axis=2)
        drawn = rng.permuted(np.tile(outlying, (N_PERMUTATIONS, 1)), axis=1)
        a = np.vstack([outlying, drawn]) / outlying.sum()
        b = np.vstack([~outlying, ~drawn]) / np.sum(~outlying)
        energies -= np.sum(((a - b) @ distances) * (a - b), 1)
    return bool(np.mean(energies[1:] >= energies[0]) <= MAX_CHANCE)


def independent_rows(columns: Sequence[Array], groups: Array) -> int:
    """Count the rows (u, k, m) of items that differ; repetitions of a configuration do not."""
    total, first = 0, 0
    for item in columns:
        labels = groups[first : first + item.shape[2]]
        first += item.shape[2]
        for label, count in zip(*np.unique(labels, return_counts=True), strict=True):
            k = item.shape[1]
            # Without unknowns, all rows are residuals.
            if count > 1 and len(item):
                same = item[..., labels == label].reshape(len(item), -1)
                k = int(np.linalg.matrix_rank(same, SAME_ROWS * np.linalg.norm(same, 2)))
            total += k
    return max(total, 1)


def _draw_samples(m: int) -> Array:
    """Draw at most MAX_SAMPLES of m samples, in ascending order."""
    if m <= MAX_SAMPLES:
        return np.arange(m)
    return np.sort(np.random.default_rng(0).permutation(m)[:MAX_SAMPLES])


@frozen(eq=False)
class _Core:
    """Fit of the samples that agree with each other."""

    y: Array  # Solution, shape (u,)
    scales: Array  # Noise scales of the classes, shape (c,)
    t: Array  # Standardized residuals of all samples, shape (m,)
    log_likelihood: float  # Negative logarithm of the likelihood, see the module docstring


def _best_core(
    rows: LinearizedRows, fits: Sequence[tuple[Array, Array]], was_good: Array, redundancy: float
) -> _Core | None:
    """Extend the samples of several fits and choose the most likely ones, or those that were good before."""
    everything = np.ones(rows.n_samples, bool)
    scales = rows.noise_scales(rows.residual_squares(rows.solve(everything[None] * 1.0, fits[0][1][None])))[0]
    cores: list[_Core] = []
    for is_good, noise in fits:
        # A majority of samples that are good already leads to the same ones.
        if not any((core.t[is_good] <= STRICT_THRESHOLD).all() for core in cores):
            cores.append(_extend(rows, is_good, noise, redundancy))
    best = min(cores, key=lambda core: core.log_likelihood)
    if not was_good.all():
        earlier = _extend(rows, was_good, fits[0][1], redundancy)
        if earlier.log_likelihood < best.log_likelihood - MIN_ADVANTAGE:
            best = earlier
    has_outlier = (best.t > robust.OUTLIER_THRESHOLD).any()
    is_likely = best.log_likelihood < _log_likelihood(rows, everything, scales, redundancy)
    return best if has_outlier and is_likely else None


def _extend(rows: LinearizedRows, is_good: Array, scales: Array, redundancy: float) -> _Core:
    """Extend the samples of a fit by all with small residuals, until they do not change."""
    # The threshold is strict: a small outlier that is included too early would pull the fit towards itself.
    y, t = np.zeros(0), np.zeros(0)
    for _ in range(MAX_EXTENSIONS):
        weights = is_good[None].astype(float)
        y = rows.solve(weights, scales[None])[0]
        scales = rows.noise_scales(rows.residual_squares(y[None]), is_good[None])[0]
        covariance = inverse(rows.total_information(weights, scales[None])[0])
        t = _standardized(rows, y, scales, is_good, covariance)
        previous, is_good = is_good, t <= STRICT_THRESHOLD
        if np.array_equal(previous, is_good):
            break
    return _Core(y, scales, t, _log_likelihood(rows, t <= robust.REJECTION_THRESHOLD, scales, redundancy))


def _log_likelihood(rows: LinearizedRows, is_good: Array, scales: Array, redundancy: float) -> float:
    """Compute the negative log-likelihood of a choice of good samples; see the module docstring."""
    squares = rows.residual_squares(rows.solve(is_good[None].astype(float), scales[None]))[0]
    fitted, total = is_good[rows.sample], 0.0
    freedom = 1 - rows.n_determined * redundancy / rows.counts[fitted].sum()
    if not freedom > 0:
        return np.inf
    for i in range(len(scales)):
        members = fitted & (rows.noise_class == i)
        n_rows = freedom * rows.counts[members].sum()
        if n_rows > 0:
            total += 0.5 * n_rows * np.log(max(squares[members].sum() / n_rows, MIN_SCALE**2))
    bad = rows.counts[~fitted]
    total += float(np.sum(0.5 * bad * np.log(np.fmax(squares[~fitted] / bad, MIN_SCALE**2))))
    return float(total) + _log_choices(len(is_good), int(is_good.sum()))


def _log_choices(m: int, n_good: int) -> float:
    """Return the logarithm of the number of choices: the best of many fits better than one by chance."""
    return math.lgamma(m + 1) - math.lgamma(n_good + 1) - math.lgamma(m - n_good + 1)


def _standardized(
    rows: LinearizedRows, y: Array, scales: Array, is_fitted: Array, covariance: Array
) -> Array:
    """Compute residuals (m,) at y (u,), standardized and corrected by `robust.residual_covariances`."""
    out, first = [], 0
    for item, classes in zip(rows.items, rows.row_classes, strict=True):
        k, m = item.shape[1:]
        fitted = is_fitted[first : first + m]
        scaled = item / scales[classes][:, None]
        b, residual = scaled[:-1], scaled[-1] - np.tensordot(y, scaled[:-1], (0, 0))
        leverages = np.einsum("ukm,ulm->mkl", b, np.tensordot(covariance, b, 1), optimize=True)
        sign = np.where(fitted, -1.0, 1.0)[:, None, None]
        out.append(robust.standardized_residuals(residual, np.eye(k) + sign * leverages, fitted))
        first += m
    return np.concatenate(out)
