"""First values of cameras and boards from the images alone, without a guess.

1. Focal lengths and image centres that the rig does not state, from the views of flat boards (Zhang 2000).
2. The pose of each board in each image.
3. The poses of cameras and boards on the robot, pair by pair: the pair of camera and board with the most
   images in closed form (Shah 2013); then every further camera that sees a known board, and every further
   board that a known camera sees, by the mean over its images.

A pose that is stated in the rig is used as it is.

The pose of a board in an image depends on that image alone. It is remembered, as a robust start estimates
first values from many subsets of the same images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ... import se3
from ..._typing import Array
from ...cameras.boards import Board
from ...cameras.hand_eye import mean_pose, solve_hand_eye
from ...cameras.intrinsics import estimate_intrinsics
from ...cameras.pose_from_points import FLATNESS, agreeing_points, estimate_pose
from ...cameras.rig import Camera
from ...exceptions import NotObservableError
from ...robot.chain import Chain
from ..mounting import Mount

if TYPE_CHECKING:
    from ..camera import CameraCorners

# Largest RMS distance in the image, X/Z and Y/Z, of a pose that is used, as a multiple of the median one.
_MAX_RATIO = 5.0
# RMS distance that is never too large: half a percent of the focal length.
_GOOD_RMS = 5e-3
# Largest number of images that are remembered.
_MAX_REMEMBERED = 2000

_R = TypeVar("_R")


def _remember(function: Callable[[Array, Array], _R]) -> Callable[[Array, Array], _R]:
    """Remember the results of a function of points (m, 3) and image coordinates (m, 2)."""

    @lru_cache(_MAX_REMEMBERED)
    def of_bytes(points: bytes, image: bytes) -> _R:
        return function(np.frombuffer(points).reshape(-1, 3), np.frombuffer(image).reshape(-1, 2))

    return lambda points, image: of_bytes(points.tobytes(), image.tobytes())


_agreeing_points, _estimate_pose = _remember(agreeing_points), _remember(estimate_pose)


def first_values(item: CameraCorners, chain: Chain) -> dict[str, float]:
    """Estimate the first values of all parameters of cameras and boards.

    Args:
        item: Image coordinates.
        chain: Nominal chain with base and tool.

    Returns:
        Values by parameter name [m, rad, px or 1].

    Raises:
        NotObservableError: The images do not determine a pose.
    """
    values: dict[str, float] = {}
    lenses = []
    for number, camera in enumerate(item.rig.cameras):
        lens = camera.values.copy()
        if not camera.has_intrinsics:
            lens[:4] = estimate_intrinsics(
                _flat_views(item, number), camera.width, camera.height, camera.name
            )
            lens[4:] = 0.0
            names = [f"camera_{camera.name}.{name}" for name in camera.lens.names]
            values |= dict(zip(names, lens.tolist(), strict=True))
        lenses.append(lens)
    pairs = _board_poses(item, lenses, chain)
    cameras = _stated_poses(item.rig.cameras, item.rig.camera_mounts)
    boards = _stated_poses(item.rig.boards, item.rig.board_mounts)
    _locate(item, pairs, cameras, boards)
    for prefix, poses, entries, mounts in (
        ("camera", cameras, item.rig.cameras, item.rig.camera_mounts),
        ("board", boards, item.rig.boards, item.rig.board_mounts),
    ):
        for number, pose in poses.items():
            local = se3.inverse(mounts[number].link_pose) @ pose
            numbers = np.concatenate([local[:3, 3], se3.log3(local[:3, :3])])
            names = [f"{prefix}_{entries[number].name}.{name}" for name in ("x", "y", "z", "rx", "ry", "rz")]
            values |= dict(zip(names, numbers.tolist(), strict=True))
    return values


def _stated_poses(entries: Sequence[Camera] | Sequence[Board], mounts: Sequence[Mount]) -> dict[int, Array]:
    """Return the poses in the frames of the ends that the rig states, by number."""
    pairs = enumerate(zip(entries, mounts, strict=True))
    return {i: mount.link_pose @ entry.pose for i, (entry, mount) in pairs if entry.pose is not None}


def _images(item: CameraCorners) -> list[Array]:
    """Return the samples of each image of one board, without those that disagree with most others."""
    keys = np.column_stack([item.image, item.board])
    label = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(label, kind="stable")
    images = np.split(order, np.cumsum(np.bincount(label))[:-1])
    return [samples[_agreeing(item, samples)] for samples in images if len(samples)]


def _agreeing(item: CameraCorners, samples: Array) -> Array:
    """Return which samples of an image of one board belong to the same view of the board."""
    board = item.rig.boards[item.board[samples[0]]]
    return _agreeing_points(board.points[item.corner[samples]], item.values[samples])


def _flat_views(item: CameraCorners, camera: int) -> list[tuple[Array, Array]]:
    """Return points (c, 2) and pixels (c, 2) of each image of a flat board by a camera."""
    out = []
    for samples in _images(item):
        if item.camera[samples[0]] != camera:
            continue
        points = item.rig.boards[item.board[samples[0]]].points[item.corner[samples]]
        centred = points - points.mean(0)
        _, extent, axes = np.linalg.svd(centred, full_matrices=False)
        if len(extent) == 3 and extent[2] <= FLATNESS * extent[0] and extent[1] > FLATNESS * extent[0]:
            out.append((centred @ axes[:2].T, item.values[samples]))
    return out


# Poses of the links against each other (i, 4, 4) and of the board in the camera (i, 4, 4) by numbers of
# camera and board.
_Pairs = dict[tuple[int, int], tuple[Array, Array]]


def _board_poses(item: CameraCorners, lenses: list[Array], chain: Chain) -> _Pairs:
    """Estimate the pose of each board in each image; badly fitting images are left out."""
    found: dict[tuple[int, int], list[tuple[Array, Array, float]]] = {}
    for samples in _images(item):
        camera, board = int(item.camera[samples[0]]), int(item.board[samples[0]])
        points = item.rig.boards[board].points[item.corner[samples]]
        image = item.rig.cameras[camera].lens.normalize(item.values[samples].T, lenses[camera]).T
        estimate = _estimate_pose(points, image)
        if estimate is not None and np.isfinite(estimate[1]):
            tool = chain.poses(item.q[samples[:1]])[0]
            link = se3.inverse(tool) if item.rig.camera_mounts[camera].moves else tool
            found.setdefault((camera, board), []).append((link, *estimate))
    out: _Pairs = {}
    for pair, images in found.items():
        rms = np.array([image[2] for image in images])
        good = rms <= max(_MAX_RATIO * float(np.median(rms)), _GOOD_RMS)
        out[pair] = (
            np.array([image[0] for image, use in zip(images, good, strict=True) if use]),
            np.array([image[1] for image, use in zip(images, good, strict=True) if use]),
        )
    return out


def _locate(item: CameraCorners, pairs: _Pairs, cameras: dict[int, Array], boards: dict[int, Array]) -> None:
    """Fill in the poses of cameras and boards in the frames of their ends."""
    rest = dict(pairs)
    while rest:
        linked = [pair for pair in rest if pair[0] in cameras or pair[1] in boards]
        pair = max(linked or rest, key=lambda each: len(rest[each][0]))
        links, poses = rest.pop(pair)
        camera, board = pair
        if camera in cameras and board in boards:
            continue
        if camera in cameras:
            boards[board] = mean_pose(se3.inverse(links) @ cameras[camera] @ poses)
        elif board in boards:
            cameras[camera] = mean_pose(links @ boards[board] @ se3.inverse(poses))
        else:
            names = f"camera {item.rig.cameras[camera].name!r} and board {item.rig.boards[board].name!r}"
            cameras[camera], boards[board] = solve_hand_eye(links, poses, names)
    missing = [
        f"{what} {entries[number].name!r}"
        for what, entries, used, known in (
            ("camera", item.rig.cameras, item.camera, cameras),
            ("board", item.rig.boards, item.board, boards),
        )
        for number in np.unique(used).tolist()
        if number not in known
    ]
    if missing:
        raise NotObservableError(
            f"{missing[0]}: no image determines its pose; expected images with at least 4 corners of a flat "
            "board that are not in one line, or 6 points that are not in one plane"
        )
