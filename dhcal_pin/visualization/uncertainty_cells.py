"""Predicted uncertainty of the tool position by cells of the workspace, for the scene.

Configurations are drawn evenly from the joint ranges. The value of a cell is

    std = √(mean of std_i² over the configurations i whose tool point lies in the cell)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.uncertainty import Predictor
from ..formatting import round_down
from ..robot.sampling import random_configurations

# Configurations that are drawn; a cell of a robot with six joints contains about ten of them.
N_CONFIGURATIONS = 6000
# Cells along the largest extent of the workspace, at least.
MIN_CELLS = 10


@dataclass(frozen=True, eq=False)
class UncertaintyCells:
    """Cells that the tool reaches."""

    size: float  # Side of a cell [m]; 1, 2 or 5 times a power of ten
    # Integer coordinates, (c, 3): cell i contains the points p with floor(p / size) = index[i], in the frame
    # of the base link.
    index: Array
    std: Array  # Predicted standard deviation of the tool position, (c,) [m]


def uncertainty_cells(predictor: Predictor) -> UncertaintyCells:
    """Predict the uncertainty of the tool position by cells."""
    chain = predictor.chain
    prediction = predictor.relative.predict(random_configurations(chain, N_CONFIGURATIONS))
    points = se3.transform_points(se3.inverse(chain.base), prediction.poses[:, :3, 3])
    variances = prediction.position_std**2
    is_finite = np.isfinite(variances)
    points, variances = points[is_finite], variances[is_finite]
    if not len(points):
        return UncertaintyCells(1.0, np.empty((0, 3), int), np.empty(0))
    size = round_down(max(float(np.ptp(points, axis=0).max()) / MIN_CELLS, 1e-3))
    cells, index = np.unique(np.floor(points / size).astype(int), axis=0, return_inverse=True)
    index = index.reshape(-1)
    return UncertaintyCells(size, cells, np.sqrt(np.bincount(index, variances) / np.bincount(index)))
