"""Public names of dhcal_pin.calibration.presentation; `__init__.py` loads each on first use."""

from .curves import joint_curves as joint_curves
from .fit_plots import plot_accuracy as plot_accuracy
from .fit_plots import plot_correlation as plot_correlation
from .fit_plots import plot_parameters as plot_parameters
from .fit_plots import plot_residuals as plot_residuals
from .fit_plots import plot_singular_values as plot_singular_values
from .fit_plots import plot_workspace as plot_workspace
from .result_plots import ResultPlots as ResultPlots
from .workspace import predict_workspace as predict_workspace
