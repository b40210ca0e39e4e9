"""Timeline of a session: when each sample was measured, relative to the others.

The samples are in the order of the files and of their lines, or of their times if all samples have one.
Known distances between touched points do not depend on the robot, and have no time. Their numbers precede
those of the samples of the robot.
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
from ..measurements.contact import PointContact
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
    file_starts: tuple[int, ...]  # Numbers of the first samples of all files of the robot but the first
    begin: int = 0  # Number of the first sample of the robot; smaller numbers have no time

    @property
    def fitted_numbers(self) -> Array:
        """Numbers of all fitted samples, in the order of the measurements."""
        return np.concatenate(self.numbers[: self.n_fitted])

    @property
    def fitted_times(self) -> Array:
        """Times of all fitted samples, in the order of the measurements."""
        return np.concatenate(self.times[: self.n_fitted])

    @property
    def of_robot(self) -> tuple[Measurement, ...]:
        """Measurements of the robot, without known distances."""
        return tuple(item for item in self.data if item.configurations_per_row)

    @property
    def q(self) -> Array:
        """Joint positions of all samples of the robot, (m, n) [rad or m]."""
        return np.concatenate([item.q for item in self.of_robot])

    @property
    def has_consecutive_files(self) -> bool:
        """Whether each file of the robot was measured before the next one began."""
        files = {item.source or i for i, item in enumerate(self.of_robot)}
        return len(self.file_starts) == len(files) - 1

    @property
    def is_of_contacts(self) -> bool:
        """Whether all samples of the robot are contacts with points."""
        return all(isinstance(item, PointContact) for item in self.of_robot)

    def touched_points(self, number: int | None) -> list[str]:
        """Return the names of the touched points, of those on both sides of a step if there are any."""
        touches: dict[str, list[Array]] = {}
        for item, numbers in zip(self.data, self.numbers, strict=True):
            for i, name in enumerate(item.names if isinstance(item, PointContact) else ()):
                touches.setdefault(name, []).append(numbers[item.label == i])
        if number is None:
            return list(touches)
        sides = {name: np.concatenate(parts) < number for name, parts in touches.items()}
        shown = [name for name, is_before in sides.items() if is_before.any() and not is_before.all()]
        return shown or list(touches)

    @cached_property
    def _counted(self) -> Array:
        """Fitted samples in the order of measurement; of consecutive ones at one configuration the first."""
        # They share the error of the model.
        order = np.argsort(self.fitted_numbers, kind="stable")
        order = order[self.fitted_numbers[order] >= self.begin]
        q = np.concatenate([item.q for item in self.data[: self.n_fitted]])[order]
        return order[np.diff(group_by_configuration(q), prepend=-1) != 0]

    @property
    def directions(self) -> tuple[Array, ...]:
        """Direction of the last motion of each joint (m, n) of each measurement; 0 where a file begins."""
        order = np.argsort(np.concatenate(self.numbers))[self.begin :]
        q = np.concatenate([item.q for item in self.data])
        directions = np.zeros_like(q)
        files = np.split(q[order], np.subtract(self.file_starts, self.begin).astype(int))
        directions[order] = np.concatenate([directions_in_order(each) for each in files])
        return tuple(np.split(directions, np.cumsum([len(each) for each in self.numbers])[:-1]))

    def with_fitted(self, data: Sequence[Measurement]) -> Timeline:
        """Return the timeline with other values of the fitted samples."""
        return replace(self, data=(*data, *self.data[self.n_fitted :]))

    def thinned(self, count: int) -> Timeline:
        """Return the timeline of at most `count` fitted samples of the robot, evenly spaced."""
        order = self._counted
        kept = self.fitted_numbers < self.begin
        kept[order[:: max(1, -(-len(order) // count))]] = True
        ends = np.cumsum([len(each) for each in self.numbers[: self.n_fitted]])[:-1]
        masks = np.split(kept, ends)
        data = tuple(item.take(mask) for item, mask in zip(self.data, masks, strict=False))
        parts = [
            tuple(each[mask] for each, mask in zip(values, masks, strict=False))
            for values in (self.numbers, self.times)
        ]
        return replace(self, data=data, numbers=parts[0], times=parts[1])

    def shorter_side(self, number: int) -> float:
        """Return the share of the fitted samples of the robot on the shorter side of a step."""
        of_robot = self.fitted_numbers[self.fitted_numbers >= self.begin]
        share = float(np.mean(of_robot < number))
        return min(share, 1 - share)

    def place(self, number: int) -> Place:
        """Return where a sample stands."""
        for item, numbers in zip(self.data, self.numbers, strict=True):
            found = numbers == number
            if found.any():
                rows = item.rows[found]
                return Place(item.source, int(rows.min()), int(rows.max()), str(item.photographs()[found][0]))
        raise IndexError(number)

    def number_of(self, place: Place) -> int:
        """Return the number of the first sample that stands at a place."""
        of_file = [each for each in zip(self.data, self.numbers, strict=True) if each[0].source == place.file]
        return min(
            int(numbers[item.rows == place.line].min(initial=np.iinfo(int).max)) for item, numbers in of_file
        )


def order_samples(data: Sequence[Measurement], holdout: Sequence[Measurement]) -> Timeline:
    """Put the samples of measurements into the order of measurement."""
    items = (*data, *holdout)
    files = _file_numbers(data, holdout)
    counts = [len(item.rows) for item in items]
    file, of_robot = (
        np.repeat(each, counts) for each in (files, [item.configurations_per_row > 0 for item in items])
    )
    clocks = [item.recorded.time if item.recorded is not None else None for item in items]
    stated = np.concatenate(
        [np.full(m, np.nan) if c is None else c for c, m in zip(clocks, counts, strict=True)]
    )
    has_times = bool(of_robot.any() and np.isfinite(stated[of_robot]).all())
    if has_times:
        stated = np.where(of_robot, stated, stated[of_robot].min())
    rows = np.concatenate([item.rows for item in items])
    order = np.lexsort((rows, file, *((stated,) if has_times else ()), of_robot))
    numbers = np.empty(len(order), int)
    numbers[order] = np.arange(len(order))
    times = stated if has_times else numbers.astype(float)
    ends = np.cumsum(counts)[:-1]
    begin = int(np.sum(~of_robot))
    starts = begin + np.flatnonzero(np.diff(file[order][begin:])) + 1
    return Timeline(
        items,
        len(data),
        tuple(np.split(numbers, ends)),
        tuple(np.split(times, ends)),
        "s" if has_times else "row",
        tuple(starts.tolist()),
        begin,
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
