"""Calibration: from a nominal chain and measurements to a result with evidence of its accuracy."""

from .cross_validation import CrossValidation, Fold, cross_validate, group_folds, random_folds, region_folds
from .evaluation import Comparison, accuracy
from .model_selection import Trial, extend
from .procedure import Method, calibrate, split
from .result import Result
from .streaming import Streamed, calibrate_stream

__all__ = [
    "Comparison",
    "CrossValidation",
    "Fold",
    "Method",
    "Result",
    "Streamed",
    "Trial",
    "accuracy",
    "calibrate",
    "calibrate_stream",
    "cross_validate",
    "extend",
    "group_folds",
    "random_folds",
    "region_folds",
    "split",
]
