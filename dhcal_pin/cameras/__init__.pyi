"""Public names of dhcal_pin.cameras; `__init__.py` loads each on first use."""

from .boards import Board as Board
from .hand_eye import solve_hand_eye as solve_hand_eye
from .lens import LENSES as LENSES
from .lens import Lens as Lens
from .pose_from_points import estimate_pose as estimate_pose
from .rig import Camera as Camera
from .rig import Rig as Rig
