"""Outliers that fit another label: a touched point, a target or a camera with the name of another one."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..formatting import MAX_LISTED, format_lines
from ..measurements.base import Measurement, residual_of
from ..measurements.images.names import list_images
from ..robot.chain import Chain

# Largest mean squared residual of a sample that fits, relative to that of all good samples.
MAX_MISFIT = 16.0
# Smallest number of outlying corners of an image that are judged.
MIN_CORNERS = 4


@frozen
class WrongLabel:
    """Samples of a file that have one label and fit another one."""

    source: str  #: File; empty for samples from Python.
    column: str  #: Column of the labels.
    stated: str  #: Label of the samples.
    fitting: str  #: Label that they fit.
    rows: tuple[int, ...]  #: Lines of the samples.
    images: tuple[str, ...] = ()  #: Label of each image that the samples are, empty without a name.

    @property
    def sentence(self) -> str:
        """State the lines and both labels."""
        of_file = f" of {self.source}" if self.source else ""
        subject, states, fits = (
            ("Lines", "state", "fit") if len(self.rows) > 1 else ("Line", "states", "fits")
        )
        where = f"{subject} {format_lines(self.rows, MAX_LISTED)}{of_file}{list_images(self.images)}"
        return f"{where} {states} {self.column} {self.stated} and {fits} {self.fitting}."


def find_wrong_labels(
    item: Measurement, is_good: Array, chain: Chain, instruments: Mapping[str, float]
) -> tuple[WrongLabel, ...]:
    """Find the outliers of a fit that fit with another label; good samples (m,) are no outliers."""
    names = item.label_names
    if len(names) < 2 or is_good.all() or not is_good.any():
        return ()
    limit = MAX_MISFIT * np.mean(residual_of(item.take(is_good), chain, instruments) ** 2)
    # A label most of whose samples are outliers may have been fitted to the wrong ones.
    numbers, stated = range(len(names)), item.label_numbers
    n_good, n_all = (np.bincount(each, minlength=len(names)) for each in (stated[is_good], stated))
    is_doubtful = 2 * n_good < n_all
    examined = item.take(~is_good | is_doubtful[stated])
    stated = examined.label_numbers
    misfits = np.array(
        [np.mean(residual_of(examined.with_label(i), chain, instruments) ** 2, 0) for i in numbers]
    )
    # All corners of an image have the same camera.
    group = examined.sample_groups if examined.n_images else np.arange(len(examined.rows))
    members = [group == i for i in range(int(group.max()) + 1)]
    medians = np.array([np.median(misfits[:, mask], 1) for mask in members])[group]
    medians[is_doubtful[stated], stated[is_doubtful[stated]]] = np.inf
    best, own = medians.argmin(1), np.arange(len(group))
    is_fitting = (medians.min(1) <= limit) & (misfits[best, own] < np.maximum(misfits[stated, own], limit))
    is_fitting &= np.bincount(group)[group] >= (MIN_CORNERS if examined.n_images else 1)
    found = []
    for one, other in permutations(numbers, 2):
        chosen = is_fitting & (stated == one) & (best == other)
        if chosen.any():
            part = examined.take(chosen)
            images = tuple(part.images_within(np.ones(len(part.rows), bool)))
            rows = tuple(sorted(part.rows.tolist()))
            found.append(WrongLabel(item.source, item.label_column, names[one], names[other], rows, images))
    return tuple(found)
