"""Size of the boards, which errors of the arm can imitate.

Images do not show lengths: an arm and a board that are both 1 % longer give the same images. A board that is
larger or smaller than the rig states therefore changes all lengths of the estimated arm by the same factor.
Manufacturing errors do not. If another size of the boards makes the correction of the arm far smaller, the
stated size is probably wrong. If it makes it smaller by less, the stated size may be wrong.

Errors of the joints that the model lacks change the lengths of the estimated arm, too: a gear ratio that is
1 % wrong as much as a board that is 1 % wrong. The size is therefore judged with the joint errors that the
images support, see `joint_errors`.

The corrections of the lengths of the arm, in units of their default prior standard deviations, have the RMS w
with the stated size and w' with the one that fits best. For a common width of their normal distribution, each
time of greatest likelihood, the logarithm of the ratio of the likelihoods is n·log(w/w') with the effective
number n of lengths that the images determine (MacKay 1992).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.error_model import ErrorModel
from ...estimation.problem import Problem
from ...estimation.solver import minimize
from ...measurements.camera import CameraCorners, change_images, select_images
from ...measurements.images.camera_parameters import POINTS_SET
from ..reweighting import Fit
from .causes import MAX_SIZE_STEP, SIZE_STEP, find_minimum

# RMS correction in prior standard deviations from which the stated size may be wrong, and is wrong.
MIN_DOUBTFUL_CORRECTION, MIN_CORRECTION = 0.5, 1.2
# Logarithm of the ratio of the likelihoods from which the stated size may be wrong (very strong evidence, see
# Kass and Raftery 1995), and is wrong.
MIN_DOUBTFUL_LOG_RATIO, MIN_LOG_RATIO = 5.0, 8.0
# Smallest relative change of the size that is reported.
MIN_CHANGE = 2e-3
# Largest number of iterations of one solution.
_MAX_ITERATIONS = 40


@frozen
class BoardSize:
    """Size of the boards that makes the correction of the arm far smaller."""

    size: float  # Size relative to the stated one
    square: float  # Stated size of the squares of the first board [m]; 0 if it has none
    # RMS correction of the lengths of the arm in prior standard deviations, with the stated size.
    stated: float
    found: float  # The same with the other size
    log_ratio: float  # Logarithm of the ratio of the likelihoods of the two sizes

    @property
    def is_decisive(self) -> bool:
        """Whether the stated size is wrong beyond doubt, rather than possibly wrong."""
        return self.stated >= MIN_CORRECTION and self.log_ratio >= MIN_LOG_RATIO

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        lengths = f" (squares of {1e3 * self.size * self.square:.4g} mm, not {1e3 * self.square:.4g} mm)"
        start = "The size of the boards may be wrong"
        if self.is_decisive:
            start = "The size of the boards is probably wrong"
        return (
            f"{start}: with {100 * self.size:.4g} % of the stated size"
            f"{lengths if self.square else ''}, the corrections of the lengths of the arm fall from "
            f"{self.stated:.2g} to {self.found:.2g} times what manufacturing errors would be. Measure the "
            "boards over their whole length, and correct their size in the rig file."
        )


def find_board_size(fit: Fit) -> BoardSize | None:
    """Look for a size of the boards that makes the correction of the arm far smaller."""
    problem, x = fit.problem.at_temperature(1.0), fit.solution.x
    stated = _rms_correction(problem.errors, x)
    lengths = _lengths(problem.errors)
    if stated < MIN_DOUBTFUL_CORRECTION or len(select_images(problem.data)) < len(problem.data):
        return None
    # Wide priors would leave the size of the arm undetermined.
    weights = problem.weights.copy()
    weights[: len(lengths)] = 1 / problem.errors.priors
    problem = problem.with_prior_weights(weights)
    best = [x]

    def solve(log_size: float) -> tuple[Problem, Array]:
        scaled = problem.with_data(change_images(problem.data, partial(_scaled, float(np.exp(log_size)))))
        return scaled, minimize(scaled, "lm", best[0], _MAX_ITERATIONS, loose=True).x

    def cost(log_size: float) -> float:
        scaled, best[0] = solve(log_size)
        return scaled.cost(best[0])

    log_size = find_minimum(cost, 0.0, SIZE_STEP, MAX_SIZE_STEP)
    found = _rms_correction(problem.errors, solve(log_size)[1])
    root = fit.solution.system.sqrt_covariance(weights)[0][: len(lengths)][lengths]
    count = np.sum(1 - np.sum((root * weights[: len(lengths)][lengths, None]) ** 2, 1))
    ratio = count * np.log(stated / max(found, 1e-9))
    if ratio < MIN_DOUBTFUL_LOG_RATIO or abs(log_size) < MIN_CHANGE:
        return None
    square = select_images(problem.data)[0].rig.boards[0].square
    return BoardSize(float(np.exp(log_size)), square, stated, found, float(ratio))


def _lengths(errors: ErrorModel) -> Array:
    """Return which parameters are lengths of the arm, without base and tool, (p,)."""
    return errors.is_of_arm & np.array([p.unit == "m" for p in errors.parameters], bool)


def _rms_correction(errors: ErrorModel, x: Array) -> float:
    """Return the RMS of the lengths of the arm in prior standard deviations; 0 without lengths."""
    lengths = _lengths(errors)
    values = x[: len(lengths)][lengths] / errors.priors[lengths]
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _scaled(size: float, item: CameraCorners) -> CameraCorners:
    """Return images of boards of another size."""
    boards = tuple(
        replace(board, type="points", listed_points=size * board.points) for board in item.rig.boards
    )
    points = {
        p.name: size * p.nominal for p in item.instrument_parameters if item.set_of(p.name) == POINTS_SET
    }
    return item.with_rig(replace(item.rig, boards=boards)).with_values(points)
