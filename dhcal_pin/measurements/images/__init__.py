"""Images of boards: the unknowns of cameras and boards, their first values, and which boards are in view.

The measurement kind itself is `measurements.camera`.
"""

from .board_view import ViewLimits, is_board_in_view, project_board, visible_corners
from .camera_parameters import rig_parameters
from .camera_start import first_values

__all__ = [
    "ViewLimits",
    "first_values",
    "is_board_in_view",
    "project_board",
    "rig_parameters",
    "visible_corners",
]
