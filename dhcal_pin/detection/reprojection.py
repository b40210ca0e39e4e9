"""Corners of boards reprojected into the images in which they were found.

The pose of a board in an image is estimated from its detected corners, with the intrinsics of the rig. The
corners of the board in this pose are projected back into the image. Their distances from the detected ones
show wrong detections and a wrong lens. They do not show errors of the robot: joint values have no influence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._typing import Array
from ..cameras.boards import Board
from ..cameras.intrinsics import estimate_intrinsics
from ..cameras.pose_from_points import agreeing_points, estimate_pose
from ..cameras.rig import Camera
from ..exceptions import NotObservableError
from .corners import DetectedImage
from .images import BoardDetection


@dataclass(frozen=True, eq=False)
class Reprojection:
    """Corners of a board in the pose that explains the detected ones best.

    Attributes:
        pixels: Image coordinates of all corners of the board, (c, 2) [px].
        rms: RMS distance of the detected corners from them [px].
    """

    pixels: Array
    rms: float


def camera_with_intrinsics(camera: Camera, detections: Sequence[BoardDetection]) -> Camera | None:
    """Return a camera with the intrinsics of the rig, or estimated ones if the rig states none.

    Args:
        camera: Camera that took the images.
        detections: Corners by board.

    Returns:
        The camera; None if the images do not determine its intrinsics.
    """
    if camera.has_intrinsics:
        return camera
    views = [
        (detection.board.points[image.corner], image.pixels)
        for detection in detections
        for image in detection.used
    ]
    try:
        values = estimate_intrinsics(views, camera)
    except NotObservableError:
        return None
    return replace(camera, values=np.pad(values, (0, len(camera.values) - len(values))))


def reproject_corners(camera: Camera, board: Board, image: DetectedImage) -> Reprojection | None:
    """Reproject the corners of a board with its pose in one image.

    Args:
        camera: Camera with intrinsics.
        board: Board of the rig.
        image: Its detected corners.

    Returns:
        The corners; None if the detected ones do not determine a pose.
    """
    points = board.points[image.corner]
    plane = camera.lens.normalize(image.pixels.T, camera.values).T
    if len(points) < 4:
        return None
    agrees = agreeing_points(points, plane)
    estimate = estimate_pose(points[agrees], plane[agrees])
    if estimate is None or not np.isfinite(estimate[1]):
        return None
    pose = estimate[0]
    local = board.points @ pose[:3, :3].T + pose[:3, 3]
    pixels = camera.lens.project(local.T, camera.values)[0].T
    errors = image.pixels - pixels[image.corner]
    return Reprojection(pixels, float(np.sqrt(np.mean(np.sum(errors**2, 1)))))
