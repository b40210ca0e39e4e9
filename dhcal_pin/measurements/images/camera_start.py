"""First values of cameras and boards from the images alone, without a guess.

1. The lens of each camera and the pose of each board in each image, from its images alone
   (`cameras.lens_fit`). With a wrong distortion many boards appear tilted the other way. The lens itself
   is a first value only where the rig states no focal lengths.
2. The poses of cameras and boards on the robot, pair by pair: the pair of camera and board with the most
   images in closed form (Shah 2013); then every further camera that sees a known board, and every further
   board that a known camera sees, by the mean over its images.

A pose that is stated in the rig is used as it is.

The joint values have no influence on lenses and poses in images. They are remembered, as a robust start
estimates first values from many subsets of the same images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TypeVar

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array
from ...cameras.boards import Board
from ...cameras.hand_eye import choose_poses, mean_pose, solve_hand_eye
from ...cameras.lens_fit import LensFit, fit_camera
from ...cameras.pose_from_points import agreeing_points, pose_information
from ...cameras.rig import Camera
from ...exceptions import NotObservableError
from ...robot.chain import Chain
from ...robot.conditions import Conditions
from ..mounting import Mount, MountedRig
from .camera_parameters import POSE_NAMES

# Largest RMS distance in the image, X/Z and Y/Z, of a pose that is used, as a multiple of the median one.
_MAX_RATIO = 5.0
# RMS distance that is never too large: half a percent of the focal length.
_GOOD_RMS = 5e-3
# Smallest variance of an image coordinate [px²]; exact images have none.
_MIN_VARIANCE = 1e-12
# Largest number of images, and of fits of lenses, that are remembered.
_MAX_REMEMBERED, _MAX_FITS = 2000, 32

_R = TypeVar("_R")


def _remember(function: Callable[[Array, Array], _R]) -> Callable[[Array, Array], _R]:
    """Remember the results of a function of points (m, 3) and image coordinates (m, 2)."""

    @lru_cache(_MAX_REMEMBERED)
    def of_bytes(points: bytes, image: bytes) -> _R:
        return function(np.frombuffer(points).reshape(-1, 3), np.frombuffer(image).reshape(-1, 2))

    return lambda points, image: of_bytes(points.tobytes(), image.tobytes())


_agreeing_points = _remember(agreeing_points)


@frozen(eq=False)
class BoardViews:
    """Boards in images, each from its image alone: the joint values have no influence."""

    lenses: list[Array]  # Values of the lens of each camera
    sample: Array  # First sample of each view of a board, (v,)
    # Poses of the board in the camera that explain the image, the better one first, (v, 2, 4, 4) [m]. Both
    # are the same if there is only one.
    poses: Array
    rms: Array  # RMS distance of its corners in the image with the better one, X/Z and Y/Z, (v,)


@frozen(eq=False)
class Corners:
    """Image coordinates of m corners."""

    conditions: Conditions  # Joint positions and conditions of each corner
    values: Array  # Image coordinates, (m, 2) [px]
    rig: MountedRig  # Cameras and boards on the chain
    camera: Array  # Number of the camera of each corner, (m,)
    board: Array  # Number of the board of each corner, (m,)
    corner: Array  # Number of each corner on its board, (m,)
    image: Array  # Number of the image of each corner, (m,)


def estimate_views(item: Corners) -> BoardViews:
    """Estimate the lens of each camera, and the pose of each board in each image."""
    images = _images(item)
    lenses: list[Array] = []
    found: list[tuple[int, Array, float]] = []
    for number, camera in enumerate(item.rig.cameras):
        own = [samples for samples in images if item.camera[samples[0]] == number]
        boards = [item.rig.boards[item.board[samples[0]]] for samples in own]
        views = tuple(
            (board.points[item.corner[samples]].tobytes(), item.values[samples].tobytes())
            for board, samples in zip(boards, own, strict=True)
        )
        fit = _fit_camera(camera, views, any(board.has_free_points for board in boards))
        lenses.append(fit.values)
        for samples, poses in zip(own, fit.poses, strict=True):
            if poses and np.isfinite(poses[0][1]):
                both = [pose for pose, rms in poses[:2] if rms <= _MAX_RATIO * poses[0][1]]
                found.append((int(samples[0]), np.array([both[0], both[-1]]), poses[0][1]))
    found.sort(key=lambda view: view[0])
    return BoardViews(
        lenses,
        np.array([view[0] for view in found], int),
        np.array([view[1] for view in found]).reshape(-1, 2, 4, 4),
        np.array([view[2] for view in found]),
    )


@lru_cache(_MAX_FITS)
def _fit_camera(camera: Camera, content: tuple[tuple[bytes, bytes], ...], repeats_errors: bool) -> LensFit:
    """Fit the lens of a camera and the poses of boards to views: bytes of points and pixels."""
    views = [
        (np.frombuffer(points).reshape(-1, 3), np.frombuffer(pixels).reshape(-1, 2))
        for points, pixels in content
    ]
    return fit_camera(views, camera, repeats_errors=repeats_errors)


def first_values(item: Corners, views: BoardViews, chain: Chain, used: Array) -> dict[str, float]:
    """Estimate the first values of all parameters of cameras and boards from the used samples (m,)."""
    values: dict[str, float] = {}
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
            numbers = se3.position_and_rotvec(se3.inverse(mounts[number].link_pose) @ pose)
            names = [f"{prefix}_{entries[number].name}.{name}" for name in POSE_NAMES]
            values |= dict(zip(names, numbers.tolist(), strict=True))
    return values


def moving_poses(item: Corners, views: BoardViews) -> tuple[Array, Array]:
    """Return samples (k,) and poses (k, 4, 4) of the moving one of camera and board in the other one."""
    pairs = np.stack([item.camera, item.board], 1)[views.sample]
    camera_moves, board_moves = (
        np.array([mount.moves for mount in mounts], bool)[pairs[:, i]]
        for i, mounts in enumerate((item.rig.camera_mounts, item.rig.board_mounts))
    )
    is_usable = camera_moves != board_moves
    labels, counts = np.unique(pairs[is_usable], axis=0, return_counts=True)
    if not len(labels):  # no camera and board move against each other
        return np.empty(0, int), np.empty((0, 4, 4))
    # Those of the pair with the most views are poses of the tool for some base and some tool.
    of_pair = np.flatnonzero(np.all(pairs == labels[np.argmax(counts)], 1))
    good = _well_fitting(views.rms, of_pair)
    poses = views.poses[good, 0]
    return views.sample[good], se3.inverse(poses) if camera_moves[good[0]] else poses


def _well_fitting(rms: Array, of_pair: Array) -> Array:
    """Return the views of a pair of camera and board, by number, without badly fitting ones."""
    return of_pair[rms[of_pair] <= max(_MAX_RATIO * float(np.median(rms[of_pair])), _GOOD_RMS)]


def moving_information(item: Corners, views: BoardViews, samples: Array) -> Array:
    """Return the information about twists of the poses of `moving_poses`, (k, 6, 6)."""
    if not len(samples):
        return np.empty((0, 6, 6))
    number = {int(sample): i for i, sample in enumerate(views.sample)}
    keys = np.column_stack([item.image, item.board])
    out = []
    for sample in samples.tolist():
        pose = views.poses[number[sample], 0]
        own = np.all(keys == keys[sample], 1)
        points = item.rig.boards[item.board[sample]].points[item.corner[own]]
        information = pose_information(pose, points)
        if item.rig.camera_mounts[item.camera[sample]].moves:
            # The twists are in the frame of the one that stands still.
            by_twist = se3.adjoint(pose)
            information = by_twist.T @ information @ by_twist
        out.append(information)
    # Half of the square of a distance in the image is the variance of a coordinate.
    return np.array(out) / max(0.5 * np.median(views.rms) ** 2, _MIN_VARIANCE)


def _stated_poses(entries: Sequence[Camera] | Sequence[Board], mounts: Sequence[Mount]) -> dict[int, Array]:
    """Return the poses in the frames of the ends that the rig states, by number."""
    pairs = enumerate(zip(entries, mounts, strict=True))
    return {i: mount.link_pose @ entry.pose for i, (entry, mount) in pairs if entry.pose is not None}


def _images(item: Corners) -> list[Array]:
    """Return the samples of each image of one board, without those that disagree with most others."""
    keys = np.column_stack([item.image, item.board])
    label = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(label, kind="stable")
    images = np.split(order, np.cumsum(np.bincount(label))[:-1])
    return [samples[_agreeing(item, samples)] for samples in images if len(samples)]


def _agreeing(item: Corners, samples: Array) -> Array:
    """Return which samples of an image of one board belong to the same view of the board."""
    board = item.rig.boards[item.board[samples[0]]]
    return _agreeing_points(board.points[item.corner[samples]], item.values[samples])


# Poses of the links against each other (i, 4, 4) and of the board in the camera (i, 2, 4, 4) by numbers of
# camera and board.
_Pairs = dict[tuple[int, int], tuple[Array, Array]]


def _board_poses(item: Corners, views: BoardViews, chain: Chain, used: Array) -> _Pairs:
    """Collect the views of each pair of camera and board in the used samples, without badly fitting ones."""
    is_chosen = used[views.sample]
    samples, poses, rms = views.sample[is_chosen], views.poses[is_chosen], views.rms[is_chosen]
    tools = chain.poses(item.conditions[samples])
    out: _Pairs = {}
    pairs = np.stack([item.camera[samples], item.board[samples]], 1)
    for camera, board in dict.fromkeys(map(tuple, pairs.tolist())):
        of_pair = np.flatnonzero(np.all(pairs == [camera, board], 1))
        good = _well_fitting(rms, of_pair)
        moves = item.rig.camera_mounts[camera].moves
        out[camera, board] = (se3.inverse(tools[good]) if moves else tools[good]), poses[good]
    return out


def _locate(
    item: Corners,
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
            boards[board] = mean_pose((se3.inverse(links) @ cameras[camera])[:, None] @ poses)
        elif board in boards:
            cameras[camera] = mean_pose((links @ boards[board])[:, None] @ se3.inverse(poses))
        else:
            names = f"camera {item.rig.cameras[camera].name!r} and board {item.rig.boards[board].name!r}"
            chosen = choose_poses(links, poses)
            cameras[camera], boards[board] = solve_hand_eye(links, chosen, names)
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
            f"{missing[0]}: no image determines its pose; expected images with at least 4 corners of a board "
            "that are not in one line"
        )
