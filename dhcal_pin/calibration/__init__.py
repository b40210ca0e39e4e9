"""Calibration: from a nominal chain and measurements to a result with evidence of its accuracy."""

from .cross_validation import CrossValidation, cross_validate
from .evaluation import Accuracy, Comparison, ErrorStatistics, accuracy
from .model_selection import FamilyTrial, extend
from .partition import Fold, blocked_folds, k_fold, leave_one_group_out, split
from .procedure import Method, calibrate
from .result import Result
from .streaming import StreamResult, calibrate_stream

__all__ = [
    "Accuracy",
    "Comparison",
    "CrossValidation",
    "ErrorStatistics",
    "FamilyTrial",
    "Fold",
    "Method",
    "Result",
    "StreamResult",
    "accuracy",
    "blocked_folds",
    "calibrate",
    "calibrate_stream",
    "cross_validate",
    "extend",
    "k_fold",
    "leave_one_group_out",
    "split",
]
