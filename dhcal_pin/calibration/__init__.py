"""Calibration: from a nominal chain and measurements to a result with evidence of its accuracy.

The stages of `calibrate` (`procedure`) have one module each: `initialization` of frames, `reweighting`,
`shrinkage` and the `result`. `evaluation` computes errors, `partition` and `cross_validation` hold out
samples, `model_selection` adds families of joint errors, `streaming` reads samples part by part.
`estimates` and `summary` present a result.

Not here: the least-squares solver (`estimation`), explanations of what the data cannot determine
(`identifiability`), checks of input data (`diagnostics`), and files (`io`).
"""

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
