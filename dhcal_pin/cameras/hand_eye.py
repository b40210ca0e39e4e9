"""Closed-form poses of camera and board on a robot from several images (robot-world and hand-eye).

With the pose A_i of the link of the board in the link of the camera, known from the joint values, and the
pose P_i of the board in the camera, known from image i, the poses C of the camera and B of the board in their
links satisfy

    A_i·B = C·P_i.

The rotations are the singular vectors of the largest singular value of Σ R_Pi ⊗ R_Ai (Shah 2013); the
translations then solve linear equations. The solution is unique if the links turn against each other about at
least two axes that are not parallel.

Reference: M. Shah, Solving the Robot-World/Hand-Eye Calibration Problem Using the Kronecker Product, Journal
of Mechanisms and Robotics 5, 2013.
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


def solve_hand_eye(link_poses: Array, board_poses: Array, where: str) -> tuple[Array, Array]:
    """Solve A_i·B = C·P_i for the poses of camera and board in their links.

    Args:
        link_poses: Pose A_i of the board's link in the camera's link, shape (i, 4, 4) [m].
        board_poses: Pose P_i of the board in the camera, shape (i, 4, 4) [m].
        where: Names of camera and board, for messages.

    Returns:
        Pose C of the camera in its link and pose B of the board in its link, each of shape (4, 4) [m].

    Raises:
        NotObservableError: There are too few images, or the links turn about one axis only.
    """
    if len(link_poses) < MIN_IMAGES:
        images = "usable image" if len(link_poses) == 1 else "usable images"
        raise NotObservableError(
            f"{where}: {len(link_poses)} {images}; expected at least {MIN_IMAGES} at different joint values"
        )
    _require_two_axes(link_poses[:, :3, :3], where)
    a, p = link_poses[:, :3, :3], board_poses[:, :3, :3]
    # With column-major vectors, vec(R_A·R_B·R_Pᵀ) = (R_P ⊗ R_A)·vec(R_B).
    kronecker = np.einsum("iab,icd->acbd", p, a).reshape(9, 9) / len(a)
    u, _, vt = np.linalg.svd(kronecker)
    rotation_c, rotation_b = (vector.reshape(3, 3).T for vector in (u[:, 0], vt[0]))
    if np.linalg.det(rotation_b) < 0:
        rotation_b, rotation_c = -rotation_b, -rotation_c
    rotation_b, rotation_c = se3.nearest_rotation(rotation_b), se3.nearest_rotation(rotation_c)
    # R_A·b + t_A = R_C·t_P + c.
    rows = np.concatenate([a, np.broadcast_to(-np.eye(3), a.shape)], 2).reshape(-1, 6)
    right = board_poses[:, :3, 3] @ rotation_c.T - link_poses[:, :3, 3]
    translation = np.linalg.lstsq(rows, right.ravel(), rcond=None)[0]
    return se3.transform(rotation_c, translation[3:]), se3.transform(rotation_b, translation[:3])


def _require_two_axes(rotations: Array, where: str) -> None:
    """Raise an error if rotations (i, 3, 3) differ by turns about one axis only."""
    mean = se3.nearest_rotation(rotations.sum(0))
    turns = se3.log3(np.swapaxes(rotations, 1, 2) @ mean)
    spread = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if spread[1] < MIN_SECOND_ROTATION:
        raise NotObservableError(
            f"{where}: the images differ by rotations about one axis only (second axis "
            f"{np.rad2deg(spread[1]):.2g} deg); expected at least two rotations about non-parallel axes: "
            "turn the wrist about different axes between the images"
        )


def mean_pose(poses: Array) -> Array:
    """Compute the mean of poses that nearly agree.

    Args:
        poses: Poses, shape (i, 4, 4) [m].

    Returns:
        Pose with the nearest rotation to the mean and the median position, shape (4, 4) [m].
    """
    return se3.transform(se3.nearest_rotation(poses[:, :3, :3].sum(0)), np.median(poses[:, :3, 3], 0))
