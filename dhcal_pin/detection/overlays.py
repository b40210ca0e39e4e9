"""Pictures of images with the corners that were found in them, and with the reprojected corners.

A circle is a detected corner. A cross is a corner as the camera should see it in the pose of the board in
this image. Crosses beside their circles come from wrong detections or a wrong lens. There are none if the
lens is not known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._typing import Array
from ..cameras.rig import Camera
from .corners import DetectedImage, read_image
from .images import BoardDetection
from .opencv import require_opencv
from .reprojection import Reprojection, reproject_corners

# Colours of the corners of the boards in turn (blue, green, red), of corners that are not used, and of
# reprojected ones.
_COLORS = ((0, 140, 255), (255, 120, 0), (60, 180, 0), (180, 0, 180))
_UNUSED, _REPROJECTED = (60, 60, 230), (200, 200, 0)
# Size of a cross relative to a circle.
_CROSS = 1.5
# Radius of a mark and size of the numbers as parts of the width of an image, and bits of parts of a pixel.
_RADIUS, _TEXT, _BITS = 1 / 200, 1 / 1800, 4
# Smallest size of the numbers, and height of a line of text of the size 1 [px].
_MIN_TEXT, _LINE = 0.3, 36


def overlay_files(
    folder: str, camera: Camera | None, detections: Sequence[BoardDetection]
) -> Mapping[str, bytes]:
    """Draw detected and reprojected corners of all boards into the images."""
    out = {}
    for images in zip(*(detection.images for detection in detections), strict=True):
        path = str(Path(folder) / f"{Path(images[0].path).stem}.png")
        found = [
            reproject_corners(camera, detection.board, image) if camera and not image.problem else None
            for detection, image in zip(detections, images, strict=True)
        ]
        out[path] = _picture([detection.board.name for detection in detections], images, found)
    return out


def _picture(
    names: Sequence[str], images: Sequence[DetectedImage], found: Sequence[Reprojection | None]
) -> bytes:
    """Return the PNG of an image with the corners of each board."""
    cv2 = require_opencv()
    picture = cv2.cvtColor(read_image(images[0].path), cv2.COLOR_GRAY2BGR)
    height, width = picture.shape[:2]
    radius, size = max(3.0, width * _RADIUS), max(_MIN_TEXT, width * _TEXT)
    line = 0
    for number, (name, image, reprojection) in enumerate(zip(names, images, found, strict=True)):
        color = _UNUSED if image.problem else _COLORS[number % len(_COLORS)]
        for corner, (u, v) in zip(image.corner.tolist(), image.pixels.tolist(), strict=True):
            cv2.circle(picture, _subpixel(u, v), round(radius * 2**_BITS), color, 1, cv2.LINE_AA, _BITS)
            place = (round(u + radius), round(v - radius))
            cv2.putText(picture, str(corner), place, 0, size, color, 1, cv2.LINE_AA)
        if reprojection is not None:
            _draw_crosses(picture, reprojection.pixels, _CROSS * radius)
            text = f"{name}: {len(image.corner)} corners, {reprojection.rms:.2f} px from the reprojected ones"
            place = (round(radius), round(height - radius - line * _LINE * size))
            (right, up), below = cv2.getTextSize(text, 0, size, 1)
            box = (0, place[1] + below), (place[0] + right + place[0], place[1] - up - below)
            cv2.rectangle(picture, *box, (0, 0, 0), cv2.FILLED)
            cv2.putText(picture, text, place, 0, size, color, 1, cv2.LINE_AA)
            line += 1
    data = cv2.imencode(".png", picture)[1]
    return np.asarray(data).tobytes()


def _draw_crosses(picture: Any, pixels: Array, radius: float) -> None:
    """Draw a cross at each image coordinate (c, 2) that is inside a picture."""
    cv2 = require_opencv()
    height, width = picture.shape[:2]
    is_inside = np.all((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5]), 1)
    for u, v in pixels[is_inside].tolist():
        for a, b in ((radius, 0.0), (0.0, radius)):
            ends = _subpixel(u - a, v - b), _subpixel(u + a, v + b)
            cv2.line(picture, *ends, _REPROJECTED, 1, cv2.LINE_AA, _BITS)


def _subpixel(u: float, v: float) -> tuple[int, int]:
    """Return image coordinates with `_BITS` bits of parts of a pixel, as OpenCV expects them."""
    return round(u * 2**_BITS), round(v * 2**_BITS)
