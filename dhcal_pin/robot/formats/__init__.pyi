"""Public names of dhcal_pin.robot.formats; `__init__.py` loads each on first use."""

from .mjcf import Mjcf as Mjcf
from .mjcf import parse_mjcf as parse_mjcf
from .mjcf import read_mjcf as read_mjcf
