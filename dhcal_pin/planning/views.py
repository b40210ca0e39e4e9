"""Views of boards: limits of a useful view, random views, and how planned views fill the images.

A view is the pose of a board in a camera. It is described by the distance of the middle of the board, the
angle between the normal of the board and the line of sight, the azimuth and the roll about the line of sight
and the normal, and the place of the middle of the board in the image.

Shapes: m configurations, c corners of a board.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..calibration.procedure import calibrate
from ..cameras.boards import Board
from ..cameras.rig import Camera
from ..exceptions import InvalidArgumentError
from ..formatting import Table
from ..measurements.base import Measurement
from ..measurements.images import ViewLimits, project_board, visible_corners
from ..measurements.mounting import MountedRig
from ..robot.chain import Chain
from ..robot.sampling import collect_draws

# Default limits: smallest size in the image of a square, of a marker, whose pattern needs more pixels [px],
# and of the board, as a share of the width of the image; all for a board that faces the camera.
MIN_SQUARE_PX, MIN_MARKER_PX, MIN_BOARD_SHARE = 20.0, 40.0, 0.1
# Default distance of corners from the edge of the image, as a share of its width.
MARGIN_SHARE = 0.02
# Default limit of the angle between the normal of a board and the line of sight [rad].
MAX_VIEW_ANGLE = np.deg2rad(60.0)
# Focal length of a usual webcam, as a share of the larger side of its image: a field of view of 60°.
FOCAL_SHARE = 0.87
# Views that are drawn at once, rounds of draws, and rounds without any view in the image before giving up.
_BATCH, _MAX_ROUNDS, _MAX_EMPTY_ROUNDS = 1000, 200, 20
# Cells of an image along u and v, in which corners are counted.
_N_CELLS = (10, 10)


@frozen(eq=False)
class PlannedImages:
    """Cameras, boards and images that a plan is for.

    Attributes:
        rig: Cameras and boards whose poses and intrinsics are known approximately.
        sigma: Standard deviation of an image coordinate [px].
        distance: Smallest and largest distance of the middle of a board from the camera [m]; by default any
            distance at which the board fits into the image and its squares and markers are large enough.
        max_angle: Largest angle between the normal of a board and the line of sight [rad].
        min_share: Smallest share of the corners of a board in the image.
        margin: Distance of the corners from the edge of the image [px]; by default `MARGIN_SHARE` of its
            width.
        joint_error: Largest error of each joint with which the robot reaches a pose; a board must still be in
            view then [rad].
    """

    rig: MountedRig
    sigma: float = 0.3
    distance: tuple[float, float] | None = None
    max_angle: float = MAX_VIEW_ANGLE
    min_share: float = 1.0
    margin: float | None = None
    joint_error: float = 0.0

    def __post_init__(self) -> None:
        """Check that poses and intrinsics are known."""
        rig, where = self.rig, self.where
        for kind, entries in (("camera", rig.cameras), ("board", rig.boards)):
            for entry in entries:
                if entry.pose is None:
                    raise InvalidArgumentError(
                        f"{where}[{kind}.{entry.name}] has no pose; expected an approximate one in its link, "
                        "xyz_m and rotvec_rad, or images to estimate it from (--data)"
                    )
        for camera in rig.cameras:
            if not camera.has_intrinsics:
                raise InvalidArgumentError(
                    f"{where}[camera.{camera.name}] has no fx, fy, cx, cy; expected approximate values"
                )
        if not self.pairs:
            raise InvalidArgumentError(
                f"{where}no joint moves a board against a camera; expected one of them on the tool, the "
                "other one not"
            )

    def with_free_points(self, boards: Collection[str]) -> PlannedImages:
        """Return a copy whose corners of some boards are unknowns; those of all others are taken as exact."""
        changed = tuple(replace(board, has_free_points=board.name in boards) for board in self.rig.boards)
        return replace(self, rig=replace(self.rig, boards=changed))

    @property
    def free_boards(self) -> list[str]:
        """Names of the boards whose corners the calibration estimates."""
        return [board.name for board in self.rig.boards if board.has_free_points]

    @property
    def where(self) -> str:
        """Begin of messages: the name of the rig file, if there is one."""
        return f"{self.rig.source}: " if self.rig.source else ""

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Numbers of cameras and boards that move against each other."""
        return [
            (camera, board)
            for camera, camera_mount in enumerate(self.rig.camera_mounts)
            for board, board_mount in enumerate(self.rig.board_mounts)
            if camera_mount.moves != board_mount.moves
        ]

    def limits(self, camera: int, board: int) -> ViewLimits:
        """Return the limits of a view.

        Args:
            camera: Number of the camera.
            board: Number of the board.

        Returns:
            Limits.
        """
        entry = self.rig.cameras[camera]
        low, high = self.distance or _default_distances(entry, self.rig.boards[board])
        margin = MARGIN_SHARE * entry.width if self.margin is None else self.margin
        return ViewLimits(low, high, self.max_angle, self.min_share, margin)

    def in_view(self, tools: Array) -> Array:
        """Return in which poses of the tool, shape (m, 4, 4), a board is in view, shape (m,)."""
        return np.any([corners.any(1) for corners in self.visible_corners(tools)], 0)

    def visible_corners(self, tools: Array) -> list[Array]:
        """Return for each of `pairs` which corners are in view at the tool poses, shape (m, c)."""
        return [
            visible_corners(self.rig, *pair, self.rig.board_in_camera(*pair, tools), self.limits(*pair))
            for pair in self.pairs
        ]


