"""Search of a majority of samples that agree with each other, on linearized rows.

Least trimmed squares (Rousseeuw 1984) finds the fit that is best for the h samples with the smallest
residuals, h being a majority:

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

Some unknowns concern a part of the samples only, such as the coordinates of a touched point or the pose of a
camera. The samples with the same unknowns of an instrument are a stratum. Subsets and majorities contain from
each stratum at least as many samples as determine these unknowns, and one more. Otherwise a majority could
leave out a whole stratum, whose samples nothing could judge.

Shapes: m samples of k residuals each, b blocks (one per sample and residual group), c classes, g strata, u
coordinates y, a fits.

References:
    P. J. Rousseeuw, Least Median of Squares Regression, JASA 79, 1984.
    P. J. Rousseeuw and K. Van Driessen, Computing LTS Regression for Large Data Sets, DMKD 12, 2006.
"""

from __future__ import annotations

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...measurements.base import Measurement
from ..problem import CHUNK_SIZE, Problem

# Largest and smallest number of random subsets, and the multiplications per concentration step of all.
MAX_STARTS, MIN_STARTS, MAX_MULTIPLICATIONS = 600, 60, 3e7
# Number of concentration steps of all fits, and largest number of those of the best fits.
N_FIRST_STEPS, MAX_LAST_STEPS = 2, 20
# Number of fits that are iterated until their samples do not change.
N_BEST = 8
# Least information of a direction that neither a subset nor the priors determine; all data have 1.
MIN_INFORMATION = 1e-9
# Smallest noise scale relative to that of the fit to all samples; exact data have none.
MIN_SCALE = 1e-6


@frozen(eq=False)
class LinearizedRows:
    """Linearized rows in coordinates y."""

    items: tuple[Array, ...]  # Rows [B | r] of each measurement, shape (u+1, k, m) each
    row_classes: tuple[Array, ...]  # Class of each residual of each measurement, shape (k,) each
    gram: Array  # Products BᵀB of each block, shape (b, u·u)
    right: Array  # Products Bᵀr of each block, shape (b, u)
    groups: tuple[tuple[slice, ...], ...]  # Residuals of each measurement that make a block of each sample
    counts: Array  # Number of rows of each block, shape (b,)
    sample: Array  # Sample of each block, shape (b,)
    noise_class: Array  # Class of each block, shape (b,); all numbers from 0 to c-1 occur
    # Whether the noise scale of each class can be estimated, shape (c,); otherwise it is 1.
    is_estimated: Array
    information: Array  # Information of the priors, shape (u, u)
    prior_right: Array  # Right-hand side of the priors, shape (u,)
    # Samples of each stratum and the smallest number of them in a fit, g pairs.
    strata: tuple[tuple[Array, int], ...]

    @property
    def n_samples(self) -> int:
        """Number m of samples."""
        return int(self.sample.max()) + 1

    @property
    def n_determined(self) -> float:
        """Effective number of coordinates that all data determine; the priors determine the others."""
        return len(self.prior_right) - float(np.trace(self.information))

    def solve(self, weights: Array, scales: Array) -> Array:
        """Fit samples with weights (a, m) and noise scales of the classes (a, c); return solutions (a, u)."""
        information = self.total_information(weights, scales)
        right = (weights[:, self.sample] / scales[:, self.noise_class] ** 2) @ self.right + self.prior_right
        try:
            return np.linalg.solve(information, right[..., None])[..., 0]
        except np.linalg.LinAlgError:
            # Rounding makes the information of samples that contradict each other singular.
            return (np.linalg.pinv(information, hermitian=True) @ right[..., None])[..., 0]

    def total_information(self, weights: Array, scales: Array) -> Array:
        """Compute the information (a, u, u) of priors and samples with weights (a, m) and scales (a, c)."""
        u = len(self.prior_right)
        block_weights = weights[:, self.sample] / scales[:, self.noise_class] ** 2
        information = (block_weights @ self.gram).reshape(-1, u, u) + self.information
        return information + MIN_INFORMATION * np.eye(u)

    def residual_squares(self, y: Array) -> Array:
        """Compute the sum of squared residuals of each block."""
        out = []
        for item, groups in zip(self.items, self.groups, strict=True):
            residual = item[-1].ravel() - y @ item[:-1].reshape(y.shape[1], -1)
            squares = residual.reshape(len(y), *item.shape[1:]) ** 2
            out += [squares[:, group].sum(1) for group in groups]
        return np.concatenate(out, 1)

    def noise_scales(self, squares: Array, inliers: Array | None = None) -> Array:
        """Estimate the noise scale (a, c) of each class by the median of the squares (a, b) of its blocks."""
        scales = np.ones((len(squares), len(self.is_estimated)))
        for i in np.flatnonzero(self.is_estimated):
            members = self.noise_class == i
            counts = self.counts[members]
            # The median of χ²_k/k is about (1 - 2/(9k))³.
            mean_squares = squares[:, members] / (counts * (1 - 2 / (9 * counts)) ** 3)
            if inliers is not None:
                is_counted = inliers[:, self.sample[members]]
                is_counted |= ~np.any(is_counted, 1, keepdims=True)
                mean_squares = np.where(is_counted, mean_squares, np.nan)
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
        """Compute the objective (a,) from squares (a, b) of blocks and chosen samples (a, m)."""
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


