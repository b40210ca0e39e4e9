"""First values of the poses of the base in the parts of a session, which may differ by large rotations.

The search for changes is linear. It does not find a base that turned by more than about 20°, such as that
of a tracker which was set up anew. Parts of a session are its files, and the longest run of consecutive
samples that are far from a fit of the others.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.initialization import initialize_frames
from ..estimation.problem import Problem
from ..estimation.robust import longest_run
from ..measurements.base import Measurement
from ..robot.chain import BASE_FRAME
from .robot_changes import Motion
from .timeline import Timeline

# Smallest rotation between two parts for which the base is placed in each of them [rad].
MIN_ROTATION = np.deg2rad(10.0)
# Smallest number of samples of a part in which the base is placed.
MIN_SAMPLES = 6
# Residual from which a sample is far from a fit, as a multiple of what a share of the samples has at
# most.
MIN_FAR_RATIO, FITTING_SHARE = 10.0, 0.25
# Largest number of iterations of the fit of the frames.
MAX_ITERATIONS = 20


def place_parts(
    problem: Problem, timeline: Timeline, starts: tuple[int, ...]
) -> tuple[Problem, Motion] | None:
    """Fit base and tool to each part of a session by itself; None for one part, and if no base turned far."""
    # The problem gets the base and the tool of the last part, and the base moves where a part begins.
    is_base_free = any(p.error_frame == BASE_FRAME for p in problem.errors.parameters)
    if not is_base_free or not starts:
        return None
    numbers = timeline.numbers[: timeline.n_fitted]
    of_part = [np.searchsorted(starts, each, side="right") for each in numbers]
    parts = [_samples_of(problem.data, of_part, i) for i in range(len(starts) + 1)]
    if min(sum(len(item.rows) for item in part) for part in parts) < MIN_SAMPLES:
        return None
    errors = problem.errors
    chains = [initialize_frames(errors, part, problem.known, MAX_ITERATIONS).chain for part in parts]
    last = chains[-1]
    poses = np.array([chain.base @ se3.inverse(last.base) for chain in chains])
    if max(np.linalg.norm(se3.log3(pose[:3, :3])) for pose in poses) < MIN_ROTATION:
        return None
    moved = replace(errors, chain=errors.chain.with_base_and_tool(last.base, last.tool))
    return replace(problem, errors=moved), Motion(starts, poses)


def _samples_of(data: tuple[Measurement, ...], of_part: list[Array], part: int) -> tuple[Measurement, ...]:
    """Return the samples of a part."""
    taken = (item.take(each == part) for item, each in zip(data, of_part, strict=True))
    return tuple(item for item in taken if len(item.rows))


def starts_of_far_samples(problem: Problem, x: Array, timeline: Timeline) -> tuple[int, ...]:
    """Return the first samples of parts but the first: files, and a run of samples far from a solution."""
    sizes = np.concatenate([np.sum(r**2, 0) / len(r) for r in problem.residuals(x, problem.data)])
    order = np.argsort(timeline.fitted_numbers, kind="stable")
    numbers = timeline.fitted_numbers[order]
    first, end = longest_run(sizes[order] > MIN_FAR_RATIO**2 * np.quantile(sizes, FITTING_SHARE))
    inner = [int(numbers[i]) for i in (first, end) if 0 < i < len(numbers) and first < end]
    return tuple(sorted({*timeline.file_starts, *inner}))
