"""Errors on what was left out: at random, by groups, or by whole regions of joint space.

A random split leaves neighbours of every sample in the fit, so a term that runs away where nobody measured
looks good. Leaving out the ends of the samples' principal directions in joint space shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .evaluation import summary
from .folds import Fold, left_out, region_folds, touched
from .result import Result
from .se3 import Array


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors on what was left out.

    Attributes:
        folds: of each fold what `accuracy` says of its left-out samples, m and rad.
        errors: (k,) RMS of each fold's left-out rows in standard deviations as the fit used them.
        accuracy: the same as a fold's, of all folds' samples together.
    """

    folds: tuple[dict[str, Any], ...]
    errors: Array
    accuracy: dict[str, Any]


def standard_error(values: Array) -> float:
    """Standard error of the mean of values (k,), as wide as Student's t makes few; infinite for one."""
    if len(values) < 2:
        return np.inf
    from scipy.special import ndtr, stdtrit  # a good part of the start-up, and few fits need it

    return float(stdtrit(len(values) - 1, ndtr(1.0)) * values.std(ddof=1) / np.sqrt(len(values)))


def cross_validate(fit: Result, folds: Sequence[Fold] | None = None) -> CrossValidation:
    """How well a result's model predicts what it is not fitted to.

    Args:
        fit: a calibration; its sigmas, weights and priors are kept.
        folds: of `random_folds`, `group_folds` or `region_folds`; the last without it.

    Raises:
        DhcalError: folds that were not made for the fitted data.
    """
    if folds is None:
        folds = region_folds(fit.data, places=touched(fit.problem, fit.x))
    judged = list(left_out(fit.problem, fit.solution.x, fit.data, folds, fit.again))
    every = [item for found, _ in judged for item in found]
    return CrossValidation(
        tuple(summary(found) for found, _ in judged), np.array([error for _, error in judged]), summary(every)
    )
