"""First values of the poses of the base in several files, whose frames may differ by large rotations.

The search for changes is linear. It does not find a base that turned by more than about 20°, such as that
of a tracker which was set up anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from ..estimation.initialization import initialize_frames
from ..estimation.problem import Problem
from ..robot.chain import BASE_FRAME
from .robot_changes import Motion
from .timeline import Timeline

# Smallest rotation between two files for which the base is placed in each of them [rad].
MIN_ROTATION = np.deg2rad(10.0)
# Smallest number of samples of a file in which the base is placed.
MIN_SAMPLES = 6
# Largest number of iterations of the fit of the frames.
MAX_ITERATIONS = 20


def place_files(problem: Problem, timeline: Timeline) -> tuple[Problem, Motion] | None:
    """Fit base and tool to each file by itself; None with one file, and if no base turned far."""
    # The problem gets the base and the tool of the last file, and the base moves where a file begins.
    parts: dict[int, list[int]] = {}
    of_robot = [i for i in range(timeline.n_fitted) if (timeline.numbers[i] >= timeline.begin).all()]
    for i in of_robot:
        numbers = timeline.numbers[i]
        of_file = np.unique(np.searchsorted(timeline.file_starts, numbers, side="right"))
        if len(of_file) != 1:
            return None
        parts.setdefault(int(of_file[0]), []).append(i)
    is_base_free = any(p.error_frame == BASE_FRAME for p in problem.errors.parameters)
    if not is_base_free or len(parts) < 2 or len(parts) != len(timeline.file_starts) + 1:
        return None
    files = [tuple(problem.data[i] for i in parts[file]) for file in sorted(parts)]
    if min(sum(len(item.rows) for item in file) for file in files) < MIN_SAMPLES:
        return None
    errors = problem.errors
    chains = [initialize_frames(errors, file, problem.known, MAX_ITERATIONS).chain for file in files]
    last = chains[-1]
    poses = np.array([chain.base @ se3.inverse(last.base) for chain in chains])
    if max(np.linalg.norm(se3.log3(pose[:3, :3])) for pose in poses) < MIN_ROTATION:
        return None
    moved = replace(errors, chain=errors.chain.with_base_and_tool(last.base, last.tool))
    return replace(problem, errors=moved), Motion(timeline.file_starts, poses)
