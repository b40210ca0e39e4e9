"""Public names of dhcal_pin.planning; `__init__.py` loads each on first use."""

from .changes import change_options as change_options
from .changes import with_repeats as with_repeats
from .curve_prediction import CurvePrediction as CurvePrediction
from .information import Information as Information
from .information import PlannedCalibration as PlannedCalibration
from .information import plannable_kinds as plannable_kinds
from .named_criteria import CRITERIA as CRITERIA
from .planner import Plan as Plan
from .planner import plan as plan
from .views import CameraViews as CameraViews
from .views import PlannedImages as PlannedImages
from .views import with_measured_poses as with_measured_poses
