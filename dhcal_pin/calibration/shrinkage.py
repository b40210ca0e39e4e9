"""How much of a correction few readings warrant: no more than will hardly leave the arm worse than nominal.

Few readings are met by many arms. Which of them is likely is a matter of how large errors are expected to be,
and that is known only roughly. So the chance that a fit moves the tool away from where it is gets taken over
all widths of the priors, each as far as the readings speak for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..estimation.problem import Problem
from ..estimation.qr import RANK_RTOL, TriangularSystem, rank
from ..estimation.solver import SolverResult
from ..robot.chain import BASE_FRAME

# The greatest chance of an arm that is worse than nominal.
MAX_HARM_PROBABILITY = 0.002


# Widths of the priors, as multiples of the usual ones, and the standard deviation of their logarithm.
PRIOR_WIDTHS, LOG_WIDTH_STD = 2.0 ** np.arange(-4, 5), 1.5


# Configurations where the tool is judged.
N_CONFIGURATIONS = 32


# Readings are taken for no better than this share of the largest that an error could make of them.
NOISE_FLOOR = 1e-6


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What readings say of errors in f groups, each of a width of its own, along one change of the tool.

    Attributes:
        covariances: (f, r, r) variances of the whitened readings that each group makes at its usual width.
        cross_covariance: (f, r) covariances of the readings with the errors' effect along the change.
        effect_variances: (f,) variances of that effect.
        readings: (r,) the readings.
    """

    covariances: Array
    cross_covariance: Array
    effect_variances: Array
    readings: Array

    def at(self, widths: Array) -> tuple[Array, Array, Array]:
        """Logarithm of the evidence, mean and standard deviation of the effect (w,) by widths (w, f)."""
        square = widths**2
        spread = np.tensordot(square, self.covariances, 1) + np.eye(len(self.readings))
        root = np.linalg.cholesky(spread)
        sides = np.stack(
            [
                np.broadcast_to(self.readings, (len(widths), len(self.readings))),
                square @ self.cross_covariance,
            ],
            2,
        )
        read, both = np.moveaxis(np.linalg.solve(root, sides), 2, 0)
        log = -np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1) - 0.5 * np.sum(read**2, 1)
        variance = square @ self.effect_variances - np.sum(both**2, 1)
        return log, np.sum(read * both, 1), np.sqrt(np.maximum(variance, np.finfo(float).tiny))


def _eliminate(
    triangle: TriangularSystem, x: Array, inside: Array, others: Array
) -> tuple[Array, Array, Array]:
    """How `others` follow what is `inside` (o, i), and the rows (r, i) and readings (r,) left of it."""
    read = triangle.z + triangle.r @ x
    u, s, vt = np.linalg.svd(triangle.r[:, others], full_matrices=False)
    seen = s > RANK_RTOL * s.max(initial=0.0)
    u, s, vt, rows = u[:, seen], s[seen], vt[seen], triangle.r[:, inside]
    return -vt.T @ ((u.T @ rows) / s[:, None]), rows - u @ (u.T @ rows), read - u @ (u.T @ read)


def compute_shrinkage_factor(
    problem: Problem, solution: SolverResult, families: Sequence[tuple[Sequence[int], float]]
) -> float:
    """The share of a solution's x, 0 to 1, to keep; the rest of the way leads back to the nominal arm.

    It is 1 where readings are left over, whose residuals show what the arm is worth. The tool is judged all
    over the joints' range, with base and tool following the errors as the readings have it.

    Args:
        problem: as it was fitted; its base and tool start where they fit the nominal arm.
        solution: its end.
        families: errors of the robot whose size nobody knows well, and one over their usual prior's sigma.
    """
    errors, x = problem.errors, solution.x
    readings = sum(len(item.rows) * item.residual_dim for item in problem.data)
    if readings > len(x) or readings > rank(solution.system.r) or not families:
        return 1.0
    robot, frames = len(errors.parameters), (BASE_FRAME, errors.chain.tool_frame_index)
    inside = np.array([i for i, p in enumerate(errors.parameters) if p.error_frame not in frames], int)
    if not x[inside].any():
        return 1.0
    from ..robot.sampling import (
        joint_range,  # a good part of the start-up, and few fits need it
    )

    follow, rows, read = _eliminate(solution.system, x, inside, np.setdiff1d(np.arange(len(x)), inside))
    chain, bodies, twists = errors.derivative(x[:robot])
    q = np.random.default_rng(0).uniform(*joint_range(chain), (N_CONFIGURATIONS, chain.n_joints))
    moved = np.zeros((3 * N_CONFIGURATIONS, len(x)))
    moved[:, :robot] = (
        chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)[:, :3].reshape(robot, -1).T
    )
    moved = moved[:, inside] + np.delete(moved, inside, 1) @ follow
    change = moved @ x[inside]
    # What has no width to look for, as a stated prior or a joint's own errors, keeps the one it has.
    sigma, groups = 1 / problem.weights[inside], []
    for members, usual in families:
        if errors.parameters[members[0]].coefficient_index is None:
            groups.append(np.isin(inside, members))
            sigma[groups[-1]] = 1 / usual
    widths = np.array([[*some, 1.0] for some in itertools.product(PRIOR_WIDTHS, repeat=len(groups))])
    groups.append(~np.any(groups, 0))
    rows, effect = rows * sigma, moved.T @ change * sigma
    noise = max(1.0, NOISE_FLOOR * float(np.abs(rows).max()) * PRIOR_WIDTHS.max())
    rows, read = rows / noise, read / noise
    log, mean, std = _Evidence(
        np.stack([rows[:, group] @ rows[:, group].T for group in groups]),
        np.stack([rows[:, group] @ effect[group] for group in groups]),
        np.array([np.sum(effect[group] ** 2) for group in groups]),
        read,
    ).at(widths)
    log -= 0.5 * np.sum((np.log(widths) / LOG_WIDTH_STD) ** 2, 1)
    likely = np.exp(log - log.max())
    return _largest_safe_factor(mean, std, likely / likely.sum(), float(change @ change))


def _largest_safe_factor(mean: Array, std: Array, likely: Array, size: float) -> float:
    """The largest share with a small enough chance of harm, zero if there is none.

    A share c of a change of the tool d leaves it worse than without where c·|d|² > 2·d·e, e the true one.

    Args:
        mean: (w,) of d·e, by widths.
        std: (w,) of d·e, by widths.
        likely: (w,) how likely those are.
        size: |d|².
    """
    from scipy.special import ndtr  # a good part of the start-up, and few fits need it

    shares = np.linspace(1, 0, 101)
    chance = ndtr((0.5 * shares[:, None] * size - mean) / std) @ likely
    good = np.flatnonzero(chance <= MAX_HARM_PROBABILITY)
    return float(shares[good[0]]) if good.size else 0.0
