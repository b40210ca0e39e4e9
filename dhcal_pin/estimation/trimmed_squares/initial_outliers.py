"""Find gross outliers before the first fit, for measurements of any kind.

A wrong length or a contact with another object is up to half a metre off. A least-squares start from all
samples then places base, tool and instruments far from their actual poses, where neither the model nor its
linearization says which samples are wrong. The start is therefore searched with the nominal robot:

1. Fit base, tool and instruments to all samples.
2. Initialize the instruments from all samples and from random subsets of configurations. The start with the
   smallest median of the residuals is used.
3. Linearize the model in the unknowns of base, tool and instruments, and search the majority that agrees best
   (`search`).
4. Fit this majority with the nonlinear model. Repeat steps 3 and 4 there until the majority is the same.

Steps 2 to 4 begin at the nominal base and tool, and again at those of step 1. The fit with the smallest
median of the residuals counts, but a fit to a majority only if its median is far below that of step 1: a
fit to half of few samples always has smaller residuals.

A sample is an outlier if its residual is a large multiple of the median. Smaller outliers are left to the
search after the fit of the robot: nominal robots have errors of millimetres themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..._kernels.types import FrameBatch
from ..._typing import Array
from ...exceptions import DhcalError
from ...measurements.base import Measurement
from ...robot.chain import Chain
from ..error_model import ErrorModel
from ..initialization import make_problem
from ..problem import Problem, linearize_and_factor, whitened_residuals
from ..solver import minimize
from .search import linearize_rows, search_majorities

# Approximate number of samples of each measurement that the search uses, and the smallest number of them from
# each group, such as an image. Samples of one group are often wrong together, so that a few samples of many
# groups determine more than all samples of a few.
MAX_SAMPLES, MIN_PER_GROUP = 200, 4
# Number of random subsets that the instruments are initialized from, and their smallest number of
# configurations.
N_STARTS, MIN_CONFIGURATIONS = 40, 4
# Largest number of linearizations, and of iterations of the fit after each.
MAX_LINEARIZATIONS, MAX_ITERATIONS = 10, 30
# Smallest ratio of the median residual of a fit to all samples to that of a majority which makes the
# majority more credible. A fit to few samples reduces their residuals, too.
MIN_IMPROVEMENT = 5.0
# Smallest ratio of the residual of an outlier to the median of all.
MIN_RATIO = 10.0
# Smallest median of whitened residuals; exact data have none.
MIN_MEDIAN = 1e-6


def find_initial_outliers(
    errors: ErrorModel, data: Sequence[Measurement], known: Mapping[str, float], started: Chain
) -> list[Array]:
    """Find samples that are so far from the nominal robot that a fit must begin without them."""
    # The started chain has base and tool from all samples: outliers ruin them, few clean samples do not.
    frames = errors.only_frames or ErrorModel(errors.chain, ())
    best = _distances_from_all(replace(frames, chain=started), data, known)
    least = _log_median(best) - np.log(MIN_IMPROVEMENT)
    for chain in dict.fromkeys((frames.chain, started)):
        trial = _distances_from_majority(replace(frames, chain=chain), data, known)
        if trial is None:
            return [np.zeros(len(item.rows), bool) for item in data]
        if _log_median(trial) < least:
            best, least = trial, _log_median(trial)
    out = []
    for groups in best:
        is_outlier = [each > MIN_RATIO * _median(each) for each in groups]
        out.append(np.any(is_outlier, 0))
    return out


def _median(distances: Array) -> float:
    """Return the median of distances (m,), positive also for exact data and none."""
    return max(float(np.median(distances)), MIN_MEDIAN) if len(distances) else MIN_MEDIAN


def _log_median(distances: Sequence[Sequence[Array]]) -> float:
    """Return the mean logarithm of the medians of all residual groups, weighted by their samples."""
    groups = [each for of_item in distances for each in of_item]
    return float(
        np.average([np.log(_median(each)) for each in groups], weights=[len(each) for each in groups])
    )


def _distances_from_all(
    frames: ErrorModel, data: Sequence[Measurement], known: Mapping[str, float]
) -> list[list[Array]]:
    """Compute the norms (m,) of the residuals by measurement and group after a fit to all samples."""
    starts = [item.initialized(frames.chain) for item in data]
    problem = make_problem(frames, tuple(starts), 1 / frames.priors, known)
    drawn = problem.with_data([start.take(_draw_groups(start) & _thin_groups(start)) for start in starts])
    x = minimize(drawn, "lm", np.zeros(len(problem.weights)), MAX_ITERATIONS, loose=True).x
    return _distances(problem, x)


def _distances_from_majority(
    frames: ErrorModel, data: Sequence[Measurement], known: Mapping[str, float]
) -> list[list[Array]] | None:
    """Compute the norms of the residuals after a fit to a majority; None if the samples are too few."""
    starts = [_initialize_instruments(frames.chain, item, _draw_groups(item)) for item in data]
    problem = make_problem(frames, tuple(starts), 1 / frames.priors, known)
    x = _fit_majority(problem.with_data([start.take(_thin_groups(start)) for start in starts]))
    if x is None:
        return None
    full = [
        start.replace(**{name: getattr(item, name) for name in item.sample_fields}, recorded=item.recorded)
        for start, item in zip(starts, data, strict=True)
    ]
    return _distances(problem.with_data(full), x)


def _distances(problem: Problem, x: Array) -> list[list[Array]]:
    """Compute the norms (m,) of the residuals by measurement and group."""
    return [
        [np.linalg.norm(residual[group.rows], axis=0) for group in item.residual_groups.values()]
        for item, residual in zip(problem.data, whitened_residuals(problem, x), strict=True)
    ]


def _draw_groups(item: Measurement) -> Array:
    """Draw whole groups at random if there are more than the search uses; return the mask of samples (m,)."""
    labels = item.sample_groups
    n_groups, m = int(labels.max(initial=-1)) + 1, len(labels)
    n_drawn = MAX_SAMPLES // max(1, min(MIN_PER_GROUP, m // max(n_groups, 1)))
    return np.isin(labels, np.random.default_rng(0).permutation(n_groups)[:n_drawn])


def _thin_groups(item: Measurement) -> Array:
    """Draw as many samples of each group at random, in all about MAX_SAMPLES; return their mask (m,)."""
    labels = item.sample_groups
    n_groups, m = int(labels.max(initial=-1)) + 1, len(labels)
    order = np.random.default_rng(0).permutation(m)
    order = order[np.argsort(labels[order], kind="stable")]
    first = np.searchsorted(labels[order], np.arange(n_groups))
    is_drawn = np.zeros(m, bool)
    is_drawn[order[np.arange(m) - first[labels[order]] < -(-MAX_SAMPLES // max(n_groups, 1))]] = True
    return is_drawn


def _initialize_instruments(chain: Chain, item: Measurement, is_drawn: Array) -> Measurement:
    """Initialize the instrument of samples (m,) from the subset whose start most of them agree with."""
    best = item.initialized_from(chain, is_drawn, is_drawn)
    if not best.instrument_parameters or not len(best.rows):
        return best
    frames = chain.forward_kinematics(best.conditions())
    labels = best.sample_groups
    n_labels = int(labels.max()) + 1
    rows_per_label = best.residual_dim * len(labels) / n_labels
    least = int(np.ceil(len(best.instrument_parameters) / rows_per_label)) + 1
    rng = np.random.default_rng(0)
    best_misfit = _median_square(best, frames)
    for i in range(N_STARTS):
        size = max(MIN_CONFIGURATIONS, least if i % 2 else 2 * least)
        if size >= n_labels:
            break
        is_used = is_drawn.copy()
        is_used[is_drawn] = np.isin(labels, rng.permutation(n_labels)[:size])
        try:
            start = item.initialized_from(chain, is_used, is_drawn)
        except DhcalError:
            # The subset does not determine the instrument.
            continue
        misfit = _median_square(start, frames)
        if misfit < best_misfit:
            best, best_misfit = start, misfit
    return best


def _median_square(item: Measurement, frames: FrameBatch) -> float:
    """Return the median of the squared whitened residuals of the samples; infinite if it is undefined."""
    u = np.array([parameter.nominal for parameter in item.instrument_parameters])
    median = float(np.median(np.sum(item.residual(frames, u) ** 2, 0)))
    return median if np.isfinite(median) else np.inf


def _fit_majority(problem: Problem) -> Array | None:
    """Fit the majority that agrees best; return the solution (p+s,), None if the samples are too few."""
    x = np.zeros(len(problem.weights))
    n_rows = sum(item.residual_dim * len(item.rows) for item in problem.data)
    groups, last = [], 0
    for item in problem.data:
        groups.append(item.sample_groups + last)
        last += int(groups[-1].max(initial=-1)) + 1
    bounds = np.cumsum([len(item.rows) for item in problem.data])[:-1]
    previous = np.empty(0)
    for _ in range(MAX_LINEARIZATIONS):
        system = linearize_and_factor(problem, x, small_angle=False)
        n_determined = system.rank
        if not 0 < 2 * n_determined <= n_rows:
            return None
        rows = linearize_rows(problem, x, system.sqrt_covariance(problem.weights)[0])
        majority = search_majorities(rows, np.concatenate(groups), n_determined)[0][0]
        if np.array_equal(majority, previous):
            break
        previous = majority
        masks = np.split(majority, bounds)
        chosen = problem.with_data([item.take(m) for item, m in zip(problem.data, masks, strict=True)])
        x = minimize(chosen, "lm", x, MAX_ITERATIONS, loose=True).x
    return x
