"""From a nominal chain and measurements to a calibrated one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._typing import Array
from ..estimation import qr
from ..estimation.problem import Problem
from ..estimation.solver import Solution
from ..measurements.base import Measurement

# Sigmas are not estimated below a nanometre and a nanoradian.
LEAST_SCALE = 1e-6


MOST_ROUNDS = 30


def estimate_variance_components(
    problem: Problem, solution: Solution, data: tuple[Measurement, ...], weights: Sequence[Array]
) -> Array:
    """How many of its sigmas each group of rows scatters in the fit, all items' groups in a row (g,).

    One where the instrument states its sigmas, or where there are not more rows than directions seen. A
    group of no more rows than that could be met exactly, whatever it reads, and tells no scatter of its
    own: it takes the one of all rows of its unit, and where the others are stated that of a placeholder.
    """
    if all(item.stated for item in data):
        return np.ones(sum(len(item.groups) for item in data))
    chain = problem.errors.at(solution.x[: len(problem.errors.parameters)])
    residuals = [
        item.residual(chain.sweep(item.configurations()), problem.values(item, solution.x)) for item in data
    ]
    counts = [w.sum() for w in weights]
    seen = qr.rank(solution.triangle.r)
    share = 1 - seen / sum(len(r) * count for r, count in zip(residuals, counts, strict=True))
    # Of each group: whether it is of angles, whether it is stated, its rows, and the sum of their squares.
    groups = [
        (name == "orientation", item.stated, len(r[rows]) * count, np.sum(r[rows] ** 2 * w))
        for item, r, w, count in zip(data, residuals, weights, counts, strict=True)
        for name, rows in item.groups.items()
    ]
    out = np.ones(len(groups))
    for i, (angle, stated, rows, squares) in enumerate(groups if share > 0 else ()):
        alike = [group for group in groups if group[0] == angle]
        pooled = [group for group in alike if not group[1]]
        if rows <= seen and len(alike) > 1:
            rows, squares = (sum(group[k] for group in pooled) for k in (2, 3))
            stated = stated or len(pooled) == 1
        if not stated:
            out[i] = max(float(np.sqrt(squares / (rows * share))), LEAST_SCALE)
    return out


def with_sigma_scales(data: tuple[Measurement, ...], scales: Array) -> tuple[Measurement, ...]:
    """Scale the standard deviations of each group of rows."""
    if np.all(scales == 1):
        return data
    left = iter(scales.tolist())
    return tuple(item.scaled({name: next(left) for name in item.groups}) for item in data)
