"""Public names of dhcal_pin.detection; `__init__.py` loads each on first use."""

from .corners import DetectedImage as DetectedImage
from .corners import Layout as Layout
from .corners import detect_corners as detect_corners
from .corners import find_layout as find_layout
from .corners import read_image as read_image
from .images import BoardDetection as BoardDetection
from .images import corner_columns as corner_columns
from .images import detect_boards as detect_boards
from .images import image_files as image_files
from .images import unused_images as unused_images
from .overlays import overlay_files as overlay_files
from .printing import black_rectangles as black_rectangles
from .printing import board_pdf as board_pdf
from .rendering import ImageQuality as ImageQuality
from .rendering import render_images as render_images
from .reprojection import Reprojection as Reprojection
from .reprojection import camera_with_intrinsics as camera_with_intrinsics
from .reprojection import reproject_corners as reproject_corners
from .video import VIDEO_ENDINGS as VIDEO_ENDINGS
from .video import is_video as is_video
from .video import read_stills as read_stills
from .video import save_stills as save_stills
