"""Plots of arrays as public names of this package; `plots` has the functions, below what draws with them."""

from ..plots import plot_arms as plot_arms
from ..plots import plot_error_histogram as plot_error_histogram
from ..plots import plot_errors_by_sample as plot_errors_by_sample
from ..plots import plot_errors_over_joint as plot_errors_over_joint
from ..plots import plot_joint_corrections as plot_joint_corrections
from ..plots import plot_joint_offsets as plot_joint_offsets
from ..plots import plot_plan_curve as plot_plan_curve
from ..plots import plot_position_std_map as plot_position_std_map
from ..plots import plot_singular_values as plot_singular_values
from ..plots import plot_study as plot_study
from ..plots import study_svg as study_svg
