"""Outliers that fit another label: a touched point or a target with the name of another one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..formatting import list_first
from ..measurements.base import Measurement, residual_of
from ..measurements.contact import PointContact
from ..measurements.position import MultiTargetPosition
from ..robot.chain import Chain

# Largest mean squared residual of a sample that fits, relative to that of all good samples.
MAX_MISFIT = 16.0


@frozen
class WrongLabel:
    """Samples of a file that have one label and fit another one."""

    source: str  #: File; empty for samples from Python.
    column: str  #: Column of the labels.
    stated: str  #: Label of the samples.
    fitting: str  #: Label that they fit.
    rows: tuple[int, ...]  #: Lines of the samples.

    @property
    def sentence(self) -> str:
        """State the lines and both labels."""
        of_file = f" of {self.source}" if self.source else ""
        subject, states, fits = (
            ("Lines", "state", "fit") if len(self.rows) > 1 else ("Line", "states", "fits")
        )
        where = f"{subject} {list_first(self.rows)}{of_file}"
        return f"{where} {states} {self.column} {self.stated} and {fits} {self.fitting}."


def find_wrong_labels(
    item: Measurement, is_good: Array, chain: Chain, instruments: Mapping[str, float]
) -> tuple[WrongLabel, ...]:
    """Find the outliers of a fit that fit with another label; good samples (m,) are no outliers."""
    if not isinstance(item, PointContact | MultiTargetPosition) or is_good.all() or not is_good.any():
        return ()
    limit = MAX_MISFIT * np.mean(residual_of(item.take(is_good), chain, instruments) ** 2)
    outliers = item.take(~is_good)
    labels = range(len(item.names))
    relabelled = (outliers.replace(label=np.full(len(outliers.rows), i)) for i in labels)
    misfits = np.array([np.mean(residual_of(each, chain, instruments) ** 2, 0) for each in relabelled])
    best = misfits.argmin(0)
    column = next(iter(item.text_values()))
    found = []
    for stated in labels:
        for fitting in labels:
            chosen = (outliers.label == stated) & (best == fitting) & (misfits.min(0) <= limit)
            if stated != fitting and chosen.any():
                rows = tuple(sorted(outliers.rows[chosen].tolist()))
                found.append(WrongLabel(item.source, column, item.names[stated], item.names[fitting], rows))
    return tuple(found)