def _default_distances(camera: Camera, board: Board) -> tuple[float, float]:
    """Return the useful distances [m] between which a board fits into the image and is not too small."""
    focal, points = float(camera.values[:2].min()), board.points
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    if board.type == "points":
        distances = np.linalg.norm(points[:, None] - points[None], axis=2)
        np.fill_diagonal(distances, np.inf)
        detail = float(np.median(distances.min(1))) / MIN_SQUARE_PX
    elif board.type == "checkerboard":
        detail = board.square / MIN_SQUARE_PX
    else:
        detail = (board.marker or board.square) / MIN_MARKER_PX
    fitting = focal * size / camera.width
    return 0.5 * fitting, min(focal * detail, fitting / MIN_BOARD_SHARE)


def with_measured_poses(rig: MountedRig, chain: Chain, data: Sequence[Measurement]) -> MountedRig:
    """Return a rig whose missing poses and intrinsics are estimated from images."""
    images = [item for item in data if item.rig is not None]
    is_known = all(entry.pose is not None for entry in (*rig.cameras, *rig.boards))
    if not images or (is_known and all(camera.has_intrinsics for camera in rig.cameras)):
        return rig
    fit = calibrate(chain, images, "camera,board,intrinsics", extend="none")
    if fit.rig is None:
        return rig
    cameras = {entry.name: entry for entry in fit.rig.cameras}
    boards = {entry.name: entry for entry in fit.rig.boards}
    return replace(
        rig,
        cameras=tuple(cameras.get(entry.name, entry) for entry in rig.cameras),
        boards=tuple(boards.get(entry.name, entry) for entry in rig.boards),
    )


def with_typical_lenses(rig: MountedRig) -> MountedRig:
    """Return a rig whose cameras of unknown lens have that of a usual webcam."""

    def typical(camera: Camera) -> Camera:
        focal = FOCAL_SHARE * max(camera.width, camera.height)
        values = np.pad([focal, focal, *camera.image_centre], (0, len(camera.values) - 4))
        return camera if camera.has_intrinsics else replace(camera, values=values)

    return replace(rig, cameras=tuple(map(typical, rig.cameras)))


