"""Corners of boards reprojected into the images in which they were found.

The pose of a board in an image is estimated from its detected corners, with the lens that the rig states or,
where it states none, the one that explains all images best. The corners of the board in this pose are
projected back into the image. Their distances from the detected ones show wrong detections and a wrong lens.
They do not show errors of the robot: joint values have no influence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..cameras.boards import Board
from ..cameras.lens_fit import fit_camera
from ..cameras.pose_from_points import agreeing_points, estimate_pose
from ..cameras.rig import Camera
from ..exceptions import NotObservableError
from .corners import DetectedImage
from .images import BoardDetection


@frozen(eq=False)
class Reprojection:
    """Corners of a board in the pose that explains the detected ones best."""

    pixels: Array  # Image coordinates of all corners of the board, (c, 2) [px]
    rms: float  # RMS distance of the detected corners from them [px]


def camera_with_intrinsics(camera: Camera, detections: Sequence[BoardDetection]) -> Camera | None:
    """Return a camera with the lens of the rig; estimate the lens if the rig states none."""
    if camera.has_intrinsics:
        return camera
    views = [
        _agreeing_view(detection.board.points[image.corner], image.pixels)
        for detection in detections
        for image in detection.used
    ]
    has_free_points = any(detection.board.has_free_points for detection in detections)
    try:
        return replace(camera, values=fit_camera(views, camera, repeats_errors=has_free_points).values)
    except NotObservableError:
        return None


def _agreeing_view(points: Array, pixels: Array) -> tuple[Array, Array]:
    """Return the points (m, 3) [m] and pixels (m, 2) of a view of a board without wrong corners."""
    agrees = agreeing_points(points, pixels)
    return points[agrees], pixels[agrees]


def reproject_corners(camera: Camera, board: Board, image: DetectedImage) -> Reprojection | None:
    """Reproject the corners of a board with its pose in one image."""
    points = board.points[image.corner]
    plane = camera.lens.normalize(image.pixels.T, camera.values).T
    if len(points) < 4:
        return None
    agrees = agreeing_points(points, plane)
    estimate = estimate_pose(points[agrees], plane[agrees])
    if estimate is None or not np.isfinite(estimate[1]):
        return None
    pose = estimate[0]
    local = se3.transform_points(pose, board.points)
    pixels = camera.lens.project(local.T, camera.values)[0].T
    errors = image.pixels - pixels[image.corner]
    return Reprojection(pixels, se3.rms_length(errors))
