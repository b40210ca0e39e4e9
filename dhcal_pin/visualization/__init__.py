"""Visualization: plots with matplotlib, and three-dimensional scenes with MeshCat.

This package draws what other packages have computed. Which plots a report contains is decided in `report`.
matplotlib is imported by the first plot; `live`, which imports MeshCat's server, is imported by itself.
"""

from .plots import (
    plot_arms,
    plot_error_histogram,
    plot_errors_by_sample,
    plot_errors_over_joint,
    plot_joint_offsets,
    plot_position_std_map,
    plot_singular_values,
    plot_study,
    study_svg,
)
from .scene import Scene, scene_html, show

__all__ = [
    "Scene",
    "plot_arms",
    "plot_error_histogram",
    "plot_errors_by_sample",
    "plot_errors_over_joint",
    "plot_joint_offsets",
    "plot_position_std_map",
    "plot_singular_values",
    "plot_study",
    "scene_html",
    "show",
    "study_svg",
]
