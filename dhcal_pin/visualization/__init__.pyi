"""Public names of dhcal_pin.visualization; `__init__.py` loads each on first use."""

from .array_plots import plot_arms as plot_arms
from .array_plots import plot_error_histogram as plot_error_histogram
from .array_plots import plot_errors_by_sample as plot_errors_by_sample
from .array_plots import plot_errors_over_joint as plot_errors_over_joint
from .array_plots import plot_joint_corrections as plot_joint_corrections
from .array_plots import plot_joint_offsets as plot_joint_offsets
from .array_plots import plot_plan_curve as plot_plan_curve
from .array_plots import plot_position_std_map as plot_position_std_map
from .array_plots import plot_singular_values as plot_singular_values
from .array_plots import plot_study as plot_study
from .array_plots import study_svg as study_svg
from .scene import Preview as Preview
from .scene import Scene as Scene
from .scene import scene_html as scene_html
from .scene import show as show
