"""Diagnostics: checks of the input before a fit, and of the residuals after it."""

from .column_mixups import mixed_up
from .input_checks import doubts, misfits
from .reachability import Finding, screen
from .residuals import joint_traces, outliers
from .workspace import WorkspaceMap, workspace_map

__all__ = [
    "Finding",
    "WorkspaceMap",
    "doubts",
    "joint_traces",
    "misfits",
    "mixed_up",
    "outliers",
    "screen",
    "workspace_map",
]
