"""Least trimmed squares: find the samples that a majority agrees with, whatever the others are.

With many outliers, a fit to all samples lies between good and bad ones. Its residuals are then large for all
samples, and outliers hide behind each other. Least trimmed squares (Rousseeuw 1984) instead finds the fit
that is best for the h samples with the smallest residuals, h being a majority:

    minimize  Σ_c n_c·log(s_c²),      s_c² = mean square of the residuals of class c among the h samples

where class c has n_c rows with a common unknown noise scale s_c. With one class this is the usual sum of the
h smallest squared residuals. The search follows FAST-LTS (Rousseeuw & Van Driessen 2006):

1. Linearize the rows once, r(x + δ) ≈ r - J·δ, and change to coordinates y with δ = S·y. S is a square root
   of the covariance, so that all data and priors together have unit information in y. The information
   matrices of subsets then have a small condition number and may be formed.
2. Fit many random subsets that hardly determine the unknowns. Some consist of whole configurations, whose
   samples are often good or bad together, others of single samples.
3. Improve each fit by concentration steps: fit the h samples with the smallest residuals again. Only the
   best fits are iterated until their samples do not change.
4. Extend the samples of each of the best fits by all whose studentized residual is small, and fit again,
   until they do not change. These fits compete by a likelihood in which good samples have one unknown noise
   scale and each bad block b has its own: with ν₀ and ν_g degrees of freedom of fits to all and to the good
   samples, mean squares s₀² and s_g², and n_b rows of a bad block with mean square b²,

       ½·ν_g·log(s_g²) + Σ_b ½·n_b·log(b²) + log C        against        ½·ν₀·log(s₀²)

   C is the number of ways to choose as many good samples.

   Degrees of freedom are rows minus the effective number of coordinates that the data, not the priors,
   determine.

   All samples are good unless the left side is smaller and there is at least one clear outlier.

Outliers by mistakes are set apart from good samples. If errors of all sizes occur instead, the model is
incomplete, and samples are only rejected if they are very far off.

The search is skipped if there are many data and the residuals of the fit to all samples look like noise. With
many rows per unknown, independent outliers hardly bend the fit: unknowns divided by rows is the fraction of
their squares that spreads over all samples. Outliers that agree with each other can bend the fit.
The residuals of good and bad samples then differ by multiples of a common shift. In both cases the squares do
not follow the χ² distribution of noise: a few are far too large, or too many or too few of them are in some
tenth of the distribution.

Only the selection is used further. Module `estimation.robust` judges it with the nonlinear model, and the
solution is an ordinary least-squares fit of the good samples.

Shapes: m samples of k residuals each, b blocks (one per sample and residual group), c classes, u coordinates
y, a fits.

References:
    P. J. Rousseeuw, Least Median of Squares Regression, JASA 79, 1984.
    P. J. Rousseeuw and K. Van Driessen, Computing LTS Regression for Large Data Sets, DMKD 12, 2006.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from .._typing import Array
from ..estimation.problem import CHUNK_SIZE, Problem, chunk_residual, linearize_and_factor
from ..estimation.qr import posterior_sqrt_covariance, rank
from ..estimation.robust import (
    FAR_REJECTED,
    FAR_THRESHOLD,
    OUTLIER_THRESHOLD,
    REJECTED,
    REJECTION_THRESHOLD,
    ZERO_WEIGHT,
    is_chi_square,
    rejection_stage,
    standardize_ratios,
    standardized_residuals,
)
from ..estimation.solver import SolverResult
from ..measurements.base import Measurement

# Smallest number of rows per unknown, and of samples of each measurement, with which the search may be
# skipped. The rows of one configuration count once.
MIN_ROWS_PER_UNKNOWN, MIN_TESTED_SAMPLES = 30, 100
# Largest number of samples that take part in the search.
MAX_SAMPLES = 200
# Largest number of coordinates; the matrices of the search take 8·b·u² bytes.
MAX_COORDINATES = 200
# Largest and smallest number of random subsets, and the multiplications per concentration step of all.
MAX_STARTS, MIN_STARTS, MAX_MULTIPLICATIONS = 600, 60, 3e7
# Number of concentration steps of all fits, and largest number of those of the best fits.
N_FIRST_STEPS, MAX_LAST_STEPS = 2, 20
# Number of fits that are iterated until their samples do not change.
N_BEST = 8
# Standardized residual above which a sample does not extend the good ones: one good sample in a thousand.
STRICT_THRESHOLD = 3.0
# Largest number of extensions of the good samples.
MAX_EXTENSIONS = 20
# Least information of a direction that neither a subset nor the priors determine; all data have 1.
MIN_INFORMATION = 1e-9
# Smallest noise scale relative to that of the fit to all samples; exact data have none.
MIN_SCALE = 1e-6


@dataclass(frozen=True, eq=False)
class _Rows:
    """Linearized rows in coordinates y.

    Attributes:
        items: Rows [B | r] of each measurement, shape (u+1, k, m) each.
        row_classes: Class of each residual of each measurement, shape (k,) each.
        gram: Products BᵀB of each block, shape (b, u·u).
        right: Products Bᵀr of each block, shape (b, u).
        squares: Products rᵀr of each block, shape (b,).
        counts: Number of rows of each block, shape (b,).
        sample: Sample of each block, shape (b,).
        noise_class: Class of each block, shape (b,); all numbers from 0 to c-1 occur.
        is_estimated: Whether the noise scale of each class can be estimated, shape (c,); otherwise it is 1.
        information: Information of the priors, shape (u, u).
        prior_right: Right-hand side of the priors, shape (u,).
    """

    items: tuple[Array, ...]
    row_classes: tuple[Array, ...]
    gram: Array
    right: Array
    squares: Array
    counts: Array
    sample: Array
    noise_class: Array
    is_estimated: Array
    information: Array
    prior_right: Array

    @property
    def n_samples(self) -> int:
        """Number m of samples."""
        return int(self.sample.max()) + 1

    @property
    def n_determined(self) -> float:
        """Effective number of coordinates that all data determine; the priors determine the others."""
        return len(self.prior_right) - float(np.trace(self.information))

    def solve(self, weights: Array, scales: Array) -> Array:
        """Fit weighted samples.

        Args:
            weights: Weights of the samples in each fit, shape (a, m).
            scales: Noise scales of the classes in each fit, shape (a, c).

        Returns:
            Solutions, shape (a, u).
        """
        information = self.total_information(weights, scales)
        right = (weights[:, self.sample] / scales[:, self.noise_class] ** 2) @ self.right + self.prior_right
        return np.linalg.solve(information, right[..., None])[..., 0]

    def total_information(self, weights: Array, scales: Array) -> Array:
        """Compute the information of weighted samples and priors, shape (a, u, u); see `solve`."""
        u = len(self.prior_right)
        block_weights = weights[:, self.sample] / scales[:, self.noise_class] ** 2
        information = (block_weights @ self.gram).reshape(-1, u, u) + self.information
        return information + MIN_INFORMATION * np.eye(u)

    def residual_squares(self, y: Array) -> Array:
        """Compute the sum of squared residuals of each block, shape (a, b), at solutions of shape (a, u)."""
        products = np.einsum("au,av->auv", y, y).reshape(len(y), -1)
        return np.fmax(self.squares - 2 * y @ self.right.T + products @ self.gram.T, 0.0)

    def noise_scales(self, squares: Array, inliers: Array | None = None) -> Array:
        """Estimate the noise scale of each class by the median of its blocks.

        Args:
            squares: Sums of squared residuals of the blocks, shape (a, b).
            inliers: Whether each sample counts, shape (a, m); all if None.

        Returns:
            Scales, shape (a, c).
        """
        scales = np.ones((len(squares), len(self.is_estimated)))
        for i in np.flatnonzero(self.is_estimated):
            members = self.noise_class == i
            counts = self.counts[members]
            # The median of χ²_k/k is about (1 - 2/(9k))³.
            mean_squares = squares[:, members] / (counts * (1 - 2 / (9 * counts)) ** 3)
            if inliers is not None:
                mean_squares = np.where(inliers[:, self.sample[members]], mean_squares, np.nan)
            median = np.median(mean_squares, 1) if inliers is None else np.nanmedian(mean_squares, 1)
            scales[:, i] = np.fmax(np.sqrt(median), MIN_SCALE)
        return scales

    def distances(self, squares: Array, scales: Array) -> Array:
        """Compute the sum of squared residuals of each sample relative to the noise, shape (a, m)."""
        scaled = squares / scales[:, self.noise_class] ** 2
        order = np.argsort(self.sample, kind="stable")
        first = np.searchsorted(self.sample[order], np.arange(self.n_samples))
        return np.add.reduceat(scaled[:, order], first, axis=1)

    def objective(self, squares: Array, is_chosen: Array) -> Array:
        """Compute the objective of fits.

        Args:
            squares: Sums of squared residuals of the blocks, shape (a, b).
            is_chosen: Whether each sample is among the h best, shape (a, m).

        Returns:
            Objective, shape (a,).
        """
        chosen, total = is_chosen[:, self.sample], np.zeros(len(squares))
        for i, is_estimated in enumerate(self.is_estimated):
            members = self.noise_class == i
            n_rows = chosen[:, members] @ self.counts[members]
            sums = np.sum(squares[:, members] * chosen[:, members], 1)
            if is_estimated:
                mean_squares = np.fmax(sums / np.fmax(n_rows, 1.0), MIN_SCALE**2)
                total += self.counts[members].sum() * np.log(mean_squares)
            else:
                total += sums
        return total


@dataclass(frozen=True, eq=False)
class GoodSamples:
    """Result of the search for good samples.

    Attributes:
        weights: Weights of each measurement's samples, shape (m,) each: 1 for good samples, ZERO_WEIGHT for
            others.
        stage: Robust stage that judges the samples with the nonlinear model: "reject" if outliers were
            found that are set apart from the other samples, otherwise "reject_far".
    """

    weights: list[Array]
    stage: str


def find_good_samples(
    problem: Problem, solution: SolverResult, data: Sequence[Measurement], groups: Array
) -> GoodSamples:
    """Find the samples that agree with the fit of a majority of the samples.

    Args:
        problem: Problem as it was solved.
        solution: Its solution.
        data: Fitted measurements with estimated standard deviations, without robust weights.
        groups: Label of each sample's configuration, the measurements one after the other.

    Returns:
        The good samples; all samples if there are too few to judge each other.
    """
    counts = [len(item.rows) for item in data]
    if _looks_like_noise(problem.with_data(data), solution.x, groups):
        return GoodSamples([np.ones(count) for count in counts], FAR_REJECTED)
    drawn = _draw_samples(sum(counts))
    starts = np.cumsum([0, *counts])
    taken = [drawn[(drawn >= a) & (drawn < b)] - a for a, b in pairwise(starts)]
    part = problem.with_data([item.take(index) for item, index in zip(data, taken, strict=True)])
    system = linearize_and_factor(part, solution.x, small_angle=False)
    root, n_determined = posterior_sqrt_covariance(system, problem.weights)[0], rank(system.r)
    all_good = GoodSamples([np.ones(count) for count in counts], FAR_REJECTED)
    n_rows = sum(item.residual_dim * len(item.rows) for item in part.data)
    if not (0 < 2 * n_determined <= n_rows and root.shape[1] <= MAX_COORDINATES):
        return all_good
    rows = _linearized_rows(part, solution.x, root)
    redundancy = n_rows / _independent_rows(rows, groups[drawn])
    if 2 * n_determined > n_rows / redundancy:
        return all_good
    core = _best_core(rows, _search(rows, groups[drawn], n_determined), redundancy)
    if core is None:
        return all_good
    stage = rejection_stage(core.t)
    threshold = REJECTION_THRESHOLD if stage == REJECTED else FAR_THRESHOLD
    if len(drawn) < len(groups):
        x = solution.x + root @ core.y
        return GoodSamples(_judge(problem.with_data(data), x, rows, core.scales, threshold), stage)
    weights = np.where(core.t > threshold, ZERO_WEIGHT, 1.0)
    return GoodSamples([weights[a:b] for a, b in pairwise(starts)], stage)


def _looks_like_noise(problem: Problem, x: Array, groups: Array) -> bool:
    """Return whether many residuals of a fit to all samples follow the distribution of noise.

    Args:
        problem: Problem with all samples.
        x: Solution, shape (p+s,).
        groups: Label of each sample's configuration, shape (m,).

    Returns:
        Whether the search for outliers is unnecessary; False also if the data are too few to tell.
    """
    starts = np.cumsum([0, *(len(item.rows) for item in problem.data)])
    n_rows = sum(
        item.residual_dim * len(np.unique(groups[a:b]))
        for item, (a, b) in zip(problem.data, pairwise(starts), strict=True)
    )
    if n_rows < MIN_ROWS_PER_UNKNOWN * len(x) or min(np.diff(starts)) < MIN_TESTED_SAMPLES:
        return False
    for item, residual in zip(problem.data, _residuals(problem, x), strict=True):
        for rows in item.residual_groups.values():
            k = np.arange(len(residual))[rows].size
            mean_squares = np.mean(residual[rows] ** 2, 0)
            t = standardize_ratios(mean_squares, k)
            if t.max() > OUTLIER_THRESHOLD or not is_chi_square(mean_squares, k):
                return False
    return True


def _residuals(problem: Problem, x: Array) -> Iterator[Array]:
    """Yield the whitened residuals of each measurement, shape (k, m) each."""
    chain = problem.errors.at(x[: len(problem.errors.parameters)])
    chunks = problem.map_chunks(partial(chunk_residual, chain, problem.instruments(x)))
    for item in problem.data:
        parts = [next(chunks) for _ in range(0, len(item.rows), CHUNK_SIZE)]
        yield np.concatenate([np.empty((item.residual_dim, 0)), *parts], 1)


def _judge(problem: Problem, x: Array, rows: _Rows, scales: Array, threshold: float) -> list[Array]:
    """Judge all samples by a solution that a part of them was searched for.

    Args:
        problem: Problem with all samples.
        x: Solution, shape (p+s,).
        rows: Rows of the part.
        scales: Noise scales of the classes, shape (c,).
        threshold: Largest standardized residual of good samples.

    Returns:
        Weights of each measurement's samples, shape (m,) each: 1 for good samples, ZERO_WEIGHT for others.
    """
    weights = []
    for residual, classes in zip(_residuals(problem, x), rows.row_classes, strict=True):
        residual = residual / scales[classes][:, None]
        t = standardize_ratios(np.mean(residual**2, 0), len(residual))
        weights.append(np.where(t > threshold, ZERO_WEIGHT, 1.0))
    return weights


def _independent_rows(rows: _Rows, groups: Array) -> int:
    """Count the rows that differ; repeated rows of a configuration add nothing to what a majority can tell.

    Args:
        rows: Linearized rows.
        groups: Label of each sample's configuration, shape (m,).

    Returns:
        Sum of the ranks of the rows of each configuration.
    """
    total, first = 0, 0
    for item in rows.items:
        labels = groups[first : first + item.shape[2]]
        first += item.shape[2]
        for label, count in zip(*np.unique(labels, return_counts=True), strict=True):
            k = item.shape[1]
            if count > 1:
                k = int(np.linalg.matrix_rank(item[:-1, :, labels == label].reshape(len(item) - 1, -1)))
            total += k
    return max(total, 1)


def _draw_samples(m: int) -> Array:
    """Draw at most MAX_SAMPLES of m samples, in ascending order."""
    if m <= MAX_SAMPLES:
        return np.arange(m)
    return np.sort(np.random.default_rng(0).permutation(m)[:MAX_SAMPLES])


def _linearized_rows(problem: Problem, x: Array, root: Array) -> _Rows:
    """Compute the rows of a problem at x in the coordinates of a square root of the covariance."""
    linearization = problem.linearize(x)
    chunks = iter(problem.chunks)
    u, first = root.shape[1], 0
    items, row_classes, blocks = [], [], []
    classes: dict[str, int] = {}
    for index, item in enumerate(problem.data):
        m = len(item.rows)
        parts = [linearization.rows(next(chunks)) for _ in range(0, m, CHUNK_SIZE)]
        raw = np.concatenate([np.empty((len(root) + 1, item.residual_dim, 0)), *parts], 2)
        rows = np.concatenate([np.tensordot(root, raw[:-1], (0, 0)), raw[-1:]])
        row_class = np.zeros(item.residual_dim, int)
        for name, group in item.residual_groups.items() if m else ():
            b, r = rows[:-1, group], rows[-1, group]
            label = _noise_class_name(index, item, name, r.size, u)
            row_class[group] = classes.setdefault(label, len(classes))
            blocks.append(
                (
                    np.einsum("ukm,vkm->muv", b, b, optimize=True).reshape(m, u * u),
                    np.einsum("ukm,km->mu", b, r),
                    np.sum(r**2, 0),
                    np.full(m, len(r)),
                    first + np.arange(m),
                    np.full(m, classes[label]),
                )
            )
        items.append(rows)
        row_classes.append(row_class)
        first += m
    gram, right, squares, counts, sample, noise_class = map(np.concatenate, zip(*blocks, strict=True))
    prior = problem.weights[:, None] * root
    return _Rows(
        tuple(items),
        tuple(row_classes),
        gram,
        right,
        squares,
        counts,
        sample,
        noise_class,
        np.bincount(noise_class, counts) > u,
        prior.T @ prior,
        -(prior.T @ (problem.weights * x)),
    )


def _noise_class_name(index: int, item: Measurement, group: str, n_rows: int, u: int) -> str:
    """Name the class of a residual group: its own, or that of its unit if it has few rows."""
    if item.has_stated_sigma:
        return "stated"
    if n_rows > 2 * u:
        return f"{index} {group}"
    return "angle" if group == "orientation" else "length"


def _search(rows: _Rows, groups: Array, n_determined: int) -> list[tuple[Array, Array]]:
    """Search fits of least trimmed squares.

    Args:
        rows: Linearized rows.
        groups: Label of each sample's configuration, shape (m,).
        n_determined: Number of directions that all samples determine.

    Returns:
        The best fits in their order: whether each sample is in the majority that agrees best, shape (m,), and
        noise scales of the classes, shape (c,).
    """
    weights = _random_subsets(rows, groups, n_determined)
    scales = np.ones((len(weights), len(rows.is_estimated)))
    objective = np.zeros(len(weights))
    for _ in range(N_FIRST_STEPS):
        scales, weights, objective = _concentrate(rows, weights, scales)
    best = np.argsort(objective, kind="stable")[:N_BEST]
    weights, scales = weights[best], scales[best]
    for _ in range(MAX_LAST_STEPS):
        previous = weights
        scales, weights, objective = _concentrate(rows, weights, scales)
        if np.array_equal(weights, previous):
            break
    return [(weights[i] > 0, scales[i]) for i in np.argsort(objective, kind="stable")]


def _concentrate(rows: _Rows, weights: Array, scales: Array) -> tuple[Array, Array, Array]:
    """Fit the weighted samples, then choose the majority with the smallest residuals.

    Returns:
        Noise scales (a, c), weights of the chosen samples (a, m) and objective (a,).
    """
    y = rows.solve(weights, scales)
    squares = rows.residual_squares(y)
    scales = rows.noise_scales(squares)
    distances = rows.distances(squares, scales)
    majority = rows.n_samples // 2 + 1
    chosen = np.argpartition(distances, majority - 1, axis=1)[:, :majority]
    is_chosen = np.zeros(weights.shape, bool)
    np.put_along_axis(is_chosen, chosen, True, 1)
    return scales, is_chosen.astype(float), rows.objective(squares, is_chosen)


def _random_subsets(rows: _Rows, groups: Array, n_determined: int) -> Array:
    """Draw the subsets that the search starts from.

    Every second subset consists of whole configurations, every other pair is half as large as needed to
    determine all unknowns: fewer samples are more often all good, and the priors supply what is missing. The
    first subset contains all samples.

    Returns:
        Weights of the samples, shape (a, m).
    """
    u, m = len(rows.prior_right), rows.n_samples
    work = len(rows.squares) * u * u
    n_starts = int(np.clip(MAX_MULTIPLICATIONS / work, MIN_STARTS, MAX_STARTS))
    rng = np.random.default_rng(0)
    size = min(m, int(np.ceil(n_determined * m / rows.counts.sum())) + 1)
    weights = np.zeros((n_starts, m))
    weights[0] = 1.0
    labels = np.unique(groups, return_inverse=True)[1]
    for i in range(1, n_starts):
        order = rng.permutation(m)
        if i % 2:
            # Samples in a random order of their configurations.
            order = order[np.argsort(rng.permutation(labels.max() + 1)[labels[order]], kind="stable")]
        weights[i, order[: size if i % 4 < 2 else -(-size // 2)]] = 1.0
    return weights


@dataclass(frozen=True, eq=False)
class _Core:
    """Fit of the samples that agree with each other.

    Attributes:
        y: Solution, shape (u,).
        scales: Noise scales of the classes, shape (c,).
        t: Standardized residuals of all samples, shape (m,).
        log_likelihood: Negative logarithm of the likelihood, see the module docstring.
    """

    y: Array
    scales: Array
    t: Array
    log_likelihood: float


def _best_core(rows: _Rows, fits: Sequence[tuple[Array, Array]], redundancy: float) -> _Core | None:
    """Extend the samples of several fits and choose the most likely ones.

    Args:
        rows: Linearized rows.
        fits: Result of `_search`.
        redundancy: Number of rows per independent row.

    Returns:
        The most likely extension; None if it is likelier that all samples are good.
    """
    everything = np.ones(rows.n_samples, bool)
    scales = rows.noise_scales(rows.residual_squares(rows.solve(everything[None] * 1.0, fits[0][1][None])))[0]
    cores: list[_Core] = []
    for is_good, noise in fits:
        # A majority of samples that are good already leads to the same ones.
        if not any((core.t[is_good] <= STRICT_THRESHOLD).all() for core in cores):
            cores.append(_extend(rows, is_good, noise, redundancy))
    best = min(cores, key=lambda core: core.log_likelihood)
    has_outlier = (best.t > OUTLIER_THRESHOLD).any()
    is_likely = best.log_likelihood < _log_likelihood(rows, everything, scales, redundancy)
    return best if has_outlier and is_likely else None


def _extend(rows: _Rows, is_good: Array, scales: Array, redundancy: float) -> _Core:
    """Extend the samples of a fit by all with small residuals, until they do not change.

    The threshold is strict: a small outlier that is included too early would pull the fit towards itself and
    stay.

    Args:
        rows: Linearized rows.
        is_good: The majority that agrees best, shape (m,).
        scales: Noise scales of the classes, shape (c,).
        redundancy: Number of rows per independent row.

    Returns:
        Fit of the extended samples.
    """
    y, t = np.zeros(0), np.zeros(0)
    for _ in range(MAX_EXTENSIONS):
        weights = is_good[None].astype(float)
        y = rows.solve(weights, scales[None])[0]
        scales = rows.noise_scales(rows.residual_squares(y[None]), is_good[None])[0]
        covariance = np.linalg.inv(rows.total_information(weights, scales[None])[0])
        t = _standardized(rows, y, scales, is_good, covariance)
        previous, is_good = is_good, t <= STRICT_THRESHOLD
        if np.array_equal(previous, is_good):
            break
    return _Core(y, scales, t, _log_likelihood(rows, t <= REJECTION_THRESHOLD, scales, redundancy))


def _log_likelihood(rows: _Rows, is_good: Array, scales: Array, redundancy: float) -> float:
    """Compute the negative logarithm of the likelihood of a choice of good samples, see the module docstring.

    Args:
        rows: Linearized rows.
        is_good: Whether each sample is good, shape (m,).
        scales: Noise scales of the classes, shape (c,).
        redundancy: Number of rows per independent row.

    Returns:
        The negative logarithm; infinite if the good samples have no more rows than unknowns.
    """
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
    """Return the logarithm of the number of ways to choose the good ones of m samples.

    The best of many choices fits better than a single one by chance.
    """
    return math.lgamma(m + 1) - math.lgamma(n_good + 1) - math.lgamma(m - n_good + 1)


def _standardized(rows: _Rows, y: Array, scales: Array, is_fitted: Array, covariance: Array) -> Array:
    """Compute standardized residuals that are corrected for leverage, see `robust.residual_covariances`.

    Args:
        rows: Linearized rows.
        y: Solution, shape (u,).
        scales: Noise scales of the classes, shape (c,).
        is_fitted: Whether each sample was fitted and counts for the noise scale, shape (m,).
        covariance: Covariance of y, shape (u, u).

    Returns:
        Standardized residuals, shape (m,).
    """
    out, first = [], 0
    for item, classes in zip(rows.items, rows.row_classes, strict=True):
        k, m = item.shape[1:]
        fitted = is_fitted[first : first + m]
        scaled = item / scales[classes][:, None]
        b, residual = scaled[:-1], scaled[-1] - np.tensordot(y, scaled[:-1], (0, 0))
        leverages = np.einsum("ukm,ulm->mkl", b, np.tensordot(covariance, b, 1), optimize=True)
        sign = np.where(fitted, -1.0, 1.0)[:, None, None]
        out.append(standardized_residuals(residual, np.eye(k) + sign * leverages, fitted))
        first += m
    return np.concatenate(out)
