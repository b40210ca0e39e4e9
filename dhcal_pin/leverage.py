"""How far each sample draws the fit to itself: few readings leave less of an error than it is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from . import observability, robust
from .measurements import Measurement
from .problem import CHUNK, Chunk, Problem, Tangent, reduce, residual_of
from .se3 import Array
from .solver import Solution, posterior_root

# Where a row takes so small a share of the unknowns, what it draws to itself does not matter.
SMALL = 0.01


def scores(
    problem: Problem, solution: Solution, data: Sequence[Measurement], weights: Sequence[Array]
) -> list[Array]:
    """How far each sample (m,) of each item lies from its kind's scatter; see `robust.scores`.

    Zero where no reading is left over: then the scatter tells nothing.

    Args:
        problem: as it was fitted.
        solution: where that ended.
        data: the fitted measurements with the sigmas of good samples.
        weights: (m,) of each item's samples in the fit.
    """
    rows = sum(np.count_nonzero(w > 0.5) * item.size for item, w in zip(data, weights, strict=True))
    most = len(solution.x)
    if rows <= most and rows <= observability.rank(solution.triangle.r):
        return [np.zeros(len(item.rows)) for item in data]
    chain = problem.errors.at(solution.x[: len(problem.errors.parameters)])
    found = problem.of(data).each(partial(residual_of, chain, problem.instruments(solution.x)))
    residuals = [np.concatenate([np.empty((item.size, 0)), *_parts(found, item)], 1) for item in data]
    spread = spreads(problem, solution, weights) if most >= SMALL * rows else [None] * len(data)
    return [robust.scores(*both) for both in zip(residuals, spread, strict=True)]


def _parts(found: Iterator[Array], item: Measurement) -> Iterator[Array]:
    """What was found in the chunks of one item."""
    for _ in range(0, len(item.rows), CHUNK):
        yield next(found)


def spreads(problem: Problem, solution: Solution, weights: Sequence[Array]) -> list[Array]:
    """Covariances (m, k, k) of each item's whitened residuals in a fit of good readings.

    A sample that takes part lies nearer to the fit than its sigma, by what it draws the fit to itself; one
    that counts for nothing lies farther, by how little the others know there.
    """
    # The loop's last triangle is of a step before, where other directions are unseen, which the wide priors
    # of frames and instruments make far of: its covariance would not go with these rows.
    root = posterior_root(reduce(problem, solution.x, small_angle=False), problem.weights)[0]
    found = problem.each(partial(_drawn, problem.tangent(solution.x), root))
    out = []
    for item, weight in zip(problem.data, weights, strict=True):
        parts = [np.empty((0, item.size, item.size)), *_parts(found, item)]
        w = weight[:, None, None]
        out.append(np.eye(item.size) + (1 - 2 * w) * np.concatenate(parts) / w)
    return out


def _drawn(tangent: Tangent, root: Array, chunk: Chunk) -> Array:
    """What is not known of a chunk's whitened readings: covariances (m, k, k)."""
    known = np.tensordot(root, tangent.rows(chunk)[:-1], (0, 0))
    return np.einsum("rim,rjm->mij", known, known)
