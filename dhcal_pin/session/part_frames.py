"""First values of the poses of base and tool in the parts of a session, which may differ by large rotations.

The search for changes is linear. It does not find a base or a tool that turned by more than about 20°, such
as the base of a tracker which was set up anew, or another tool. Parts of a session are its files, or
consecutive samples that fit by themselves only.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .. import se3
from .._typing import Array
from ..estimation.initialization import initialize_frames
from ..estimation.problem import Problem
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .robot_changes import Motion, RobotChanges
from .timeline import Timeline

# Smallest rotation between two parts for which base or tool are placed in each of them [rad].
MIN_ROTATION = np.deg2rad(10.0)
# Smallest number of samples of a part in which base and tool are placed.
MIN_SAMPLES = 6
# Number of samples at the beginning of a part to which base and tool are fitted, of consecutive samples far
# from this fit with which the next part begins, and of parts at most.
N_FIRST, N_FAR, MAX_PARTS = 16, 3, 12
# Residual of a far sample as a multiple of the median of the first ones, and smallest share of samples that
# are as far from a solution for all.
MIN_FAR_RATIO, MIN_FAR_SHARE = 10.0, 0.1
# Largest number of iterations of the fit of the frames.
MAX_ITERATIONS = 20


def place_parts(
    problem: Problem, timeline: Timeline, starts: tuple[int, ...]
) -> tuple[Problem, RobotChanges] | None:
    """Fit base and tool to each part of a session by itself; None for one part, and if neither turned far."""
    # The problem gets the base and the tool of the last part. What turned far moves where a part begins.
    if not _can_turn(problem) or not starts:
        return None
    limits = (timeline.begin, *starts, np.inf)
    parts = [_samples_between(problem.data, timeline, *pair) for pair in pairwise(limits)]
    if min(sum(len(item.rows) for item in part) for part in parts) < MIN_SAMPLES:
        return None
    errors = problem.errors
    chains = [initialize_frames(errors, part, problem.known, MAX_ITERATIONS).chain for part in parts]
    last = chains[-1]
    changes = RobotChanges(
        _motion(starts, np.array([chain.base @ se3.inverse(last.base) for chain in chains])),
        _motion(starts, np.array([se3.inverse(last.tool) @ chain.tool for chain in chains])),
    )
    return None if changes.is_empty else (_placed(problem, last, parts[-1]), changes)


def _motion(starts: tuple[int, ...], poses: Array) -> Motion:
    """Return the motion with the poses of each part, (S, 4, 4); none if no part turned far."""
    has_turned = np.linalg.norm(se3.log3(poses[:, :3, :3]), axis=1).max() >= MIN_ROTATION
    return Motion(starts, poses) if has_turned else Motion()


def _placed(problem: Problem, chain: Chain, part: tuple[Measurement, ...]) -> Problem:
    """Return a problem with base and tool of a chain, and with first values of instruments in a part."""
    # Those of all parts together mean nothing.
    shown = [p for item in part for p in item.initialized(chain).instrument_parameters]
    first = {p.name: p for p in shown if not np.isnan(p.nominal)}
    data = tuple(
        item.replace(instrument_parameters=tuple(first.get(p.name, p) for p in item.instrument_parameters))
        for item in problem.data
    )
    placed = problem.errors.chain.with_base_and_tool(chain.base, chain.tool)
    return replace(problem, errors=replace(problem.errors, chain=placed), data=data)


def _can_turn(problem: Problem) -> bool:
    """Return whether rotations of base or tool are unknown."""
    frames = problem.errors.only_frames
    return frames is not None and any(p.unit == "rad" for p in frames.parameters)


def _samples_between(
    data: tuple[Measurement, ...], timeline: Timeline, first: float, end: float
) -> tuple[Measurement, ...]:
    """Return the fitted samples with numbers from a first one to the one before the end."""
    pairs = zip(data, timeline.numbers[: timeline.n_fitted], strict=True)
    taken = (item.take((first <= numbers) & (numbers < end)) for item, numbers in pairs)
    return tuple(item for item in taken if len(item.rows))


def starts_of_parts(problem: Problem, x: Array, timeline: Timeline) -> tuple[int, ...]:
    """Return the first samples of parts but the first that fit by themselves, but not to one solution."""
    if not _can_turn(problem):
        return ()
    numbers = np.sort(timeline.fitted_numbers)
    numbers = numbers[numbers >= timeline.begin]
    of_solution = _mean_squares(problem, x, timeline)
    begin, starts = 0, []
    while len(numbers) - begin >= MIN_SAMPLES and len(starts) < MAX_PARTS:
        last = numbers[begin : begin + N_FIRST][-1]
        part = _samples_between(problem.data, timeline, numbers[begin], last + 1)
        chain = initialize_frames(problem.errors, part, problem.known, MAX_ITERATIONS).chain
        sizes = _mean_squares(_placed(problem, chain, part), np.zeros_like(x), timeline)[begin:]
        limit = MIN_FAR_RATIO**2 * np.median(sizes[:N_FIRST])
        far = np.flatnonzero(np.all(sliding_window_view(sizes > limit, N_FAR), 1))
        far = far[far >= MIN_SAMPLES]
        if np.mean(of_solution > limit) < MIN_FAR_SHARE or not len(far):
            break
        begin += int(far[0])
        starts.append(int(numbers[begin]))
    return tuple(starts)


def _mean_squares(problem: Problem, x: Array, timeline: Timeline) -> Array:
    """Return the mean squared residual of each fitted sample of the robot, in the order of measurement."""
    sizes = np.concatenate([np.mean(r**2, 0) for r in problem.residuals(x, problem.data)])
    order = np.argsort(timeline.fitted_numbers, kind="stable")
    return sizes[order[timeline.fitted_numbers[order] >= timeline.begin]]
