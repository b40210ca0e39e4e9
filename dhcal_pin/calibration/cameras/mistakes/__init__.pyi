"""Public names of dhcal_pin.calibration.cameras.mistakes; `__init__.py` loads each on first use."""

from .inverse_poses import PoseDifference as PoseDifference
from .inverse_poses import held_entries as held_entries
from .inverse_poses import pose_differences as pose_differences
from .inverse_poses import stated_poses as stated_poses
from .rig import RigMistakes as RigMistakes
from .rig import correct_rig as correct_rig
