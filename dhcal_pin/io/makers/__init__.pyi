"""Public names of dhcal_pin.io.makers; `__init__.py` loads each on first use."""

from .staubli_arm import correct_staubli_arm as correct_staubli_arm
from .ur_kinematics import read_ur_kinematics as read_ur_kinematics
