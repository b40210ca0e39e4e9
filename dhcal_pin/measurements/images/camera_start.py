"""First values of cameras and boards from the images alone, without a guess.

1. Focal lengths and image centres that the rig does not state, from the views of boards.
2. The pose of each board in each image.
3. The poses of cameras and boards on the robot, pair by pair: the pair of camera and board with the most
   images in closed form (Shah 2013); then every further camera that sees a known board, and every further
   board that a known camera sees, by the mean over its images.

A pose that is stated in the rig is used as it is.

The pose of a board in an image depends on that image alone. It is remembered, as a robust start estimates
first values from many subsets of the same images; so are the focal lengths of a measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ... import se3
from ..._typing import Array
from ...cameras.boards import Board
from ...cameras.hand_eye import mean_pose, solve_hand_eye
from ...cameras.intrinsics import estimate_intrinsics
from ...cameras.pose_from_points import agreeing_points, estimate_pose
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


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Boards in images, each from its image alone: the joint values have no influence.

    Attributes:
        lenses: Values of the lens of each camera, estimated if the rig does not state them.
        sample: First sample of each view of a board, (v,).
        poses: Pose of the board in the camera, (v, 4, 4) [m].
        rms: RMS distance of its corners in the image, X/Z and Y/Z, (v,).
    """

    lenses: list[Array]
    sample: Array
    poses: Array
    rms: Array


def estimate_views(item: CameraCorners) -> BoardViews:
    """Estimate the lenses that the rig does not state, and the pose of each board in each image.

    Args:
        item: Image coordinates.

    Returns:
        Views of boards whose corners determine a pose.

    Raises:
        NotObservableError: The images do not determine the focal length of a camera.
    """
    images = _images(item)
    lenses = []
    for number, camera in enumerate(item.rig.cameras):
        lens = camera.values.copy()
        if not camera.has_intrinsics:
            views = [
                (item.rig.boards[item.board[samples[0]]].points[item.corner[samples]], item.values[samples])
                for samples in images
                if item.camera[samples[0]] == number
            ]
            lens[:4] = estimate_intrinsics(views, camera)
            lens[4:] = 0.0
        lenses.append(lens)
    found: list[tuple[int, Array, float]] = []
    for samples in images:
        camera = int(item.camera[samples[0]])
        points = item.rig.boards[item.board[samples[0]]].points[item.corner[samples]]
        plane = item.rig.cameras[camera].lens.normalize(item.values[samples].T, lenses[camera]).T
        estimate = _estimate_pose(points, plane)
        if estimate is not None and np.isfinite(estimate[1]):
            found.append((int(samples[0]), *estimate))
    return BoardViews(
        lenses,
        np.array([view[0] for view in found], int),
        np.array([view[1] for view in found]).reshape(-1, 4, 4),
        np.array([view[2] for view in found]),
    )


def first_values(item: CameraCorners, chain: Chain, is_used: Array | None = None) -> dict[str, float]:
    """Estimate the first values of all parameters of cameras and boards.

    Args:
        item: Image coordinates.
        chain: Nominal chain with base and tool.
        is_used: Whether the poses are estimated from each sample, (m,); all or none of an image. All samples
            if None.

    Returns:
        Values by parameter name [m, rad, px or 1].

    Raises:
        NotObservableError: The images do not determine a pose.
    """
    used = np.ones(len(item.rows), bool) if is_used is None else is_used
    values: dict[str, float] = {}
    views = item.board_views
    for camera, lens in zip(item.rig.cameras, views.lenses, strict=True):
        if not camera.has_intrinsics:
            names = [f"camera_{camera.name}.{name}" for name in camera.lens.names]
            values |= dict(zip(names, lens.tolist(), strict=True))
    pairs = _board_poses(item, views, chain, used)
    cameras = _stated_poses(item.rig.cameras, item.rig.camera_mounts)
    boards = _stated_poses(item.rig.boards, item.rig.board_mounts)
    _locate(item, used, pairs, cameras, boards)
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


# Poses of the links against each other (i, 4, 4) and of the board in the camera (i, 4, 4) by numbers of
# camera and board.
_Pairs = dict[tuple[int, int], tuple[Array, Array]]


def _board_poses(item: CameraCorners, views: BoardViews, chain: Chain, used: Array) -> _Pairs:
    """Collect the views of each pair of camera and board in the used samples, without badly fitting ones."""
    is_chosen = used[views.sample]
    samples, poses, rms = views.sample[is_chosen], views.poses[is_chosen], views.rms[is_chosen]
    tools = chain.poses(item.q[samples])
    out: _Pairs = {}
    pairs = np.stack([item.camera[samples], item.board[samples]], 1)
    for camera, board in dict.fromkeys(map(tuple, pairs.tolist())):
        of_pair = np.flatnonzero(np.all(pairs == [camera, board], 1))
        good = of_pair[rms[of_pair] <= max(_MAX_RATIO * float(np.median(rms[of_pair])), _GOOD_RMS)]
        moves = item.rig.camera_mounts[camera].moves
        out[camera, board] = (se3.inverse(tools[good]) if moves else tools[good]), poses[good]
    return out


def _locate(
    item: CameraCorners,
    used: Array,
    pairs: _Pairs,
    cameras: dict[int, Array],
    boards: dict[int, Array],
) -> None:
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
            ("camera", item.rig.cameras, item.camera[used], cameras),
            ("board", item.rig.boards, item.board[used], boards),
        )
        for number in np.unique(used).tolist()
        if number not in known
    ]
    if missing:
        raise NotObservableError(
            f"{missing[0]}: no image determines its pose; expected images with at least 4 corners of a flat "
            "board that are not in one line, or 6 points that are not in one plane"
        )
