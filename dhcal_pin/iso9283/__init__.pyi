"""Public names of dhcal_pin.iso9283; `__init__.py` loads each on first use."""

from .characteristics import PointCycles as PointCycles
from .characteristics import PoseCharacteristics as PoseCharacteristics
from .characteristics import pose_characteristics as pose_characteristics
from .cube import IsoCube as IsoCube
from .cube import find_iso_cube as find_iso_cube
