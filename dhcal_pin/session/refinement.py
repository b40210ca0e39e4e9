"""Refinement of changes during a session by further measurements of the same robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._typing import Array
from ..estimation.problem import Problem
from ..estimation.robust import MAD_TO_STD
from .facts import Session
from .linear_model import Layout, inverse, solve_information, whitened_rows
from .robot_changes import apply_changes, update
from .search import HUBER_LIMIT, MIN_NOISE

# Number of Gauss-Newton steps.
N_STEPS = 4


def refine_changes(session: Session, problem: Problem, x: Array) -> Session:
    """Fit the changes of a session together with the unknowns x (p,) of a problem with its samples."""
    layout, timeline, chain = Layout.of(problem), session.timeline, session.chain
    fitted = timeline.with_fitted(problem.data)
    numbers, times = timeline.fitted_numbers, timeline.fitted_times
    # The columns of the causes are those of the measurements in which they were found.
    causes = tuple(replace(cause, block=layout.block_like(cause.block)) for cause in session.causes)
    changes = session.changes
    # The priors of the problem; those of the search are wide, for arms with large errors.
    prior = np.concatenate([np.fmax(problem.weights, layout.weights), *(1 / c.sizes for c in causes)])
    ends = np.cumsum([len(x), *(len(cause.values) for cause in causes)])
    information = np.diag(prior**2)
    for _ in range(N_STEPS):
        data, _ = apply_changes(changes, chain, fitted, None)
        rows = whitened_rows(layout, x, data, np.zeros((len(numbers), chain.n_joints)))
        columns = [rows[..., layout.model], *(cause.columns_of(rows, numbers, times) for cause in causes)]
        jacobian, residual = np.concatenate(columns, -1), rows[..., -1]
        size = np.sqrt(np.mean(residual**2, 1))
        noise = max(MAD_TO_STD * float(np.median(np.abs(residual))), MIN_NOISE)
        weights = np.minimum(1.0, HUBER_LIMIT * noise / np.fmax(size, 1e-300))[:, None, None]
        flat = (jacobian * np.sqrt(weights)).reshape(-1, len(prior)) / noise
        right = (residual[..., None] * np.sqrt(weights)).ravel() / noise
        information = flat.T @ flat + np.diag(prior**2)
        pull = prior**2 * np.append(x, np.zeros(len(prior) - len(x)))
        step = solve_information(information, flat.T @ right - pull)
        x, steps = x + step[: len(x)], np.split(step[len(x) :], ends[1:-1] - len(x))
        causes = tuple(
            replace(cause, values=cause.values + change) for cause, change in zip(causes, steps, strict=True)
        )
        changes = update(changes, causes, steps, chain.base, layout.links)
    covariance = inverse(information)
    causes = tuple(
        replace(cause, covariance=covariance[a:b, a:b])
        for cause, a, b in zip(causes, ends[:-1], ends[1:], strict=True)
    )
    return replace(session, causes=causes, changes=changes).described()
