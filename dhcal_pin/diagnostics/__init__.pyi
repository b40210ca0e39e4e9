"""Public names of dhcal_pin.diagnostics; `__init__.py` loads each on first use."""

from .curves import JointCurve as JointCurve
from .curves import find_lattices as find_lattices
from .curves import fitted_coverage as fitted_coverage
from .curves import joint_curves as joint_curves
from .extrapolation import Extrapolation as Extrapolation
from .extrapolation import find_extrapolation as find_extrapolation
from .input_checks import find_input_warnings as find_input_warnings
from .input_checks import find_value_warnings as find_value_warnings
from .input_checks import poorly_fitted_files as poorly_fitted_files
from .inspection import ColumnSummary as ColumnSummary
from .inspection import FileInspection as FileInspection
from .inspection import column_table as column_table
from .inspection import inspect_file as inspect_file
from .reachability import UnreachableRow as UnreachableRow
from .reachability import find_unreachable_rows as find_unreachable_rows
from .residuals import JointProfile as JointProfile
from .residuals import Outlier as Outlier
from .residuals import find_outliers as find_outliers
from .residuals import joint_offset_profiles as joint_offset_profiles
from .residuals import median_sigmas as median_sigmas
from .workspace import WorkspaceMap as WorkspaceMap
from .workspace import WorkspacePrediction as WorkspacePrediction
from .workspace import predict_workspace as predict_workspace
from .workspace import workspace_map as workspace_map
