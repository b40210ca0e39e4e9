"""Timeline of a session: when each sample was measured, relative to the others.

The samples are in the order of the files and of their lines, or of their times if all samples have one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..measurements.base import Measurement
from ..measurements.configurations import group_by_configuration
from ..robot.conditions import directions_in_order


@frozen
class Place:
    """Place of a sample: its file, its first and last line, and the name of its photograph, if any."""

    file: str
    line: int
    last_line: int
    photograph: str


@frozen(eq=False)
class Timeline:
    """Order of the samples of a session of N samples."""

    data: tuple[Measurement, ...]  # Fitted measurements, then held-out ones
    n_fitted: int  # Number of fitted measurements
    # Number of each sample in the order of measurement, from 0 to N-1, one array per measurement.
    numbers: tuple[Array, ...]
    # Time of each sample, one array per measurement: in seconds if known, else its number.
    times: tuple[Array, ...]
    unit: str  # "s", "row" or "image", the unit of the times
    file_starts: tuple[int, ...]  # Numbers of the first samples of all files but the first

    @property
    def fitted_numbers(self) -> Array:
        """Numbers of all fitted samples, in the order of the measurements."""
        return np.concatenate(self.numbers[: self.n_fitted])

    @property
    def fitted_times(self) -> Array:
        """Times of all fitted samples, in the order of the measurements."""
        return np.concatenate(self.times[: self.n_fitted])

    @cached_property
    def _counted(self) -> Array:
        """Fitted samples in the order of measurement; of consecutive ones at one configuration the first."""
        # They share the error of the model.
        order = np.argsort(self.fitted_numbers, kind="stable")
        q = np.concatenate([item.q for item in self.data[: self.n_fitted]])[order]
        return order[np.diff(group_by_configuration(q), prepend=-1) != 0]

    @property
    def directions(self) -> tuple[Array, ...]:
        """Direction of the last motion of each joint (m, n) of each measurement; 0 at the begin of a file."""
        order = np.argsort(np.concatenate(self.numbers))
        q = np.concatenate([item.q for item in self.data])
        directions = np.empty_like(q)
        files = np.split(q[order], self.file_starts)
        directions[order] = np.concatenate([directions_in_order(each) for each in files])
        return tuple(np.split(directions, np.cumsum([len(each) for each in self.numbers])[:-1]))

    def thinned(self, count: int) -> Timeline:
        """Return the timeline of at most `count` fitted samples, evenly spaced, without held-out ones."""
        order = self._counted
        kept = np.zeros(len(self.fitted_numbers), bool)
        kept[order[:: max(1, -(-len(order) // count))]] = True
        ends = np.cumsum([len(each) for each in self.numbers[: self.n_fitted]])[:-1]
        masks = np.split(kept, ends)
        data = tuple(item.take(mask) for item, mask in zip(self.data, masks, strict=False))
        parts = [
            tuple(each[mask] for each, mask in zip(values, masks, strict=False))
            for values in (self.numbers, self.times)
        ]
        return replace(self, data=data, numbers=parts[0], times=parts[1])

    def place(self, number: int) -> Place:
        """Return where a sample stands."""
        for item, numbers in zip(self.data, self.numbers, strict=True):
            found = numbers == number
            if found.any():
                rows = item.rows[found]
                return Place(item.source, int(rows.min()), int(rows.max()), str(item.photographs()[found][0]))
        raise IndexError(number)


def order_samples(data: Sequence[Measurement], holdout: Sequence[Measurement]) -> Timeline:
    """Put the samples of measurements into the order of measurement."""
    items = (*data, *holdout)
    files = _file_numbers(data, holdout)
    clocks = [item.recorded.time if item.recorded is not None else None for item in items]
    stated = [clock for clock in clocks if clock is not None]
    has_times = len(stated) == len(items)
    file = np.concatenate(
        [np.full(len(item.rows), number) for item, number in zip(items, files, strict=True)]
    )
    rows = np.concatenate([item.rows for item in items])
    keys = (rows, file, np.concatenate(stated)) if has_times else (rows, file)
    order = np.lexsort(keys)
    numbers = np.empty(len(order), int)
    numbers[order] = np.arange(len(order))
    times = np.concatenate(stated) if has_times else numbers.astype(float)
    ends = np.cumsum([len(item.rows) for item in items])[:-1]
    starts = np.flatnonzero(np.diff(file[order])) + 1
    return Timeline(
        items,
        len(data),
        tuple(np.split(numbers, ends)),
        tuple(np.split(times, ends)),
        "s" if has_times else "row",
        tuple(starts.tolist()),
    )


def _file_numbers(data: Sequence[Measurement], holdout: Sequence[Measurement]) -> list[int]:
    """Number the files of measurements; parts of one file have the same number."""
    numbers = [i for i in range(len(data))]
    for i, item in enumerate(data):
        same = [j for j in range(i) if item.source and data[j].source == item.source]
        numbers[i] = numbers[same[0]] if same else i
    for i, item in enumerate(holdout):
        parts = [j for j, other in enumerate(data) if other.source == item.source]
        if not item.source:
            parts = [i] if i < len(data) and not np.isin(item.rows, data[i].rows).any() else []
        numbers.append(numbers[parts[0]] if parts else len(data) + i)
    return numbers
