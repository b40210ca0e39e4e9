"""Pictures of images with the corners that were found in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .corners import DetectedImage, read_image
from .images import BoardDetection
from .opencv import require_opencv

# Colours of the corners of the boards in turn (blue, green, red), and of corners that are not used.
_COLORS = ((0, 140, 255), (255, 120, 0), (60, 180, 0), (180, 0, 180))
_UNUSED = (60, 60, 230)
# Radius of a mark and size of the numbers as parts of the width of an image, and bits of parts of a pixel.
_RADIUS, _TEXT, _BITS = 1 / 200, 1 / 1800, 4


def overlay_files(folder: str, detections: Sequence[BoardDetection]) -> Mapping[str, bytes]:
    """Draw the corners of all boards into the images.

    Args:
        folder: Folder of the pictures.
        detections: Corners by board.

    Returns:
        PNG by path: the name of the image with the ending `.png`.
    """
    out = {}
    for images in zip(*(detection.images for detection in detections), strict=True):
        path = str(Path(folder) / f"{Path(images[0].path).stem}.png")
        out[path] = _picture(images)
    return out


def _picture(images: Sequence[DetectedImage]) -> bytes:
    """Return the PNG of an image with the corners of each board."""
    cv2 = require_opencv()
    picture = cv2.cvtColor(read_image(images[0].path), cv2.COLOR_GRAY2BGR)
    width = picture.shape[1]
    for number, image in enumerate(images):
        color = _UNUSED if image.problem else _COLORS[number % len(_COLORS)]
        for corner, (u, v) in zip(image.corner.tolist(), image.pixels.tolist(), strict=True):
            centre = (round(u * 2**_BITS), round(v * 2**_BITS))
            radius = round(max(3.0, width * _RADIUS) * 2**_BITS)
            cv2.circle(picture, centre, radius, color, 1, cv2.LINE_AA, _BITS)
            place = (round(u + width * _RADIUS), round(v - width * _RADIUS))
            cv2.putText(picture, str(corner), place, 0, max(0.3, width * _TEXT), color, 1, cv2.LINE_AA)
    data = cv2.imencode(".png", picture)[1]
    return np.asarray(data).tobytes()
