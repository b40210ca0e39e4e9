"""Calibration from images: parameter sets of cameras and boards, jitter, and stages that protect the arm.

A calibration from images estimates cameras, boards and lenses together with the robot. This package says
which of these parameters are unknown, and in which order they are freed.
"""

from .axis_order import axis_stages, exchange_axes, reorder
from .board_size import BoardSize, find_board_size
from .diagnosis import LARGE_ERROR, HandEyeDiagnosis, HandEyeFit
from .gate import apply_gate, judge_stages, judge_target_points
from .lens_priors import lens_prior_groups, with_lens_priors, with_stated_distortion
from .seen_ranges import seen_ranges_warning
from .sets import (
    DEFAULT_SETS,
    HAND_EYE_SETS,
    RIG_SETS,
    default_sets,
    has_images,
    has_joint_values,
    held_values,
    require_joint_values,
    split_sets,
)
from .stages import STAGES, ImageError, Stage, fitted_error
from .target_points import judged_boards

__all__ = [
    "DEFAULT_SETS",
    "HAND_EYE_SETS",
    "LARGE_ERROR",
    "RIG_SETS",
    "STAGES",
    "BoardSize",
    "HandEyeDiagnosis",
    "HandEyeFit",
    "ImageError",
    "Stage",
    "apply_gate",
    "axis_stages",
    "default_sets",
    "exchange_axes",
    "find_board_size",
    "fitted_error",
    "has_images",
    "has_joint_values",
    "held_values",
    "judge_stages",
    "judge_target_points",
    "judged_boards",
    "lens_prior_groups",
    "reorder",
    "require_joint_values",
    "seen_ranges_warning",
    "split_sets",
    "with_lens_priors",
    "with_stated_distortion",
]
