"""Closed-form poses of camera and board on a robot from several images (robot-world and hand-eye).

With the pose A_i of the link of the board in the link of the camera, known from the joint values, and the
pose P_i of the board in the camera, known from image i, the poses C of the camera and B of the board in their
links satisfy

    A_i·B = C·P_i.

The rotations are the singular vectors of the largest singular value of Σ R_Pi ⊗ R_Ai (Shah 2013); the
translations then solve linear equations. The solution is unique if the links turn against each other about at
least two axes that are not parallel.

Two poses of a flat board can explain one image. If the better ones of all images contradict each other, the
rotations are also solved from random images with either pose (RANSAC, Fischler and Bolles 1981). The poses
that agree best are used.

References:
    M. Shah, Solving the Robot-World/Hand-Eye Calibration Problem Using the Kronecker Product, Journal of
    Mechanisms and Robotics 5, 2013.
    M. A. Fischler and R. C. Bolles, Random Sample Consensus, Communications of the ACM 24, 1981.
"""

from __future__ import annotations

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import NotObservableError

# Smallest number of images.
MIN_IMAGES = 3
# Smallest rotation about a second axis [rad]: RMS of the second principal component of the rotation vectors.
MIN_SECOND_ROTATION = 0.02
# Median angle between poses and their prediction below which they agree [rad], largest angle that counts.
_GOOD_ANGLE, _MAX_ANGLE = 0.1, 0.5
# Number of random choices, of images in each of them, and of choices after them.
_N_SAMPLES, _SAMPLE_SIZE, _N_CHOICES = 300, 4, 5


def solve_hand_eye(link_poses: Array, board_poses: Array, where: str) -> tuple[Array, Array]:
    """Solve A_i·B = C·P_i, (i, 4, 4) [m], for the poses C of the camera and B of the board in their links."""
    # A_i is the pose of the board's link in the camera's link, P_i that of the board in the camera. Too few
    # images, or links that turn about one axis only, raise `NotObservableError`.
    if len(link_poses) < MIN_IMAGES:
        images = "usable image" if len(link_poses) == 1 else "usable images"
        raise NotObservableError(
            f"{where}: {len(link_poses)} {images}; expected at least {MIN_IMAGES} at different joint values"
        )
    _require_two_axes(link_poses[:, :3, :3], where)
    a = link_poses[:, :3, :3]
    rotation_c, rotation_b = _solve_rotations(a, board_poses[:, :3, :3])
    # R_A·b + t_A = R_C·t_P + c.
    rows = np.concatenate([a, np.broadcast_to(-np.eye(3), a.shape)], 2).reshape(-1, 6)
    right = board_poses[:, :3, 3] @ rotation_c.T - link_poses[:, :3, 3]
    translation = np.linalg.lstsq(rows, right.ravel(), rcond=None)[0]
    return se3.transform(rotation_c, translation[3:]), se3.transform(rotation_b, translation[:3])


def _solve_rotations(a: Array, p: Array) -> tuple[Array, Array]:
    """Solve for the rotations (..., 3, 3) of camera and board; a and p are (..., i, 3, 3)."""
    # With column-major vectors, vec(R_A·R_B·R_Pᵀ) = (R_P ⊗ R_A)·vec(R_B).
    kronecker = np.einsum("...iab,...icd->...acbd", p, a).reshape(*a.shape[:-3], 9, 9)
    u, _, vt = np.linalg.svd(kronecker)
    rotation_c, rotation_b = (
        vector.reshape(*a.shape[:-3], 3, 3).swapaxes(-1, -2) for vector in (u[..., 0], vt[..., 0, :])
    )
    sign = np.sign(np.linalg.det(rotation_b))[..., None, None]
    return se3.nearest_rotation(sign * rotation_c), se3.nearest_rotation(sign * rotation_b)


def choose_poses(link_poses: Array, candidates: Array) -> Array:
    """Choose of the candidates (i, k, 4, 4) of each image the pose that agrees with the other images."""
    a, p = link_poses[:, :3, :3], candidates[..., :3, :3]
    images = np.arange(len(a))
    if len(a) < MIN_IMAGES:
        return candidates[:, 0]
    angles = _angles(a, p, *_solve_rotations(a, p[:, 0]))
    if np.median(angles[:, 0]) > _GOOD_ANGLE:
        rng = np.random.default_rng(0)
        drawn = np.argsort(rng.random((_N_SAMPLES, len(a))), 1)[:, :_SAMPLE_SIZE]
        solved = _solve_rotations(a[drawn], p[drawn, rng.integers(p.shape[1], size=drawn.shape)])
        trials = np.concatenate([angles[None], _angles(a, p, *solved)])
        angles = trials[np.argmin(np.sum(np.minimum(trials.min(2), _MAX_ANGLE) ** 2, 1))]
    chosen = np.argmin(angles, 1)
    for _ in range(_N_CHOICES):
        angles = _angles(a, p, *_solve_rotations(a, p[images, chosen]))
        before, chosen = chosen, np.argmin(angles, 1)
        if np.array_equal(chosen, before):
            break
    return candidates[images, chosen]


def _angles(a: Array, p: Array, rotation_c: Array, rotation_b: Array) -> Array:
    """Return the angles (..., i, k) of rotations p (i, k, 3, 3) to those that camera and board predict."""
    predicted = rotation_c.swapaxes(-1, -2)[..., None, :, :] @ a @ rotation_b[..., None, :, :]
    return se3.angles_of_traces(np.einsum("...iab,ikab->...ik", predicted, p))


def _require_two_axes(rotations: Array, where: str) -> None:
    """Raise an error if rotations (i, 3, 3) differ by turns about one axis only."""
    mean = se3.nearest_rotation(rotations.sum(0))
    turns = se3.log3(np.swapaxes(rotations, 1, 2) @ mean)
    spread = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if spread[1] < MIN_SECOND_ROTATION:
        raise NotObservableError(
            f"{where}: the images differ by rotations about one axis only (second axis "
            f"{np.rad2deg(spread[1]):.2g} deg); expected at least two rotations about non-parallel axes: "
            "turn the wrist about different axes between the images, or state the pose of the camera or of "
            "the board in the rig file (xyz_m, rotvec_rad)"
        )


def mean_pose(candidates: Array) -> Array:
    """Compute the mean of the poses of several images that agree best."""
    rotations = candidates[..., :3, :3]
    angles = se3.angles_of_traces(np.einsum("jlab,ikab->jlik", rotations, rotations))
    angles = angles.reshape(-1, *candidates.shape[:2])
    central = angles[np.argmin(np.sum(np.minimum(angles.min(2), _MAX_ANGLE), 1))]
    poses = candidates[np.arange(len(candidates)), np.argmin(central, 1)]
    return se3.transform(se3.nearest_rotation(poses[:, :3, :3].sum(0)), np.median(poses[:, :3, 3], 0))
