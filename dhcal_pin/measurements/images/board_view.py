"""View of a board: in which poses of the tool a camera sees it well enough to find its corners."""

from __future__ import annotations

import numpy as np

from ..._frozen import frozen
from ..._typing import Array
from ..mounting import MountedRig


@frozen
class ViewLimits:
    """Limits of a useful view of a board."""

    #: Smallest distance of the middle of the board from the camera [m]; nearer is not sharp.
    min_distance: float
    max_distance: float  #: Largest distance [m].
    #: Largest angle between the normal of the board and the line of sight [rad].
    max_angle: float = np.deg2rad(50.0)
    min_share: float = 1.0  #: Smallest share of the corners in the image.
    margin: float = 10.0  #: Distance of a corner from the edge of the image [px].


def project_board(
    rig: MountedRig, camera: int, board: int, poses: Array, chosen: Array | slice = np.s_[:]
) -> tuple[Array, Array]:
    """Project the corners of a board, or some of them."""
    points = rig.boards[board].points[chosen]
    local = np.einsum("mij,cj->mci", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    lens, values = rig.cameras[camera].lens, rig.cameras[camera].values
    pixels = lens.project(local.reshape(-1, 3).T, values)[0].T
    return pixels.reshape(len(poses), len(points), 2), local[..., 2]


def visible_corners(rig: MountedRig, camera: int, board: int, poses: Array, limits: ViewLimits) -> Array:
    """Return which corners of a board a camera sees."""
    middle = poses[:, :3, :3] @ rig.boards[board].points.mean(0) + poses[:, :3, 3]
    distance = np.linalg.norm(middle, axis=1)
    # The z axis of a flat board points away from its printed side.
    along = np.einsum("mi,mi->m", poses[:, :3, 2], middle)
    in_view = (distance >= limits.min_distance) & (distance <= limits.max_distance) & (middle[:, 2] > 0)
    if rig.boards[board].type != "points":
        in_view &= along >= np.cos(limits.max_angle) * distance
    near, last = np.flatnonzero(in_view), np.array([rig.cameras[camera].width, rig.cameras[camera].height])

    def is_in_image(chosen: Array | slice) -> Array:
        pixels, depth = project_board(rig, camera, board, poses[near], chosen)
        inside = (pixels >= limits.margin) & (pixels <= last - 1 - limits.margin)
        return np.all(inside, 2) & (depth > 0)

    if limits.min_share == 1:
        # All corners are in the image only if the outer ones are.
        along = rig.boards[board].points @ np.column_stack([np.eye(3), np.ones(3)])
        near = near[is_in_image(np.unique([along.argmin(0), along.argmax(0)])).all(1)]
    is_inside = is_in_image(np.s_[:])
    out = np.zeros((len(poses), is_inside.shape[1]), bool)
    out[near] = is_inside & (is_inside.mean(1) >= limits.min_share)[:, None]
    return out


def is_board_in_view(rig: MountedRig, camera: int, board: int, tools: Array, limits: ViewLimits) -> Array:
    """Return in which poses of the tool a camera sees a board."""
    poses = rig.board_in_camera(camera, board, tools)
    return np.any(visible_corners(rig, camera, board, poses, limits), 1)
