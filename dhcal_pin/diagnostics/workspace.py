"""How far to trust a calibrated arm over its workspace: position uncertainty and errors, cell by cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from ..calibration.evaluation import position_errors
from ..estimation.uncertainty import Predictor
from ..measurements.base import Measurement
from ..robot.sampling import ConfigurationSampler, WorkspaceConstraints

# Configurations that a map is made of, and predictions made at once.
SAMPLES, CHUNK = 20_000, 2000


@dataclass(frozen=True, eq=False)
class WorkspaceMap:
    """Predicted position uncertainty by cells of the workspace.

    Attributes:
        centre: (c, 3) middles of the cells that the tool reaches, m, in the measuring frame.
        size: the cells' side, m.
        std: (c,) RMS distance to expect between the tool and where the model has it, over the configurations
            that reach the cell, m; infinite where it cannot be told.
        worst: (c,) the largest of them, m.
        count: (c,) configurations that were looked at.
        readings: (c,) positions that were measured there.
        measured: (c,) RMS distance between these and where the model has them, m; NaN where there is none.
        expected: (c,) predicted RMS distance at these very configurations, m; NaN where there is none. The
            instrument's noise comes on top.
    """

    centre: Array
    size: float
    std: Array
    worst: Array
    count: Array
    readings: Array
    measured: Array
    expected: Array


def workspace_map(
    model: Predictor,
    data: Sequence[Measurement] = (),
    known: Mapping[str, float] | None = None,
    cell: float = 0.1,
    samples: int = SAMPLES,
    seed: int = 0,
) -> WorkspaceMap:
    """The predicted position uncertainty of a calibrated arm wherever its tool can be.

    The same place is reached in many ways, and not equally well: each cell's figures are over configurations
    drawn evenly from the joints' range.

    Args:
        model: a calibration, or what a file has kept of it.
        data: measurements to judge it by; those that are no positions are passed over.
        known: values of their instruments' unknowns; others are fitted to the data.
        cell: side of a cell, m.
        samples: how many configurations.
        seed: of their choice.
    """
    room = ConfigurationSampler.from_chain(model.chain, WorkspaceConstraints(), 0.0, 0.0)
    points, square = _predicted(model, room.draw(samples, np.random.default_rng(seed)))
    q, errors = position_errors(model.chain, data, known)
    there, expected = _predicted(model, q)
    every = np.floor(np.concatenate([points, there]) / cell).astype(int)
    cells, which = np.unique(every, axis=0, return_inverse=True)
    which = which.reshape(-1)
    worst = np.zeros(len(cells))
    np.maximum.at(worst, which, np.sqrt(np.concatenate([square, expected])))
    seen = which[len(points) :]
    return WorkspaceMap(
        centre=(cells + 0.5) * cell,
        size=cell,
        std=_rms(which, np.concatenate([square, expected]), len(cells)),
        worst=worst,
        count=np.bincount(which),
        readings=np.bincount(seen, minlength=len(cells)),
        measured=_rms(seen, errors**2, len(cells)),
        expected=_rms(seen, expected, len(cells)),
    )


def _predicted(model: Predictor, q: Array) -> tuple[Array, Array]:
    """Tool points (m, 3) and the predicted square distances (m,) at joint values (m, n)."""
    found = [model.predict(part) for part in np.array_split(q, len(q) // CHUNK + 1)]
    points = np.concatenate([one.poses[:, :3, 3] for one in found])
    return points, np.concatenate([one.position_std for one in found]) ** 2


def _rms(which: Array, square: Array, count: int) -> Array:
    """Root of the mean square by cell (c,); NaN where there is none."""
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.bincount(which, square, count) / np.bincount(which, minlength=count))
