"""Predicted error over the number of poses: of smaller and larger plans, and of random poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._typing import Array
from ..estimation import qr
from ..robot.sampling import scale_joint_units
from ..subsampling import evenly_spaced_indices
from . import exchange
from .refinement import DesignGoal, Selection, refine

# Random plans per number of poses, numbers of poses, and smallest number of poses that they are drawn from.
N_RANDOM_PLANS, N_RANDOM_SIZES, MIN_RANDOM_POSES = 200, 6, 600
# Diminishing returns: this many more poses lower the error that a check shows by less than this fraction.
EXTRA_POSES, MIN_EXTRA_GAIN = 10, 0.01
# A measurement of one configuration says at most as much about the geometry as the pose of the tool.
MAX_POSE_COMPONENTS = 6
# Numbers of poses for which the knowledge of the joint correction curves is predicted.
CURVE_SIZES = (50, 100, 200)


def error_curve(goal: DesignGoal, found: Selection, rng: np.random.Generator) -> tuple[Array, Array]:
    """Predict the RMS error [m] of smaller plans, of the plan and of larger ones; return sizes and errors."""
    count = len(found.refined)
    plan_rows = goal.full_information.rows(found.refined)
    n_known = qr.rank(goal.ranking.information.data_factor)
    n_rows = min(plan_rows.shape[1], MAX_POSE_COMPONENTS)
    smallest = min(count, max(1, -(-(goal.n_observable - n_known) // n_rows)))
    sizes = np.unique(
        np.rint([smallest, 1.4 * smallest, 2 * smallest, np.sqrt(2 * smallest * count)]).astype(int)
    )
    sizes = sizes[sizes < count]
    # With few redundant measurements, refinement lowers the error considerably.
    errors = [_error_of_smaller(goal, found, size, size <= 2 * smallest, rng) for size in sizes]
    larger = _larger_plan(goal, found, plan_rows)
    larger_sizes = np.arange(count, len(larger) + 1)
    errors += goal.expected.after_first(larger, larger_sizes)
    all_sizes = np.arange(smallest, len(larger) + 1)
    # Any pose that is added to a plan lowers its error.
    lowest = np.minimum.accumulate(errors)
    log_errors = np.interp(np.log(all_sizes), np.log([*sizes, *larger_sizes]), np.log(lowest))
    return all_sizes, np.exp(log_errors)


def _error_of_smaller(
    goal: DesignGoal, found: Selection, size: int, is_refined: bool, rng: np.random.Generator
) -> float:
    """Predict the error of a plan that starts from the first poses of the greedy selection."""
    selection = exchange.improve_by_exchange(
        found.candidates,
        goal.full_information.prior_factor,
        found.greedy[:size],
        goal.criterion,
        goal.existing,
        max_passes=1,
    )
    q = found.q[selection]
    if goal.sampler is not None and is_refined:
        q = refine(goal, q, goal.sampler, found.candidates.min_distance, rng)
    return goal.expected.after(q)


def _larger_plan(goal: DesignGoal, found: Selection, plan_rows: Array) -> Array:
    """Return the joint positions (w, n) of the plan and of more poses, each the best one to add next."""
    candidates, prior_factor = found.candidates, goal.full_information.prior_factor
    count = len(found.refined)
    sqrt_covariance = exchange.compute_sqrt_covariance(
        prior_factor, np.ascontiguousarray(plan_rows.transpose(2, 1, 0))
    )
    coordinates = scale_joint_units(goal.full_information.chain, found.refined)
    gains = goal.criterion.gains(candidates.rows, sqrt_covariance)
    gains += candidates.filling_gains(np.arange(len(gains)), np.concatenate([goal.existing, coordinates]))
    gains[candidates.infeasible] = -np.inf
    gains[found.selected] = -np.inf
    promising = np.argsort(-gains)[: min(exchange.MAX_EXCHANGE_CANDIDATES, int(np.isfinite(gains).sum()))]
    # The plan's poses come first and are feasible.
    extended = exchange.CandidateSet(
        np.concatenate([plan_rows, candidates.rows[:, :, promising]], 2),
        np.concatenate([coordinates, candidates.coordinates[promising]]),
        candidates.min_distance,
        lambda i: i < count or candidates.is_feasible(int(promising[i - count])),
        candidates.bin_columns,
    )
    order = exchange.select_greedily(
        extended, prior_factor, max(count, EXTRA_POSES), goal.criterion, np.arange(count), goal.existing
    )
    return np.concatenate([found.refined, found.q[promising]])[order]


def plans_for_curves(goal: DesignGoal, found: Selection) -> list[Array]:
    """Return an empty plan, the plan found and plans of `CURVE_SIZES` poses (n, dof), by size."""
    prior_factor, nearby = goal.full_information.prior_factor, replace(found.candidates, min_distance=0.0)
    n_more = max(0, CURVE_SIZES[-1] - len(found.greedy))
    order = exchange.select_greedily(
        nearby, prior_factor, n_more, goal.criterion, found.greedy, goal.existing
    )
    plans = {size: found.q[order[:size]] for size in (0, *CURVE_SIZES) if size <= len(order)}
    return [plan for _, plan in sorted((plans | {len(found.refined): found.refined}).items())]


def random_errors(
    goal: DesignGoal, found: Selection, sizes: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Predict the error of random poses for some numbers of poses."""
    if not sizes.size:
        return sizes, np.empty(0)
    candidates = found.candidates
    order = rng.permutation(candidates.rows.shape[2])
    n_poses = max(4 * int(sizes[-1]), MIN_RANDOM_POSES)
    feasible = [
        i for i in order[: 4 * n_poses] if not candidates.infeasible[i] and candidates.is_feasible(int(i))
    ][:n_poses]
    poses = np.array(feasible, int)
    rows = candidates.rows_of(poses)[..., goal.full_information.fitted]
    selected_sizes = sizes[evenly_spaced_indices(len(sizes), N_RANDOM_SIZES)]

    def median_error(size: int) -> float:
        plans = [rng.permutation(len(rows))[:size] for _ in range(N_RANDOM_PLANS)]
        information, combinations = goal.ranking.information, goal.ranking.combinations
        errors = [information.predict_error(rows[plan], combinations) for plan in plans]
        median = plans[int(np.argsort(errors)[N_RANDOM_PLANS // 2])]
        return goal.expected.after(found.q[poses[median]])

    return selected_sizes, np.array([median_error(size) for size in selected_sizes])


def recommended_size(sizes: Array, errors: Array, sigma: float) -> int | None:
    """Find the number of poses with diminishing returns for an instrument of this standard deviation."""
    shown = np.sqrt(errors**2 + 3 * sigma**2)
    is_diminishing = np.flatnonzero(shown[EXTRA_POSES:] > (1 - MIN_EXTRA_GAIN) * shown[:-EXTRA_POSES])
    return int(sizes[is_diminishing[0]]) if is_diminishing.size else None
