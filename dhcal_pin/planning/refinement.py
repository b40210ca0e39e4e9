"""Chosen configurations moved to better ones about them, which no list of candidates holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..robot.sampling import ConfigurationSampler, scale_joint_units
from .criteria import Criterion
from .exchange import CandidateSet, sqrt_covariance
from .information import Information

# Refinement: rounds, each with so many neighbours a pose, nearer from round to round.
ROUNDS, NEIGHBOURS, STEP, SHRINK = 8, 24, 0.15, 0.65


@dataclass(frozen=True, eq=False)
class DesignGoal:
    """What is known before, with what a fit will leave out, too, and what is to be known.

    How much of it can be seen at all; places to keep away from; where the robot may stand.
    """

    information: Information
    full_information: Information
    criterion: Criterion
    task: Array
    n_observable: int
    existing: Array
    sampler: ConfigurationSampler | None


def refine(
    aim: DesignGoal, q: Array, sampler: ConfigurationSampler, min_distance: float, rng: np.random.Generator
) -> Array:
    """The configurations (n, dof) moved to better ones about them, by smaller and smaller steps."""
    information, criterion = aim.full_information, aim.criterion
    q = q.copy()
    rows = np.ascontiguousarray(information.rows(q).transpose(2, 1, 0))
    value = criterion.value(sqrt_covariance(information.prior_factor, rows))
    for turn in range(ROUNDS):
        near = sampler.perturb(q, STEP * SHRINK**turn, NEIGHBOURS, rng)
        possible = lambda i, near=near: sampler.is_feasible(near[i])  # noqa: E731
        pool = CandidateSet.from_rows(
            information.rows(near), scale_joint_units(sampler.chain, near), min_distance, possible
        )
        pool.infeasible[:] = ~sampler.workspace.contains(sampler.chain.poses(near))
        for slot in range(len(q)):
            block = np.arange(slot * NEIGHBOURS, (slot + 1) * NEIGHBOURS)
            rest = sqrt_covariance(information.prior_factor, np.delete(rows, slot, 0))
            here = np.concatenate([pool.rows[:, :, block], rows[slot].T[:, :, None]], 2)
            gains = criterion.gains(here, rest)
            better = np.where(gains[:-1] > gains[-1], gains[:-1], -np.inf)
            others = np.concatenate([aim.existing, scale_joint_units(sampler.chain, np.delete(q, slot, 0))])
            found = pool.best(better, block, others)
            if found is None:
                continue
            trial = rows.copy()
            trial[slot] = pool.rows[:, :, found].T
            reached = criterion.value(sqrt_covariance(information.prior_factor, trial))
            if reached < value:
                rows, value, q[slot] = trial, reached, near[found]
    return q
