"""Joint correction curves as public names of this package; see `calibration.presentation.curves`."""

from ..calibration.presentation.curves import JointCurve as JointCurve
from ..calibration.presentation.curves import find_lattices as find_lattices
from ..calibration.presentation.curves import fitted_coverage as fitted_coverage
from ..calibration.presentation.curves import joint_curves as joint_curves
