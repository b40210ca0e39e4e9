"""Confirmation of a mistake by all samples of the files that its remedy changes.

A hypothesis is decisive for the samples that were drawn, without those far away. A mistake that begins or
ends within a file leaves other samples right: as they were read they are nearer to the robot of the
hypothesis than after the change. If there are such samples, a robot is fitted again to each sample in the
nearer of both forms. Samples that fit it only as they were read are right. The mistake is then restricted to
the lines between which no sample is right. It is not stated if right and wrong samples alternate.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..measurements.base import Measurement, concatenate
from ..robot.chain import Chain
from .diagnosis import MIN_LOG_ADVANTAGE, MIN_LOG_RATIO, Diagnosis, is_fitted
from .drawn_samples import draw_samples, fit_drawn_samples, fit_samples
from .evidence import HAND_BUILT, Evidence
from .hypotheses import Hypothesis

# Samples fit a robot if their residuals are at most this multiple of the noise, and do not if they exceed the
# second one. Between both they decide nothing.
_MAX_FIT, _MIN_MISFIT = 4.0, 16.0
# A sample is nearer to a robot in one of two forms if its residual is smaller by this factor.
_MIN_RATIO = 4.0
# Smallest number of right samples that contradict a mistake in all samples.
_MIN_RIGHT = 3


class _Pair(NamedTuple):
    """Samples as they were read and after a change, and their residuals relative to the noise, (m,) each."""

    read: Measurement
    mended: Measurement
    before: Array
    after: Array

    @property
    def is_nearer_as_read(self) -> Array:
        """Whether each sample contradicts the change."""
        return (self.after > _MIN_MISFIT) & (_MIN_RATIO * self.before < self.after)

    @property
    def right(self) -> Array:
        """Lines of the samples that only fit as they were read."""
        return self.read.rows[(self.before <= _MAX_FIT) & (self.after > _MIN_MISFIT)]

    @property
    def wrong(self) -> Array:
        """Lines of the samples that only fit after the change."""
        return self.read.rows[(self.after <= _MAX_FIT) & (self.before > _MIN_MISFIT)]

    @property
    def nearer(self) -> Measurement:
        """Each sample in the form that is nearer to the robot."""
        is_changed = self.after <= self.before
        return concatenate([self.read.take(~is_changed), self.mended.take(is_changed)])


def confirm(chain: Chain, found: Diagnosis, data: Sequence[Measurement], sets: str) -> Diagnosis:
    """Restrict a mistake to the lines that contain it; leave it out if these are not consecutive."""
    if found.zero:
        zero = confirm(chain, found.zero, data, sets)
        found = replace(found, zero=zero if zero.hypotheses and not zero.lines else None)
    if not found.hypotheses:
        return found
    model, first = found.part or found.after, found.hypotheses[0]
    assert model is not None
    items = join_parts([item for item in data if not found.source or item.source == found.source])
    pairs = _pairs(model, items, first)
    if not pairs or sum(np.count_nonzero(pair.is_nearer_as_read) for pair in pairs) < _MIN_RIGHT:
        return found
    unexplained = replace(found, hypotheses=(), after=None, part=None, source="", gain=0.0)
    fitted = fit_drawn_samples(chain, [pair.nearer for pair in pairs], sets)
    if fitted.chain is None or not is_fitted(fitted):
        # Something else is wrong, too, if all samples left residuals before.
        return found if found.part else unexplained
    pairs = _pairs(fitted, items, first)
    right, wrong = (np.concatenate(each) for each in zip(*((p.right, p.wrong) for p in pairs), strict=True))
    if len(right) < _MIN_RIGHT:
        return found
    sources = {item.source for item in items}
    if len(sources) > 1 or not len(wrong):
        return unexplained
    lines = _lines_of(first, wrong, np.concatenate([item.rows for item in items]))
    if np.any((right >= lines[0]) & (right <= lines[1])):
        return unexplained
    # Equivalent hypotheses have to explain the same lines.
    others = [
        other
        for other in found.hypotheses[1:]
        if np.isin(wrong, np.concatenate([p.wrong for p in _pairs(fitted, items, other)])).all()
    ]
    return replace(
        found, hypotheses=(first, *others), after=fitted, part=None, source=sources.pop(), lines=lines
    )


def is_confirmed_by_lengths(
    chain: Chain, found: Diagnosis, data: Sequence[Measurement], lengths: Sequence[Measurement], sets: str
) -> bool:
    """Return whether a mistake in touched points explains the known lengths between them, too."""
    samples, first = draw_samples(data)[0], found.hypotheses[0]
    if found.log < fit_samples(chain, samples, HAND_BUILT).log + MIN_LOG_ADVANTAGE and sets != HAND_BUILT:
        return False  # Several errors of a hand-built arm explain the touches as well.
    changed = first.apply(samples)
    if changed is None:
        return True
    before = fit_samples(chain, [*samples, *lengths], sets)
    after = fit_samples(chain, [*changed, *lengths], sets)
    n_before, n_after = (sum(len(item.rows) for item in (*each, *lengths)) for each in (samples, changed))
    log = after.log * n_before / n_after + first.log_jacobian(chain, samples)
    return log >= before.log + MIN_LOG_RATIO and is_fitted(after)


def join_parts(data: Sequence[Measurement]) -> list[Measurement]:
    """Join fitted and held-out samples of each file, in which a shift of the rows needs neighbouring ones."""
    joined: list[Measurement] = []
    for item in data:
        for i, other in enumerate(joined):
            is_part = item.source == other.source and not np.intersect1d(item.rows, other.rows).size
            if is_part and type(item) is type(other):
                with suppress(InvalidArgumentError):
                    joined[i] = concatenate([other, item])
                    break
        else:
            joined.append(item)
    return joined


def _lines_of(hypothesis: Hypothesis, wrong: Array, rows: Array) -> tuple[int, int]:
    """Return the first and the last line of wrong samples, and of what a shift pairs with them."""
    step, rows = hypothesis.row_step, np.unique(rows)
    first, last = np.searchsorted(rows, [wrong.min(), wrong.max()])
    return int(rows[max(first - max(step, 0), 0)]), int(rows[min(last - min(step, 0), len(rows) - 1)])


def _pairs(evidence: Evidence, data: Sequence[Measurement], hypothesis: Hypothesis) -> list[_Pair]:
    """Compare the samples that a hypothesis changes before and after the change."""
    pairs = []
    for item in data:
        changed = hypothesis.change.apply(item)
        if changed is None or not len(changed.rows):
            continue
        _, i, j = np.intersect1d(item.rows, changed.rows, return_indices=True)
        read, mended = item.take(i), changed.take(j)
        before, after = evidence.misfits(read), evidence.misfits(mended)
        if before is not None and after is not None:
            pairs.append(_Pair(read, mended, before, after))
    return pairs
