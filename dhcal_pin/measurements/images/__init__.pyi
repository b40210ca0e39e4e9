"""Public names of dhcal_pin.measurements.images; `__init__.py` loads each on first use."""

from .board_view import ViewLimits as ViewLimits
from .board_view import is_board_in_view as is_board_in_view
from .board_view import project_board as project_board
from .board_view import visible_corners as visible_corners
from .camera_parameters import rig_parameters as rig_parameters
from .camera_start import BoardViews as BoardViews
from .camera_start import Corners as Corners
from .camera_start import estimate_views as estimate_views
from .camera_start import first_values as first_values
from .camera_start import moving_information as moving_information
from .camera_start import moving_poses as moving_poses
from .image_pose import ImagePose as ImagePose
from .image_pose import pose_covariances as pose_covariances