def draw_views(
    rig: MountedRig, camera: int, board: int, limits: ViewLimits, count: int, rng: np.random.Generator
) -> Array:
    """Draw poses of a board in a camera in which the board is in view."""
    entry, target = rig.cameras[camera], rig.boards[board]
    middle = target.points.mean(0)
    largest = np.pi if target.type == "points" else limits.max_angle
    zero = np.zeros(_BATCH)

    def drawn() -> Array:
        pixels = rng.uniform(0, 1, (2, _BATCH)) * [[entry.width - 1], [entry.height - 1]]
        plane = entry.lens.normalize(pixels, entry.values)
        sight = np.concatenate([plane, np.ones((1, _BATCH))])
        sight /= np.linalg.norm(sight, axis=0)
        distance = rng.uniform(limits.min_distance, limits.max_distance, _BATCH)
        tilt, azimuth, roll = rng.uniform([[0], [0], [0]], [[largest], [2 * np.pi], [2 * np.pi]], (3, _BATCH))
        rotations = (
            se3.turn_between(np.eye(3)[2], sight.T)
            @ se3.exp3(np.stack([zero, zero, azimuth], 1))
            @ se3.exp3(np.stack([tilt, zero, zero], 1))
            @ se3.exp3(np.stack([zero, zero, roll], 1))
        )
        poses = se3.transform(rotations, (distance * sight).T - rotations @ middle)
        return poses[visible_corners(rig, camera, board, poses, limits).any(1)]

    out = collect_draws(drawn, count, _MAX_ROUNDS, _MAX_EMPTY_ROUNDS)
    if len(out) < count:
        where = f"{rig.source}: " if rig.source else ""
        raise InvalidArgumentError(
            f"{where}board {target.name!r} does not fit into the image of camera {entry.name!r} at a "
            f"distance of {1e3 * limits.min_distance:.4g} to {1e3 * limits.max_distance:.4g} mm; expected "
            "other distances, or a smaller share of the corners"
        )
    return out


@frozen
class CameraViews:
    """Planned images of a camera."""

    camera: str  #: Name of the camera
    n_images: int  #: Number of configurations in which it sees a board
    covered_share: float  #: Share of the 10 x 10 cells of its image in which there is at least one corner
    #: Smallest and largest distance of the middle of a board [m]; NaN without images.
    distances: tuple[float, float]
    #: Largest angle between the normal of a board and the line of sight [rad]; NaN for points that are not on
    #: a board.
    max_angle: float


def views_table(views: Sequence[CameraViews]) -> Table:
    """Build the table of the planned images of each camera."""
    rows = [
        [
            one.camera,
            str(one.n_images),
            f"{1e3 * one.distances[0]:.0f} to {1e3 * one.distances[1]:.0f}" if one.n_images else "",
            f"{np.degrees(one.max_angle):.0f}°" if np.isfinite(one.max_angle) else "",
            f"{100 * one.covered_share:.0f} %",
        ]
        for one in views
    ]
    return Table(["camera", "images", "distance, mm", "angle up to", "image covered"], rows)


def summarize_views(images: PlannedImages, tools: Array) -> tuple[CameraViews, ...]:
    """Describe how the images of a plan fill the image planes."""
    rig, visible = images.rig, images.visible_corners(tools)
    out = []
    for number in dict.fromkeys(camera for camera, _ in images.pairs):
        camera = rig.cameras[number]
        cells, has_image = np.zeros(_N_CELLS, bool), np.zeros(len(tools), bool)
        distances, angles = [np.empty(0)], [np.empty(0)]
        for pair, corners in zip(images.pairs, visible, strict=True):
            if pair[0] != number:
                continue
            poses = rig.board_in_camera(*pair, tools)
            pixels, _ = project_board(rig, *pair, poses)
            u, v = ((pixels[corners] + 0.5) / [camera.width, camera.height] * _N_CELLS).astype(int).T
            cells[u, v] = True
            in_view = corners.any(1)
            has_image |= in_view
            middle = poses[in_view, :3, :3] @ rig.boards[pair[1]].points.mean(0) + poses[in_view, :3, 3]
            distance = np.linalg.norm(middle, axis=1)
            distances.append(distance)
            if rig.boards[pair[1]].type != "points":
                along = np.einsum("mi,mi->m", poses[in_view, :3, 2], middle)
                angles.append(np.arccos(np.clip(along / distance, -1, 1)))
        missing = np.full(1, np.nan)
        all_distances = np.concatenate(distances) if has_image.any() else missing
        all_angles = np.concatenate(angles)
        out.append(
            CameraViews(
                camera.name,
                int(has_image.sum()),
                float(cells.mean()),
                (float(all_distances.min()), float(all_distances.max())),
                float((all_angles if all_angles.size else missing).max()),
            )
        )
    return tuple(out)
