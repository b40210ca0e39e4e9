"""Cameras and boards of a rig as lines of a scene: viewing pyramids, boards, and lines of sight."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import se3
from .._typing import Array
from ..cameras.boards import Board
from ..cameras.rig import Camera
from ..measurements.mounting import MountedRig

# Depth of a viewing pyramid as a fraction of the size of the scene.
_PYRAMID_DEPTH = 0.12


def rig_lines(rig: MountedRig, base: Array, size: float) -> dict[str, Any]:
    """Describe the cameras and boards of a rig for the page of a scene of the given size [m].

    `parts` are cameras and boards, each with `name`, `moves` (whether with the tool) and `segments`, pairs of
    points in the frame of the base link or of the tool [m]. `rays` are pairs of a camera and a board that a
    joint moves against each other, each with the numbers of both parts, the `centre` of the camera and the
    outer `corners` of the board.
    """
    cameras = [
        (
            camera.name,
            mount.moves,
            rig.camera_in_end(i),
            _pyramid(camera, _PYRAMID_DEPTH * size),
            np.zeros((1, 3)),
        )
        for i, (camera, mount) in enumerate(zip(rig.cameras, rig.camera_mounts, strict=True))
    ]
    boards = [
        (board.name, mount.moves, rig.board_in_end(i), *_board(board))
        for i, (board, mount) in enumerate(zip(rig.boards, rig.board_mounts, strict=True))
    ]
    parts, anchors = [], []
    for name, moves, pose, segments, points in (*cameras, *boards):
        # The page draws in the frame of the base link.
        in_frame = pose if moves else se3.inverse(base) @ pose
        ends = se3.transform_points(in_frame, segments.reshape(-1, 3))
        parts.append({"name": name, "moves": bool(moves), "segments": np.round(ends, 6).tolist()})
        anchors.append(np.round(se3.transform_points(in_frame, points), 6))
    rays = [
        {
            "camera": i,
            "board": len(cameras) + j,
            "centre": anchors[i][0].tolist(),
            "corners": anchors[len(cameras) + j].tolist(),
        }
        for i, camera in enumerate(cameras)
        for j, board in enumerate(boards)
        if camera[1] != board[1]
    ]
    return {"parts": parts, "rays": rays}


def _pyramid(camera: Camera, depth: float) -> Array:
    """Return the edges (s, 2, 3) of the viewing pyramid of a camera, in its frame [m]."""
    right, low = camera.width - 0.5, camera.height - 0.5
    pixels = np.array([[-0.5, right, right, -0.5], [-0.5, -0.5, low, low]])
    plane = camera.lens.normalize(pixels, camera.values)
    corners = depth * np.column_stack([plane.T, np.ones(4)])
    # A triangle above the upper edge of the image shows which way is up.
    middle = 0.5 * (corners[0] + corners[1])
    top = middle + 0.25 * (corners[0] - corners[3])
    upper = [middle + 0.3 * (corner - middle) for corner in corners[:2]]
    edges = [(np.zeros(3), corner) for corner in corners]
    edges += [(corners[i - 1], corners[i]) for i in range(4)]
    edges += [(upper[0], top), (upper[1], top), (upper[0], upper[1])]
    return np.array(edges)


def _board(board: Board) -> tuple[Array, Array]:
    """Return the lines (s, 2, 3) of a board and its outer corners (c, 3), in its frame [m]."""
    points = board.points
    if board.type == "points":
        middle = points.mean(0)
        return np.array([(middle, point) for point in points]), points
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    outer = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]])
    lines = [(outer[i - 1], outer[i]) for i in range(4)]
    for x in np.unique(np.round(points[:, 0], 9)):
        lines.append((np.array([x, low[1], 0]), np.array([x, high[1], 0])))
    for y in np.unique(np.round(points[:, 1], 9)):
        lines.append((np.array([low[0], y, 0]), np.array([high[0], y, 0])))
    return np.array(lines), outer
