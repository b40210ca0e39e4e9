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
from dataclasses import replace

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..subsampling import evenly_spaced_indices
from .intrinsics import intrinsics_candidates, undetermined_focal_length
from .lens import FOCAL_AND_CENTRE, Lens
from .pose_from_points import MIN_POINTS, estimate_poses
from .rig import DISTORTION_PRIORS, PIXEL_PRIORS, Camera

# Largest number of views among which those of the fit are chosen, of views that the lens is fitted to, and of
# trial steps.
_MAX_EXAMINED, _MAX_VIEWS, _N_STEPS = 60, 30, 20
# First damping of the lens, and damping of the poses, which are determined.
_DAMPING, _POSE_DAMPING = 1e-3, 1e-9
# Change of the cost, twice the negative logarithm of the likelihood, that ends the steps.
_COST_TOL = 0.5
# Smallest standard deviation of the image coordinates [px], for exact images.
_MIN_SIGMA = 1e-3
# Focal lengths that are tried if no method determines one, as multiples of the larger side of the image, and
# largest standard deviation of the found ones relative to their values.
_FOCAL_LENGTHS, _MAX_FOCAL_STD = (0.35, 0.7, 1.4, 2.8, 5.6), 0.1
# Smallest square of the norm of a column.
_MIN_SQUARE = 1e-300

# Points of a board, (m, 3) [m], and their pixels, (m, 2).
View = tuple[Array, Array]
# Pose of the board in the camera, (4, 4) [m], and RMS distance of its corners in the image, X/Z and Y/Z.
Pose = tuple[Array, float]


@frozen(eq=False)
class LensFit:
    """Lens of a camera with the poses of boards in its images."""

    values: Array  # Values of the lens, shape (s,) [px and 1]
    # Poses of the board in the camera that explain each view, shape (4, 4) [m], with the RMS distance of its
    # corners in the image, X/Z and Y/Z, the smallest first; none where the corners do not determine a pose.
    poses: list[list[Pose]]
    cost: float  # Cost of the views that the lens was fitted to; NaN if it is held
    std: Array  # Standard deviations of the values after the fit, shape (s,); 0 if they are held


def fit_camera(views: Sequence[View], camera: Camera, *, repeats_errors: bool = False) -> LensFit:
    """Fit the lens of a camera and the poses of boards to its images, starting from the lens of the rig."""
    std = _lens_widths(camera)
    usable = [view for view in views if len(view[0]) >= MIN_POINTS]
    drawn = views
    if std.any() and len(usable) > _MAX_EXAMINED:
        drawn = [usable[i] for i in evenly_spaced_indices(len(usable), _MAX_EXAMINED)]
    if camera.has_intrinsics:
        fit = fit_lens(drawn, camera.lens, camera.values, std, repeats_errors=repeats_errors)
    else:
        fit = fit_unknown_lens(drawn, camera, std, repeats_errors=repeats_errors)
    if drawn is views:
        return fit
    return replace(fit, poses=fit_lens(views, camera.lens, fit.values, 0 * std).poses)


def _lens_widths(camera: Camera) -> Array:
    """Return the standard deviations of the first values of a lens, (s,) [px and 1]; 0 if they are fixed."""
    # Few images determine a lens badly. It stays near stated values, even if the calibration frees them.
    n_coefficients = len(camera.lens.coefficients)
    if camera.intrinsics == "fixed":
        return np.zeros(len(FOCAL_AND_CENTRE) + n_coefficients)
    pixels = PIXEL_PRIORS["prior" if camera.has_intrinsics else "free"]
    return np.repeat([pixels, DISTORTION_PRIORS["prior"]], [len(FOCAL_AND_CENTRE), n_coefficients])


def fit_lens(
    views: Sequence[View], lens: Lens, values: Array, std: Array, *, repeats_errors: bool = False
) -> LensFit:
    """Fit the lens of a camera, but for values of std 0, and the poses of boards to its images."""
    # All views count as one if `repeats_errors`: points are wrong, and so in every view.
    poses = _find_poses(views, lens, values, [None] * len(views))
    usable = [(i, found[0]) for i, found in enumerate(poses) if found and np.isfinite(found[0][1])]
    known = [found[0][0] if found else None for found in poses]
    if not usable or not std.any():
        held = np.zeros(len(values))
        return LensFit(values, _find_poses(views, lens, values, known), float("nan"), held)
    chosen = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, _MAX_VIEWS).astype(int))]
    n_repeats = len(chosen) if repeats_errors else 1
    problem = _LensProblem([views[i] for i, _ in chosen], lens, values, std, n_repeats)
    values, moved, cost, widths = problem.minimize([pose for _, pose in chosen])
    for (i, _), pose in zip(chosen, moved, strict=True):
        known[i] = pose[0]
    return LensFit(values, _find_poses(views, lens, values, known), cost, widths)


