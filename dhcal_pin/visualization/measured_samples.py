"""Measured positions that a scene draws, with their residuals before and after the calibration.

A residual is the vector from the modelled to the measured point, in the measuring frame. Kinds without
positions, such as lengths, have none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..calibration.result import Result
from ..measurements.base import Measurement
from ..robot.chain import Chain
from ..subsampling import evenly_spaced_indices

# Names of the sets of samples; `MeasuredSamples.sets` contains their indices.
SETS = ("fitted", "held out", "outliers")
FITTED, HELD_OUT, OUTLIER = range(3)


@frozen(eq=False)
class MeasuredSamples:
    """Measured positions of m samples."""

    q: Array  # Joint positions, (m, n) [rad or m]
    points: Array  # Measured positions in the measuring frame, (m, 3) [m]
    residuals: Array  # Residuals of the calibrated robot, (m, 3) [m]
    nominal_residuals: Array  # Residuals of the nominal robot, (m, 3) [m]
    sets: Array  # Index into `SETS`, (m,)
    files: Array  # Name of the file of each sample, (m,); empty for samples from Python
    lines: Array  # Line in the file, (m,); the number of the sample, from 1, if it has no file

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.lines)

    def take(self, index: Array) -> MeasuredSamples:
        """Return some of the samples."""
        return MeasuredSamples(**{name: values[index] for name, values in vars(self).items()})


def sets_of(fit: Result) -> list[Array]:
    """Return the set of each sample of the fitted and the held-out measurements of a result."""
    return [
        *(np.where(mask, FITTED, OUTLIER) for mask in fit.is_counted),
        *(np.where(mask, HELD_OUT, OUTLIER) for mask in fit.is_holdout_counted),
    ]


def measured_samples(
    arms: tuple[Chain, Chain],
    measurements: Sequence[Measurement],
    known: tuple[Mapping[str, float], Mapping[str, float]],
    sets: Sequence[Array],
) -> MeasuredSamples:
    """Collect the measured positions and their residuals."""
    nothing = np.empty((0, 3))
    parts = [
        MeasuredSamples(
            q=np.empty((0, arms[0].n_joints)),
            points=nothing,
            residuals=nothing,
            nominal_residuals=nothing,
            sets=np.empty(0, int),
            files=np.empty(0, object),
            lines=np.empty(0, int),
        )
    ]
    for item, item_sets in zip(measurements, sets, strict=True):
        if len(item.positions()):
            before, after = (
                _position_residuals(chain, item, values) for chain, values in zip(arms, known, strict=True)
            )
            files = np.full(len(item.rows), Path(item.source).name, object)
            q = arms[0].validated_q(item.q)
            parts.append(MeasuredSamples(q, item.positions(), after, before, item_sets, files, item.rows))
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return MeasuredSamples(*map(np.concatenate, columns))


def _position_residuals(chain: Chain, item: Measurement, known: Mapping[str, float]) -> Array:
    """Return the vectors from modelled to measured points, (m, 3) [m]."""
    parameters = item.initialized(chain).instrument_parameters
    values = np.array([known.get(parameter.name, parameter.nominal) for parameter in parameters])
    return item.errors(chain.forward_kinematics(item.conditions()), values)["position"]


def drawn_samples(samples: MeasuredSamples, limit: int, n_largest: int) -> Array:
    """Choose samples to draw: those with the largest residuals, and others spread evenly over the files."""
    if len(samples) <= limit:
        return np.arange(len(samples))
    order = np.argsort(-np.linalg.norm(samples.residuals, axis=1), kind="stable")
    others = np.sort(order[n_largest:])
    return np.sort(
        np.concatenate([order[:n_largest], others[evenly_spaced_indices(len(others), limit - n_largest)]])
    )
