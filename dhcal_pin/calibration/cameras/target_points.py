"""Corners of boards as unknowns: whether images show that they are not where the rig states them.

Prints are stretched and boards are bent by some tenths of a millimetre. Corners have a prior of
1 mm. They are tried as further unknowns together with all others, the arm included: errors of the arm alone
can look like those of a board. The corners are estimated if this lowers the error of left-out images and that
of left-out clusters of joint space to less than 0.9. Noise alone raises both errors.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ..._frozen import frozen
from ...cameras.boards import Board
from ...estimation.solver import minimize
from ...measurements.base import Measurement
from ...measurements.camera import CameraCorners, change_images, select_images
from ..partition import Fold
from ..reweighting import Fit
from .sets import MAX_POINTS
from .stages import format_ratio, held_out_error

# Largest ratio of the errors of left-out images and clusters for which the corners are estimated.
MAX_RATIO = 0.9


@frozen(eq=False)
class TargetPoints:
    """Result of a trial of the corners of boards as unknowns."""

    # Fit with the corners as unknowns, with the weights and standard deviations of that without them.
    fit: Fit
    by_image: float  # Error of left-out images relative to that with the stated corners
    by_region: float  # The same for left-out clusters of joint space

    @property
    def is_kept(self) -> bool:
        """Whether the corners are estimated."""
        return max(self.by_image, self.by_region) < MAX_RATIO

    @property
    def sentence(self) -> str:
        """Why the corners are estimated or held."""
        start = (
            "The corners are not where the rig states them:"
            if self.is_kept
            else "The corners are kept as stated:"
        )
        return (
            f"{start} estimating them with all other unknowns changes the error of left-out images to "
            f"{format_ratio(self.by_image)}, and that of left-out parts of joint space to "
            f"{format_ratio(self.by_region)}"
            + ("." if self.is_kept else f", not both below {format_ratio(MAX_RATIO)}.")
        )


def try_target_points(
    fit: Fit, images: Sequence[Fold], clusters: Sequence[Fold], max_iterations: int
) -> TargetPoints | None:
    """Judge the corners of boards as unknowns on left-out images."""
    names = judged_boards(boards_of(fit.data))
    if not names:
        return None
    freed = with_free_points(fit, names)
    solution = minimize(freed.problem, "lm", freed.solution.x, max_iterations, loose=True)
    freed = replace(freed, solution=solution, previous_iterations=fit.iterations)
    ratios = []
    for folds in (images, clusters):
        before, after = held_out_error(fit, folds), held_out_error(freed, folds)
        if before is None or after is None or not before.pixels:
            return None
        ratios.append(after.pixels / before.pixels)
    return TargetPoints(freed, *ratios)


def judged_boards(boards: Iterable[Board]) -> list[str]:
    """Find the boards whose corners are tried as further unknowns."""
    by_name = {board.name: board for board in boards}
    if sum(len(board.points) for board in by_name.values()) > MAX_POINTS:
        return []
    return [
        name for name, board in by_name.items() if not board.has_free_points and not board.has_exact_points
    ]


def boards_of(data: Sequence[Measurement]) -> list[Board]:
    """Return the boards of images."""
    return [board for item in select_images(data) for board in item.rig.boards]


def with_free_points(fit: Fit, boards: Collection[str]) -> Fit:
    """Return a fit whose corners of boards are further unknowns, at their first values and not yet solved."""
    problem, robot = fit.problem, len(fit.problem.errors.parameters)
    names = [p.name for p in problem.instrument_parameters]
    weights = dict(zip(names, problem.weights[robot:].tolist(), strict=True))
    values = dict(zip(names, fit.solution.x[robot:].tolist(), strict=True))
    data = change_images(problem.data, partial(_free_points, boards))
    freed = replace(problem, data=data)
    parameters = freed.instrument_parameters
    own = [weights.get(p.name, np.sqrt(problem.temperature) / p.prior) for p in parameters]
    x = [values.get(p.name, 0.0) for p in parameters]
    bounds = problem.bounds
    if bounds is not None:
        n_more = len(parameters) - len(names)
        bounds = np.concatenate([bounds, np.tile([[-np.inf], [np.inf]], n_more)], 1)
    return replace(
        fit,
        data=change_images(fit.data, partial(_free_points, boards)),
        problem=replace(freed, weights=np.concatenate([problem.weights[:robot], own]), bounds=bounds),
        solution=replace(fit.solution, x=np.concatenate([fit.solution.x[:robot], x])),
    )


def _free_points(boards: Collection[str], item: CameraCorners) -> CameraCorners:
    """Return image coordinates with the corners of some boards as unknowns."""
    freed = tuple(
        replace(board, has_free_points=board.has_free_points or board.name in boards)
        for board in item.rig.boards
    )
    return item.with_rig(replace(item.rig, boards=freed))
