"""Scale of all measured lengths, which the size of the robot imitates.

Positions and poses do not tell a scale of the instrument from the size of the robot. A wrong scale changes
all lengths of the estimated arm by one factor, which manufacturing errors do not. The corrections of the
lengths, in units of their prior standard deviations, are those of one factor, and a normal distribution of
unknown width. The factor is reported if Student's t test rejects that it is 1. The number of lengths in this
test is the effective number of those that are determined (MacKay 1992).
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..estimation.problem import Problem
from ..robot.chain import BASE_FRAME
from .facts import Scale
from .linear_model import Layout, measures_positions, whitened_rows

# Smallest RMS correction in prior standard deviations and relative change of lengths that are reported.
MIN_CORRECTION, MIN_CHANGE = 0.5, 1e-3
# Smallest norm of the corrections by a change of scale of 1, in prior standard deviations.
MIN_PATTERN = 1e-2
# Probability that chance makes the correction of an arm look like a change of scale.
MAX_CHANCE = 1e-3
# Largest number of samples that are examined.
MAX_SAMPLES = 200


def find_scale(problem: Problem, x: Array) -> Scale | None:
    """Look for one factor of all lengths that explains most of the correction x (p,) of an arm."""
    from scipy.special import stdtr  # lazy import: slow

    errors = problem.errors
    outside = (BASE_FRAME, errors.chain.tool_frame_index)
    is_length = np.array([p.unit == "m" and p.error_frame not in outside for p in errors.parameters], bool)
    (lengths,) = np.nonzero(is_length)
    priors = errors.priors[lengths]
    corrections = x[lengths] / priors
    if (
        not measures_positions(problem)
        or not lengths.size
        or np.sqrt(np.mean(corrections**2)) < MIN_CORRECTION
    ):
        return None
    # Columns of unknowns without a prior, such as those of an undetermined tool, have an inverse with this.
    weights = np.where(problem.weights > 0, problem.weights, 1e-6)
    layout = Layout.of(problem)
    data = [item.take(np.s_[:: max(1, -(-len(item.rows) // MAX_SAMPLES))]) for item in problem.data]
    rates = np.zeros((sum(len(item.rows) for item in data), errors.chain.n_joints))
    rows = whitened_rows(layout, x, data, rates).reshape(-1, layout.n_columns)
    model = rows[:, layout.model]
    covariance = np.linalg.inv(model.T @ model + np.diag(weights**2))
    pattern = (covariance @ (model.T @ rows[:, layout.scale]))[lengths] / priors
    if not np.linalg.norm(pattern) > MIN_PATTERN:
        return None
    change = float(pattern @ corrections / (pattern @ pattern))
    freedom = float(np.sum(1 - (np.diag(covariance) * weights**2)[lengths])) - 1
    if freedom < 1 or abs(change) < MIN_CHANGE:
        return None
    remaining = float(np.linalg.norm(corrections - change * pattern)) / np.sqrt(freedom)
    std = max(remaining, 1e-9) / float(np.linalg.norm(pattern))
    if 2 * stdtr(freedom, -abs(change) / std) > MAX_CHANCE:
        return None
    return Scale(1 + change, std, "")