def fit_unknown_lens(views: Sequence[View], camera: Camera, std: Array, *, repeats_errors: bool) -> LensFit:
    """Fit the lens of a camera whose focal lengths are not known."""
    candidates = intrinsics_candidates(views, camera)
    size = max(camera.width, camera.height)
    starts = candidates or [(size * each, size * each, *camera.image_centre) for each in _FOCAL_LENGTHS]
    n_more = len(camera.values) - len(FOCAL_AND_CENTRE)
    fits = [
        fit_lens(views, camera.lens, np.pad(start, (0, n_more)), std, repeats_errors=repeats_errors)
        for start in starts
    ]
    best = min(fits, key=lambda fit: fit.cost)
    if not candidates and not np.all(best.std[:2] < _MAX_FOCAL_STD * best.values[:2]):
        raise undetermined_focal_length(camera)
    return best


def _find_poses(
    views: Sequence[View], lens: Lens, values: Array, known: Sequence[Array | None]
) -> list[list[Pose]]:
    """Estimate the poses of the board in each view with a lens, from its known pose if there is one."""
    if not views:
        return []
    plane = lens.normalize(np.concatenate([pixels for _, pixels in views]).T, values).T
    parts = np.split(plane, np.cumsum([len(points) for points, _ in views])[:-1])
    return estimate_poses([(view[0], part) for view, part in zip(views, parts, strict=True)], known)


@frozen(eq=False)
class _LensProblem:
    """Problem in the f free values of a lens, with the poses of v views of boards with m corners in all."""

    views: Sequence[View]
    lens: Lens
    first: Array  # Values of the rig, (s,)
    std: Array  # Their standard deviations, (s,); 0 for values that are held
    n_repeats: int  # Number of views that count as one

    def minimize(self, poses: list[Pose]) -> tuple[Array, list[Pose], float, Array]:
        """Return values of the lens (s,), the poses with it, the cost, and standard deviations (s,)."""
        values, damping = self.first, _DAMPING
        rows = self._rows(values, poses)
        cost = self._cost(rows, values)
        step = self._step(rows, values, damping)
        for _ in range(_N_STEPS):
            trial = values + step
            found = _find_poses(self.views, self.lens, trial, [pose for pose, _ in poses])
            trial_poses = [each[0] for each in found]
            trial_rows = self._rows(trial, trial_poses)
            trial_cost = self._cost(trial_rows, trial)
            is_better, is_done = trial_cost < cost, abs(cost - trial_cost) < _COST_TOL
            if is_better:
                values, poses, rows, cost = trial, trial_poses, trial_rows, trial_cost
            if is_done:
                break
            damping *= 0.1 if is_better else 10.0
            step = self._step(rows, values, damping)
        widths = np.zeros(len(values))
        normal, _, scale = self._normal_equations(rows, values)
        widths[self.std > 0] = np.sqrt(np.abs(np.diag(np.linalg.pinv(normal)))) / scale
        return values, poses, cost, widths

    def _rows(self, values: Array, poses: Sequence[Pose]) -> list[Array]:
        """Return derivatives by lens and pose, and errors, of the views, (2m, f + 7) each [px]."""
        local = np.concatenate(
            [
                se3.transform_points(pose, points)
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
        """Return the most likely variance of the image coordinates, times the repeats [px²]."""
        squares = sum(float(part[:, -1] @ part[:, -1]) for part in rows)
        return max(squares / sum(map(len, rows)), _MIN_SIGMA**2) * self.n_repeats

    def _cost(self, rows: list[Array], values: Array) -> float:
        """Return the cost; not a number where the lens cannot be evaluated."""
        is_free = self.std > 0
        offsets = (values - self.first)[is_free] / self.std[is_free]
        n_rows = sum(map(len, rows)) / self.n_repeats
        return n_rows * float(np.log(self._variance(rows))) + float(offsets @ offsets)

    def _step(self, rows: list[Array], values: Array, damping: float) -> Array:
        """Return the step of the values (s,) if the poses follow it."""
        normal, gradient, scale = self._normal_equations(rows, values)
        step = np.zeros(len(values))
        step[self.std > 0] = np.linalg.solve(normal + damping * np.eye(len(scale)), gradient) / scale
        return step

    def _normal_equations(self, rows: list[Array], values: Array) -> tuple[Array, Array, Array]:
        """Return matrix (f, f) and gradient (f,) of the scaled free values, and their scales (f,)."""
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
        return normal / np.outer(scale, scale), gradient / scale, scale
