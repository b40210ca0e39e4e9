"""Diagnostics: checks of the input before a fit, and of the residuals after it."""

from .column_mixups import diagnose_mixups
from .input_checks import find_input_warnings, poorly_fitted_files
from .reachability import UnreachableRow, find_unreachable_rows
from .residuals import joint_offset_profiles, outliers
from .workspace import WorkspaceMap, workspace_map

__all__ = [
    "UnreachableRow",
    "WorkspaceMap",
    "diagnose_mixups",
    "find_input_warnings",
    "find_unreachable_rows",
    "joint_offset_profiles",
    "outliers",
    "poorly_fitted_files",
    "workspace_map",
]
