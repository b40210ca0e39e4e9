"""Size of the boards, which errors of the arm can imitate.

Images do not show lengths: an arm and a board that are both 1 % longer give the same images. A board that is
larger or smaller than the rig states therefore changes all lengths of the estimated arm by the same factor.
Manufacturing errors do not. If another size of the boards makes the correction of the arm far smaller, the
stated size is probably wrong. If it makes it smaller by less, the stated size may be wrong.

Images of several boards show the ratios of their sizes. These are therefore found first, then the factor that
all boards have in common.

Errors of the joints that the model lacks change the lengths of the estimated arm, too: a gear ratio that is
1 % wrong as much as a board that is 1 % wrong. The size is therefore judged with the joint errors that the
images support, see `joint_errors`.

The corrections of the lengths of the arm, in units of their default prior standard deviations, have the RMS w
with the stated size and w' with the one that fits best. For a common width of their normal distribution, each
time of greatest likelihood, the logarithm of the ratio of the likelihoods is n·log(w/w') with the effective
number n of lengths that the images determine (MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ...estimation.error_model import ErrorModel
from ...estimation.problem import Problem
from ...estimation.robust import ZERO_WEIGHT
from ...estimation.solver import minimize
from ...formatting import join_names
from ...measurements.camera import CameraCorners, change_images, select_images
from ..reweighting import Fit
from .causes import MAX_SIZE_STEP, SIZE_STEP, find_minimum, with_sizes

# RMS correction in prior standard deviations from which the stated size may be wrong, and is wrong.
MIN_DOUBTFUL_CORRECTION, MIN_CORRECTION = 0.5, 1.2
# Logarithm of the ratio of the likelihoods from which the stated size may be wrong (very strong evidence, see
# Kass and Raftery 1995), and is wrong.
MIN_DOUBTFUL_LOG_RATIO, MIN_LOG_RATIO = 5.0, 8.0
# Smallest relative change of the size that is reported.
MIN_CHANGE = 2e-3
# Smallest change of the size of a board that is reported, as a share of the largest one.
MIN_SHARE = 0.1
# Share of rejected corners of a board from which its size is looked for with all of them.
MAX_REJECTED_SHARE = 0.5
# Largest ratio of the squared residuals to the noise that is left where another size explains such corners.
MAX_COST_RATIO = 2.0
# What else explains a change of the size by more than MAX_SIZE_STEP.
OTHER_ROBOT = " Or the URDF is that of a robot of another size."
# Largest number of iterations of one solution.
_MAX_ITERATIONS = 40


@frozen
class BoardSize:
    """Sizes of the boards that make the correction of the arm far smaller."""

    sizes: Mapping[str, float]  # Size relative to the stated one, by the name of the board
    squares: Mapping[str, float]  # Stated size of the squares [m], by name; 0 for boards without squares
    # RMS correction of the lengths of the arm in prior standard deviations, with the stated size.
    stated: float
    found: float  # The same with the other size
    log_ratio: float  # Logarithm of the ratio of the likelihoods of the two sizes

    @property
    def is_decisive(self) -> bool:
        """Whether the stated size is wrong beyond doubt, rather than possibly wrong."""
        return self.stated >= MIN_CORRECTION and self.log_ratio >= MIN_LOG_RATIO

    @property
    def wrong(self) -> dict[str, float]:
        """Relative sizes of the boards whose size differs from the stated one, by name."""
        changes = {name: abs(float(np.log(size))) for name, size in self.sizes.items()}
        limit = max(MIN_CHANGE, MIN_SHARE * max(changes.values()))
        return {name: self.sizes[name] for name, change in changes.items() if change >= limit}

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        boards, start = "the boards", "The size of the boards may be wrong"
        if self.is_decisive:
            start = "The size of the boards is probably wrong"
        if len(self.sizes) > 1:
            boards = join_names([f"board {name!r}" for name in self.wrong])
            start = start.replace("the boards", boards)
        return (
            f"{start}: with {join_names(self._texts)}, the corrections of the lengths of the arm fall from "
            f"{self.stated:.2g} to {self.found:.2g} times what manufacturing errors would be. Measure "
            f"{boards} over the whole length, and correct the size in the rig file."
            f"{OTHER_ROBOT if max(abs(np.log(size)) for size in self.wrong.values()) > MAX_SIZE_STEP else ''}"
        )

    @property
    def _texts(self) -> list[str]:
        """Each wrong size with the length of the squares."""
        texts = []
        for name, size in self.wrong.items():
            of_board = f" of board {name!r}" if len(self.wrong) > 1 else ""
            square = self.squares[name]
            lengths = f"squares of {1e3 * size * square:.4g} mm, not {1e3 * square:.4g} mm"
            text = f"{100 * size:.4g} % of the stated size{of_board}"
            texts.append(f"{text} ({lengths})" if square else text)
        return texts


def find_board_size(fit: Fit) -> BoardSize | None:
    """Look for a size of the boards that makes the correction of the arm far smaller."""
    complete = _with_whole_boards(fit)
    problem, x = complete.problem.at_temperature(1.0), complete.solution.x
    stated = _rms_correction(problem.errors, x)
    lengths = _lengths(problem.errors)
    if stated < MIN_DOUBTFUL_CORRECTION or len(select_images(problem.data)) < len(problem.data):
        return None
    # Wide priors would leave the size of the arm undetermined.
    weights = problem.weights.copy()
    weights[: len(lengths)] = 1 / problem.errors.priors
    problem = problem.with_prior_weights(weights)
    squares = {board.name: board.square for item in select_images(problem.data) for board in item.rig.boards}
    best = [x]

    def by_name(log_sizes: Array) -> dict[str, float]:
        return dict(zip(squares, np.exp(log_sizes).tolist(), strict=True))

    def solve(log_sizes: Array) -> tuple[Problem, Array]:
        scaled = problem.with_data(change_images(problem.data, partial(with_sizes, by_name(log_sizes))))
        return scaled, minimize(scaled, "lm", best[0], _MAX_ITERATIONS, loose=True).x

    log_sizes = np.zeros(len(squares))
    for direction in (*np.eye(len(squares))[1:], np.ones(len(squares))):

        def cost(step: float, start: Array = log_sizes, direction: Array = direction) -> float:
            scaled, best[0] = solve(start + step * direction)
            return scaled.cost(best[0])

        log_sizes = log_sizes + direction * find_minimum(cost, 0.0, SIZE_STEP, MAX_SIZE_STEP)
    scaled, x = solve(log_sizes)
    n_residuals = sum(item.residual_dim * len(item.rows) for item in scaled.data)
    if complete is not fit and scaled.cost(x) > MAX_COST_RATIO * n_residuals:
        return None
    found = _rms_correction(problem.errors, x)
    root = complete.solution.system.sqrt_covariance(weights)[0][: len(lengths)][lengths]
    count = np.sum(1 - np.sum((root * weights[: len(lengths)][lengths, None]) ** 2, 1))
    ratio = count * np.log(stated / max(found, 1e-9))
    board_size = BoardSize(by_name(log_sizes), squares, stated, found, float(ratio))
    return board_size if ratio >= MIN_DOUBTFUL_LOG_RATIO and board_size.wrong else None


def _with_whole_boards(fit: Fit) -> Fit:
    """Return the fit with all corners of the boards of which most are rejected; a wrong size can be why."""
    weights = []
    for item, old in zip(fit.data, fit.weights, strict=True):
        new = old.copy()
        for board in np.unique(item.board) if isinstance(item, CameraCorners) else ():
            own = item.board == board
            if np.mean(old[own] <= ZERO_WEIGHT) > MAX_REJECTED_SHARE:
                new[own] = 1.0
        weights.append(new)
    if all(np.array_equal(old, new) for old, new in zip(fit.weights, weights, strict=True)):
        return fit
    return fit.solved_with_weights(tuple(weights), _MAX_ITERATIONS)


def _lengths(errors: ErrorModel) -> Array:
    """Return which parameters are lengths of the arm, without base and tool, (p,)."""
    return errors.is_of_arm & np.array([p.unit == "m" for p in errors.parameters], bool)


def _rms_correction(errors: ErrorModel, x: Array) -> float:
    """Return the RMS of the lengths of the arm in prior standard deviations; 0 without lengths."""
    lengths = _lengths(errors)
    values = x[: len(lengths)][lengths] / errors.priors[lengths]
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