def linearize_rows(problem: Problem, x: Array, root: Array) -> LinearizedRows:
    """Compute the rows of a problem in the coordinates of a square root of the covariance."""
    linearization = problem.linearize(x)
    chunks = iter(problem.chunks)
    u, first = root.shape[1], 0
    items, row_classes, blocks, strata = [], [], [], []
    n_robot = len(problem.errors.parameters)
    classes: dict[str, int] = {}
    for index, item in enumerate(problem.data):
        m = len(item.rows)
        parts = [linearization.rows(next(chunks)) for _ in range(0, m, CHUNK_SIZE)]
        raw = np.concatenate([np.empty((len(root) + 1, item.residual_dim, 0)), *parts], 2)
        rows = np.concatenate([np.tensordot(root, raw[:-1], (0, 0)), raw[-1:]])
        strata += _strata(np.any(raw[n_robot:-1] != 0, 1), item.residual_dim, first)
        row_class = np.zeros(item.residual_dim, int)
        for name, group in item.residual_groups.items() if m else ():
            b, r = rows[:-1, group.rows], rows[-1, group.rows]
            label = _noise_class_name(index, item, name, r.size, u)
            row_class[group.rows] = classes.setdefault(label, len(classes))
            blocks.append(
                (
                    np.einsum("ukm,vkm->muv", b, b, optimize=True).reshape(m, u * u),
                    np.einsum("ukm,km->mu", b, r),
                    np.full(m, len(r)),
                    first + np.arange(m),
                    np.full(m, classes[label]),
                )
            )
        items.append(rows)
        row_classes.append(row_class)
        first += m
    gram, right, counts, sample, noise_class = map(np.concatenate, zip(*blocks, strict=True))
    prior = problem.weights[:, None] * root
    return LinearizedRows(
        tuple(items),
        tuple(row_classes),
        gram,
        right,
        tuple(
            tuple(group.rows for group in item.residual_groups.values()) if len(item.rows) else ()
            for item in problem.data
        ),
        counts,
        sample,
        noise_class,
        np.bincount(noise_class, counts) > u,
        prior.T @ prior,
        -(prior.T @ (problem.weights * x)),
        tuple(strata),
    )


def _strata(depends: Array, k: int, first: int) -> list[tuple[Array, int]]:
    """Divide the samples of a measurement by the instrument parameters that they depend on."""
    out: list[tuple[Array, int]] = []
    patterns, labels = np.unique(depends, axis=1, return_inverse=True)
    for i, pattern in enumerate(patterns.T if len(patterns) else ()):
        n_own = int(np.sum(pattern & (patterns.sum(1) == 1)))
        samples = np.flatnonzero(labels.reshape(-1) == i)
        if n_own:
            out.append((first + samples, min(-(-n_own // k) + 1, len(samples) // 2 + 1)))
    return out


def _noise_class_name(index: int, item: Measurement, group: str, n_rows: int, u: int) -> str:
    """Name the class of a residual group: its own, or that of its unit if it has few rows."""
    if item.has_stated_sigma:
        return "stated"
    if n_rows > 2 * u:
        return f"{index} {group}"
    return item.residual_groups[group].unit


def search_majorities(
    rows: LinearizedRows, groups: Array, n_determined: int, n_best: int = N_BEST
) -> list[tuple[Array, Array]]:
    """Search fits of least trimmed squares; return the n_best, each a mask of samples and noise scales."""
    weights = _random_subsets(rows, groups, n_determined)
    scales = np.ones((len(weights), len(rows.is_estimated)))
    objective = np.zeros(len(weights))
    for _ in range(N_FIRST_STEPS):
        scales, weights, objective = _concentrate(rows, weights, scales)
    best = np.argsort(objective, kind="stable")[:n_best]
    weights, scales = weights[best], scales[best]
    for _ in range(MAX_LAST_STEPS):
        previous = weights
        scales, weights, objective = _concentrate(rows, weights, scales)
        if np.array_equal(weights, previous):
            break
    return [(weights[i] > 0, scales[i]) for i in np.argsort(objective, kind="stable")]


def _concentrate(rows: LinearizedRows, weights: Array, scales: Array) -> tuple[Array, Array, Array]:
    """Fit the weighted samples, then choose the majority with the smallest residuals."""
    y = rows.solve(weights, scales)
    squares = rows.residual_squares(y)
    scales = rows.noise_scales(squares)
    distances = rows.distances(squares, scales)
    majority = rows.n_samples // 2 + 1
    chosen = np.argpartition(distances, majority - 1, axis=1)[:, :majority]
    is_chosen = np.zeros(weights.shape, bool)
    np.put_along_axis(is_chosen, chosen, True, 1)
    for samples, least in rows.strata:
        nearest = np.argpartition(distances[:, samples], least - 1, axis=1)[:, :least]
        np.put_along_axis(is_chosen, samples[nearest], True, 1)
    return scales, is_chosen.astype(float), rows.objective(squares, is_chosen)


def _random_subsets(rows: LinearizedRows, groups: Array, n_determined: int) -> Array:
    """Draw the subsets that the search starts from, the first of all samples."""
    # Every second subset consists of whole configurations, every other pair is half as large as needed to
    # determine all unknowns: fewer samples are more often all good, and the priors supply what is missing.
    # Each stratum has its smallest number of samples.
    u, m = len(rows.prior_right), rows.n_samples
    work = len(rows.counts) * u * u
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
        for samples, least in rows.strata:
            n_missing = least - int(weights[i, samples].sum())
            if n_missing > 0:
                others = samples[weights[i, samples] == 0]
                weights[i, rng.permutation(others)[:n_missing]] = 1.0
    return weights
