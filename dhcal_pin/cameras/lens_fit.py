"""Lens of a camera and poses of boards from its images alone, without the robot and without a guess.

The values l of the lens minimize

    n·log(Σ ‖u - lens(l, P·X)‖²) + Σ ((l_i - l0_i)/w_i)²

over all corners X with n image coordinates u in all. P is the pose of the board in the camera that explains
the view best with this lens. The values l0 of the rig have the standard deviations w. The standard deviation
of the image coordinates is unknown; the first term is that of the most likely one.

A flat board looks nearly the same if it is tilted the other way about the line of sight. With the values of
the rig, the wrong one of both poses often explains the image better, and nearly frontal boards turn far if
the lens changes little. Gauss-Newton steps are therefore made in the lens only, with the poses eliminated to
first order (variable projection, Golub and Pereyra 1973; Kaufman 1975). The poses are chosen anew with each
lens.

References:
    G. H. Golub and V. Pereyra, The Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems
    Whose Variables Separate, SIAM Journal on Numerical Analysis 10, 1973.
    L. Kaufman, A Variable Projection Method for Solving Separable Nonlinear Least Squares Problems, BIT 15,
    1975.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from .lens import Lens
from .pose_from_points import estimate_poses

# Largest number of views that the lens is fitted to, and of trial steps.
_MAX_VIEWS, _N_STEPS = 30, 20
# First damping of the lens, and damping of the poses, which are determined.
_DAMPING, _POSE_DAMPING = 1e-3, 1e-9
# Change of the cost, twice the negative logarithm of the likelihood, that ends the steps.
_COST_TOL = 0.5
# Smallest standard deviation of the image coordinates [px], for exact images.
_MIN_SIGMA = 1e-3
# Smallest square of the norm of a column.
_MIN_SQUARE = 1e-300

# Points of a board, (m, 3) [m], and their pixels, (m, 2).
View = tuple[Array, Array]
# Pose of the board in the camera, (4, 4) [m], and RMS distance of its corners in the image, X/Z and Y/Z.
Pose = tuple[Array, float]


@dataclass(frozen=True, eq=False)
class LensFit:
    """Lens of a camera with the poses of boards in its images.

    Attributes:
        values: Values of the lens, shape (s,) [px and 1].
        poses: Pose of the board in the camera, shape (4, 4) [m], and the RMS distance of its corners in the
            image, X/Z and Y/Z, of each view; None where the corners do not determine a pose.
        cost: Cost of the views that the lens was fitted to; NaN if it is held.
    """

    values: Array
    poses: list[Pose | None]
    cost: float = float("nan")


def fit_lens(views: Sequence[View], lens: Lens, values: Array, std: Array) -> LensFit:
    """Fit the lens of a camera and the poses of boards to its images.

    Args:
        views: Points of a board, shape (m, 3) [m], and their pixels, shape (m, 2), of each view.
        lens: Lens model.
        values: First values of the lens, shape (s,) [px and 1].
        std: Their standard deviations, shape (s,); 0 for values that are held.

    Returns:
        The fit.
    """
    poses = _choose_poses(views, lens, values, [None] * len(views))
    usable = [(i, pose) for i, pose in enumerate(poses) if pose is not None and np.isfinite(pose[1])]
    if not usable or not std.any():
        return LensFit(values, poses)
    chosen = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, _MAX_VIEWS).astype(int))]
    problem = _LensProblem([views[i] for i, _ in chosen], lens, values, std)
    values, moved, cost = problem.minimize([pose for _, pose in chosen])
    known = [None if pose is None else pose[0] for pose in poses]
    for (i, _), pose in zip(chosen, moved, strict=True):
        known[i] = pose[0]
    return LensFit(values, _choose_poses(views, lens, values, known), cost)


def _choose_poses(
    views: Sequence[View], lens: Lens, values: Array, known: Sequence[Array | None]
) -> list[Pose | None]:
    """Estimate the pose of the board in each view with a lens, from its known pose if there is one."""
    if not views:
        return []
    plane = lens.normalize(np.concatenate([pixels for _, pixels in views]).T, values).T
    parts = np.split(plane, np.cumsum([len(points) for points, _ in views])[:-1])
    return estimate_poses([(view[0], part) for view, part in zip(views, parts, strict=True)], known)


@dataclass(frozen=True, eq=False)
class _LensProblem:
    """Problem in the f free values of a lens, with the poses of v views of boards with m corners in all.

    Attributes:
        views: Views of boards.
        lens: Lens model.
        first: Values of the rig, (s,).
        std: Their standard deviations, (s,); 0 for values that are held.
    """

    views: Sequence[View]
    lens: Lens
    first: Array
    std: Array

    def minimize(self, poses: list[Pose]) -> tuple[Array, list[Pose], float]:
        """Return the values of the lens (s,), the poses with it, and the cost after damped steps."""
        values, damping = self.first, _DAMPING
        rows = self._rows(values, poses)
        cost = self._cost(rows, values)
        step = self._step(rows, values, damping)
        for _ in range(_N_STEPS):
            trial = values + step
            found = _choose_poses(self.views, self.lens, trial, [pose for pose, _ in poses])
            trial_poses = [new or old for new, old in zip(found, poses, strict=True)]
            trial_rows = self._rows(trial, trial_poses)
            trial_cost = self._cost(trial_rows, trial)
            is_better, is_done = trial_cost < cost, abs(cost - trial_cost) < _COST_TOL
            if is_better:
                values, poses, rows, cost = trial, trial_poses, trial_rows, trial_cost
            if is_done:
                break
            damping *= 0.1 if is_better else 10.0
            step = self._step(rows, values, damping)
        return values, poses, cost

    def _rows(self, values: Array, poses: Sequence[Pose]) -> list[Array]:
        """Return derivatives by lens and pose, and errors, of the views, (2m, f + 7) each [px]."""
        local = np.concatenate(
            [
                points @ pose[:3, :3].T + pose[:3, 3]
                for (points, _), (pose, _) in zip(self.views, poses, strict=True)
            ]
        )
        with np.errstate(all="ignore"):
            modelled, by_points, by_values = self.lens.project(local.T, values)
        by_points = by_points.transpose(2, 0, 1)
        rows = np.concatenate(
            [
                by_values[:, self.std > 0].transpose(2, 0, 1),
                by_points,
                np.cross(local[:, None], by_points),
                (np.concatenate([pixels for _, pixels in self.views]) - modelled.T)[..., None],
            ],
            2,
        )
        ends = np.cumsum([len(points) for points, _ in self.views])
        return [part.reshape(-1, part.shape[2]) for part in np.split(rows, ends[:-1])]

    def _variance(self, rows: list[Array]) -> float:
        """Return the most likely variance of the image coordinates [px²]."""
        squares = sum(float(part[:, -1] @ part[:, -1]) for part in rows)
        return max(squares / sum(map(len, rows)), _MIN_SIGMA**2)

    def _cost(self, rows: list[Array], values: Array) -> float:
        """Return the cost; not a number where the lens cannot be evaluated."""
        is_free = self.std > 0
        offsets = (values - self.first)[is_free] / self.std[is_free]
        return sum(map(len, rows)) * float(np.log(self._variance(rows))) + float(offsets @ offsets)

    def _step(self, rows: list[Array], values: Array, damping: float) -> Array:
        """Return the step of the values (s,) if the poses follow it."""
        is_free = self.std > 0
        weights = 1 / self.std[is_free] ** 2
        f = len(weights)
        products = np.array([part.T @ part for part in rows]) / self._variance(rows)
        own, mixed = products[:, f:-1, f:-1], products[:, :f, f:-1]
        scale = np.sqrt(np.maximum(np.einsum("vii->vi", own), _MIN_SQUARE))
        own = own / (scale[:, :, None] * scale[:, None]) + _POSE_DAMPING * np.eye(6)
        mixed = mixed / scale[:, None]
        right = np.concatenate([mixed.swapaxes(1, 2), (products[:, f:-1, -1] / scale)[..., None]], 2)
        followed = np.einsum("vij,vjk->ik", mixed, np.linalg.solve(own, right))
        normal = products[:, :f, :f].sum(0) - followed[:, :f] + np.diag(weights)
        gradient = products[:, :f, -1].sum(0) - followed[:, f] - weights * (values - self.first)[is_free]
        scale = np.sqrt(np.einsum("vii->i", products[:, :f, :f]) + weights)
        normal = normal / np.outer(scale, scale) + damping * np.eye(f)
        step = np.zeros(len(values))
        step[is_free] = np.linalg.solve(normal, gradient / scale) / scale
        return step
