"""Boards in images, and boards to print.

`detect_corners` finds the corners of a board in images with OpenCV, which the extra `camera` installs. A
board that was printed with rows and columns exchanged, or in the older layout of OpenCV, is found, too.
`board_pdf` draws a board at its true scale.
"""

from .corners import DetectedImage, Layout, detect_corners, find_layout, read_image
from .printing import black_rectangles, board_pdf

__all__ = [
    "DetectedImage",
    "Layout",
    "black_rectangles",
    "board_pdf",
    "detect_corners",
    "find_layout",
    "read_image",
]
