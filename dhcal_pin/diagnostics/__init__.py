"""Checks of measurement files before a fit, and of residuals and accuracy after it.

Diagnostics read a robot, measurements and a calibration, and return findings; they change nothing and write
nothing. Their presentation belongs to the packages `report` and `cli`.
"""

from .column_mixups import diagnose_mixups
from .input_checks import find_input_warnings, poorly_fitted_files
from .reachability import UnreachableRow, find_unreachable_rows
from .residuals import JointProfile, Outlier, find_outliers, joint_offset_profiles, median_sigmas
from .workspace import WorkspaceMap, WorkspacePrediction, predict_workspace, workspace_map

__all__ = [
    "JointProfile",
    "Outlier",
    "UnreachableRow",
    "WorkspaceMap",
    "WorkspacePrediction",
    "diagnose_mixups",
    "find_input_warnings",
    "find_outliers",
    "find_unreachable_rows",
    "joint_offset_profiles",
    "median_sigmas",
    "poorly_fitted_files",
    "predict_workspace",
    "workspace_map",
]
