"""Consecutive lines of a file that do not agree with the fit of the others, and the mistake in them.

Independent outliers with the share p of n samples form a series of k outliers with a probability of at most
n·pᵏ, and k outliers among s consecutive samples with at most n²·P(B ≥ k), B ~ Binomial(s, p). The series with
the largest number of outliers, less a penalty for each other sample, is named if chance is improbable.

All hypotheses about mistakes are tried on these lines with the robot that was fitted to the others, and
confirmed by all samples of the file (`confirmation`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .diagnosis import Diagnosis
from .drawn_samples import comparable_items
from .evidence import with_noise_of

# Consecutive outliers are named if independent outliers would form such a series with a lower probability.
_MAX_CHANCE = 1e-3
# Penalty of a sample in a series that is no outlier, in outliers.
_PENALTY = 2.0
# Samples whose residuals exceed this multiple of the noise do not fit after the change of a hypothesis.
_MAX_MISFIT, _MIN_SHARE = 16.0, 0.9


@frozen
class DeviatingLines:
    """Consecutive lines of a file that do not agree with the others."""

    source: str  #: File; empty for samples from Python.
    first: int  #: First line.
    last: int  #: Last line.
    n_outliers: int  #: Number of outliers among the fitted samples of these lines.
    n_fitted: int  #: Number of fitted samples of these lines.

    def contains(self, item: Measurement) -> Array:
        """Return which samples of a part of this file are in these lines, (m,)."""
        return (item.rows >= self.first) & (item.rows <= self.last)

    @property
    def name(self) -> str:
        """Name of the lines and of the file."""
        of_file = f" of {self.source}" if self.source else ""
        return f"lines {self.first} to {self.last}{of_file}"


def find_deviating_lines(
    item: Measurement, is_outlier: Array, share: float, n_samples: int
) -> DeviatingLines | None:
    """Find consecutive outliers (m,) of one file; share of outliers and number are those of all samples."""
    score, begin, best, found = 0.0, 0, 0.0, (0, 0)
    for i, outlying in enumerate(is_outlier.tolist()):
        if score <= 0:
            score, begin = 0.0, i
        score += 1.0 if outlying else -_PENALTY
        if score > best:
            best, found = score, (begin, i + 1)
    inside = is_outlier[slice(*found)]
    count, size = int(inside.sum()), len(inside)
    if count < 2:
        return None
    from scipy.stats import binom  # lazy import: slow

    is_pure = count == size
    chance = n_samples * share**count if is_pure else n_samples**2 * binom.sf(count - 1, size, share)
    if chance > _MAX_CHANCE:
        return None
    rows = item.rows[slice(*found)]
    return DeviatingLines(item.source, int(rows[0]), int(rows[-1]), count, size)


def extend(
    lines: DeviatingLines, fitted: Measurement, held_out: Measurement, is_far: Array
) -> DeviatingLines:
    """Extend deviating lines by the samples beside them that were held out and are far away, too."""
    rows = np.concatenate([fitted.rows, held_out.rows])
    ends = np.concatenate([np.ones(len(fitted.rows), bool), ~is_far])
    # Between these lines are the deviating ones and what was held out beside them.
    below = rows[ends & (rows < lines.first)].max(initial=-1)
    above = rows[ends & (rows > lines.last)].min(initial=np.iinfo(int).max)
    added = held_out.rows[is_far & (held_out.rows > below) & (held_out.rows < above)]
    bounds = np.concatenate([[lines.first, lines.last], added])
    return replace(lines, first=int(bounds.min()), last=int(bounds.max()))


def find_mistake(
    nominal: Chain,
    fitted: tuple[Chain, Mapping[str, float]],
    lines: DeviatingLines,
    parts: Sequence[Measurement],
    good: Sequence[Measurement],
    sets: str,
) -> Diagnosis | None:
    """Find the mistake in deviating lines, from the parts of their file and the good samples of the fit."""
    from .confirmation import confirm, join_parts  # lazy import, as the following: rarely needed
    from .hypotheses import list_hypotheses

    # `fitted` is the calibrated chain and the instrument parameters by name.
    parts = join_parts(comparable_items(parts))
    wrong = [item.take(lines.contains(item)) for item in parts]
    wrong = [item for item in wrong if len(item.rows)]
    model, before = with_noise_of(*fitted, good), with_noise_of(*fitted, wrong)
    if not wrong or model is None or before is None:
        return None
    explaining = []
    for hypothesis in list_hypotheses(nominal, wrong):
        changed = [hypothesis.change.apply(item) for item in wrong]
        if any(item is None for item in changed):
            continue
        misfits = [model.misfits(item) for item in changed if item is not None]
        values = np.concatenate([each for each in misfits if each is not None] or [np.full(1, np.inf)])
        if np.mean(values <= _MAX_MISFIT) >= _MIN_SHARE:
            explaining.append(hypothesis)
    if not explaining:
        return None
    found = confirm(nominal, Diagnosis(before, tuple(explaining), model), parts, sets)
    return replace(found, before=before) if found.hypotheses and found.lines else None
