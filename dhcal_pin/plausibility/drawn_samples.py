"""Samples that are drawn from measurements, and their evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..measurements.base import Measurement
from ..robot.chain import Chain
from .diagnosis import NO_EVIDENCE, is_suspicious
from .evidence import Evidence, fit_evidence, fit_without_gross_outliers

# Fewer rows for each unknown of frames and instrument fit too many hypotheses. Base and tool have twelve.
_MIN_ROWS_PER_UNKNOWN, _N_FRAME_UNKNOWNS = 2, 12
# Positions this many times farther from the centre than the median are wrong by themselves.
_MAX_DISTANCE_RATIO = 8.0
# Largest number of measurements that are examined, those with the most samples.
_MAX_ITEMS = 6
# Smallest numbers of samples and rows that the evidence is computed from, and of samples of each measurement.
_N_SAMPLES, _N_ROWS, _MIN_SAMPLES_PER_ITEM = 50, 200, 8


def comparable_items(data: Sequence[Measurement]) -> list[Measurement]:
    """Return the measurements, at most `_MAX_ITEMS`, that distinguish hypotheses about joints."""
    # A robot with other errors can touch an unknown surface exactly, whatever the mistake is. The mistakes
    # listed here do not concern image coordinates.
    items = [item for item in data if item.configurations_per_row and not _is_surface_contact(item)]
    items = [item for item in items if item.rig is None]
    return sorted(items, key=lambda item: -len(item.rows))[:_MAX_ITEMS]


def _is_surface_contact(item: Measurement) -> bool:
    """Return whether the samples touch a surface, which gives one equation each."""
    return item.is_contact and item.residual_dim == 1


def has_enough_rows(samples: Sequence[Measurement]) -> bool:
    """Return whether samples have enough rows for the unknowns of frames and instrument."""
    n_rows = sum(item.residual_dim * len(item.rows) for item in samples)
    n_instrument = len({parameter.name for item in samples for parameter in item.instrument_parameters})
    return n_rows >= _MIN_ROWS_PER_UNKNOWN * (_N_FRAME_UNKNOWNS + n_instrument)


def fit_drawn_samples(chain: Chain, data: Sequence[Measurement], sets: str) -> Evidence:
    """Compute the evidence of samples that are drawn from measurements."""
    return fit_samples(chain, draw_samples(comparable_items(data))[0], sets)


def fit_samples(chain: Chain, samples: Sequence[Measurement], sets: str) -> Evidence:
    """Compute the evidence of samples; that of nothing if they are too few."""
    if not has_enough_rows(samples):
        return NO_EVIDENCE
    before = fit_evidence(chain, samples, sets)
    if is_suspicious(before) and any(item.is_contact for item in samples):
        # A few outliers are a simpler explanation than a mistake in all samples.
        robust = fit_without_gross_outliers(chain, samples, sets)
        before = max(before, robust or before, key=lambda each: each.log)
    if is_suspicious(before) and chain.error_families:
        # The joint errors of the robot may be wrong instead of the measurements.
        return max(before, fit_evidence(chain.urdf_alone, samples, sets), key=lambda each: each.log)
    return before


def draw_samples(data: Sequence[Measurement]) -> tuple[list[Measurement], list[Measurement]]:
    """Draw samples of each measurement; return them, and the same with the rows above and below each."""
    samples, neighbourhood = [], []
    for measured in data:
        needed = max(_N_SAMPLES, _N_ROWS // measured.residual_dim)
        count = max(_MIN_SAMPLES_PER_ITEM, -(-needed // len(data)))
        item = _without_far_positions(measured)
        item = item.take(np.argsort(item.rows, kind="stable"))
        m = len(item.rows)
        index = np.sort(np.random.default_rng(0).permutation(m)[:count])
        nearby = np.unique(np.clip(np.concatenate([index - 1, index, index + 1]), 0, m - 1))
        samples.append(item.take(index))
        neighbourhood.append(item.take(nearby))
    return samples, neighbourhood


def _without_far_positions(item: Measurement) -> Measurement:
    """Leave out positions far from all others, which would spoil the initial frames."""
    positions = item.positions()
    if not len(positions):
        return item
    distances = np.linalg.norm(positions - np.median(positions, 0), axis=1)
    return item.take(distances <= _MAX_DISTANCE_RATIO * np.median(distances))
