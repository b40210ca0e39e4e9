"""Public names of dhcal_pin.calibration.presentation; `__init__.py` loads each on first use."""

from .curves import joint_curves as joint_curves
from .fit_plots import ResultPlots as ResultPlots
from .workspace import predict_workspace as predict_workspace
