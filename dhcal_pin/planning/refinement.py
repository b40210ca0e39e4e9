"""Refinement: move selected configurations to better ones nearby that no list of candidates contains.

Random local search: in each round, every configuration gets random neighbours, and the best feasible one
replaces it if that lowers the criterion. The neighbourhood shrinks from round to round.
"""

from __future__ import annotations

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..robot.sampling import ConfigurationSampler, scale_joint_units
from .bin_filling import filling_cost, filling_gains
from .criteria import Criterion
from .exchange import CandidateSet, compute_sqrt_covariance
from .information import Information
from .task_error import TaskError

# Number of rounds.
N_ROUNDS = 8
# Random neighbours per configuration and round.
N_NEIGHBOURS = 24
# Size of the first round's neighbourhood, as a fraction of the joint range, and its factor per round.
STEP, SHRINK_FACTOR = 0.15, 0.65


@frozen(eq=False)
class DesignGoal:
    """Knowledge before the measurements, and what to optimize."""

    expected: TaskError  # Error to expect over the task after the calibration
    ranking: TaskError  # Error by which plans are compared; it takes corners of boards as exact
    full_information: Information  # Knowledge of `ranking`, and about the unknowns that the fit omits
    criterion: Criterion  # Optimality criterion on all unknowns
    n_observable: int  # Number of directions that measurements observe
    existing: Array  # Coordinates of existing measurements, shape (n, d)
    sampler: ConfigurationSampler | None  # Feasible configurations; None if the candidates are given
    bin_columns: Array  # Joints whose bins are filled evenly before the criterion decides, shape (j,)


@frozen(eq=False)
class Selection:
    """Poses that the search has found for a goal."""

    candidates: CandidateSet  # Candidates to choose from
    q: Array  # Their joint positions, shape (m, n) [rad or m]
    greedy: Array  # Indices of the greedy selection in its order, shape (c,)
    selected: Array  # Indices of the selection after exchange, shape (c,)
    refined: Array  # Joint positions after refinement, shape (c, n) [rad or m]


def refine(
    goal: DesignGoal, q: Array, sampler: ConfigurationSampler, min_distance: float, rng: np.random.Generator
) -> Array:
    """Move configurations to better ones nearby, with decreasing steps."""
    information, criterion = goal.full_information, goal.criterion
    prior_factor, columns = information.prior_factor, goal.bin_columns
    q = q.copy()
    rows = np.ascontiguousarray(information.rows(q).transpose(2, 1, 0))

    def design_value(rows: Array, occupied: Array) -> float:
        return criterion.value(compute_sqrt_covariance(prior_factor, rows)) + filling_cost(
            occupied[:, columns]
        )

    present = scale_joint_units(sampler.chain, q)
    value = design_value(rows, np.concatenate([goal.existing, present]))
    for round_number in range(N_ROUNDS):
        nearby = sampler.perturb(q, STEP * SHRINK_FACTOR**round_number, N_NEIGHBOURS, rng)
        is_feasible = lambda i, nearby=nearby: sampler.is_feasible(nearby[i])  # noqa: E731
        candidates = CandidateSet(
            information.rows(nearby), scale_joint_units(sampler.chain, nearby), min_distance, is_feasible
        )
        candidates.infeasible[:] = ~sampler.in_workspace(nearby)
        for slot in range(len(q)):
            block = np.arange(slot * N_NEIGHBOURS, (slot + 1) * N_NEIGHBOURS)
            rest = compute_sqrt_covariance(prior_factor, np.delete(rows, slot, 0))
            block_rows = np.concatenate([candidates.rows[:, :, block], rows[slot].T[:, :, None]], 2)
            others = np.concatenate([goal.existing, np.delete(present, slot, 0)])
            block_coordinates = np.concatenate([candidates.coordinates[block], present[slot : slot + 1]])
            gains = criterion.gains(block_rows, rest)
            gains += filling_gains(block_coordinates[:, columns], others[:, columns])
            # The last gain is that of the present configuration.
            better = np.where(gains[:-1] > gains[-1], gains[:-1], -np.inf)
            best = candidates.best_candidate(better, block, others)
            if best is None:
                continue
            trial = rows.copy()
            trial[slot] = candidates.rows[:, :, best].T
            trial_value = design_value(
                trial, np.concatenate([others, candidates.coordinates[best : best + 1]])
            )
            if trial_value < value:
                rows, value, q[slot] = trial, trial_value, nearby[best]
                present[slot] = candidates.coordinates[best]
    return q
