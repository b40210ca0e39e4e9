"""Boards in images, and boards to print.

`detect_corners` finds the corners of a board in images with OpenCV, which the extra `camera` installs. A
board that was printed with rows and columns exchanged, or in the older layout of OpenCV, is found, too.
`detect_boards` does so for all images of a camera.
`board_pdf` draws a board at its true scale. `render_images` renders images of boards, for tests and where no
camera is at hand.
"""

from .corners import DetectedImage, Layout, detect_corners, find_layout, read_image
from .images import BoardDetection, corner_columns, detect_boards, image_files, unused_images
from .overlays import overlay_files
from .printing import black_rectangles, board_pdf
from .rendering import ImageQuality, render_images
from .reprojection import Reprojection, camera_with_intrinsics, reproject_corners

__all__ = [
    "BoardDetection",
    "DetectedImage",
    "ImageQuality",
    "Layout",
    "Reprojection",
    "black_rectangles",
    "board_pdf",
    "camera_with_intrinsics",
    "corner_columns",
    "detect_boards",
    "detect_corners",
    "find_layout",
    "image_files",
    "overlay_files",
    "read_image",
    "render_images",
    "reproject_corners",
    "unused_images",
]
