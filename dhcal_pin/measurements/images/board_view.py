"""View of a board: in which poses of the tool a camera sees it well enough to find its corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._typing import Array
from ..mounting import MountedRig


@dataclass(frozen=True)
class ViewLimits:
    """Limits of a useful view of a board."""

    #: Smallest distance of the middle of the board from the camera [m]; nearer is not sharp.
    min_distance: float = 0.2
    max_distance: float = 1.5  #: Largest distance [m].
    #: Largest angle between the normal of the board and the line of sight [rad].
    max_angle: float = np.deg2rad(50.0)
    min_share: float = 1.0  #: Smallest share of the corners in the image.
    margin: float = 10.0  #: Distance of a corner from the edge of the image [px].


def project_board(rig: MountedRig, camera: int, board: int, poses: Array) -> tuple[Array, Array]:
    """Project all corners of a board."""
    points = rig.boards[board].points
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
    near = np.flatnonzero(in_view)
    pixels, depth = project_board(rig, camera, board, poses[near])
    last = np.array([rig.cameras[camera].width, rig.cameras[camera].height]) - 1 - limits.margin
    is_inside = np.all((pixels >= limits.margin) & (pixels <= last), 2) & (depth > 0)
    out = np.zeros((len(poses), is_inside.shape[1]), bool)
    out[near] = is_inside & (is_inside.mean(1) >= limits.min_share)[:, None]
    return out


def is_board_in_view(rig: MountedRig, camera: int, board: int, tools: Array, limits: ViewLimits) -> Array:
    """Return in which poses of the tool a camera sees a board."""
    poses = rig.board_in_camera(camera, board, tools)
    return np.any(visible_corners(rig, camera, board, poses, limits), 1)
