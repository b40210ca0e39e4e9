"""How far to trust a calibrated arm over its workspace: predicted position uncertainty, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .configurations import Room, Space
from .result import Result
from .se3 import Array

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
    """

    centre: Array
    size: float
    std: Array
    worst: Array
    count: Array


def workspace_map(fit: Result, cell: float = 0.1, samples: int = SAMPLES, seed: int = 0) -> WorkspaceMap:
    """The predicted position uncertainty of a calibrated arm wherever its tool can be.

    The same place is reached in many ways, and not equally well: each cell's figures are over configurations
    drawn evenly from the joints' range.

    Args:
        fit: a calibration.
        cell: side of a cell, m.
        samples: how many configurations.
        seed: of their choice.
    """
    room = Room.of(fit.chain, Space(), 0.0, 0.0)
    parts = np.array_split(room.draw(samples, np.random.default_rng(seed)), max(1, samples // CHUNK))
    found = [fit.predict(q) for q in parts]
    points = np.concatenate([one.poses[:, :3, 3] for one in found])
    std = np.concatenate([one.position_std for one in found])
    cells, which = np.unique(np.floor(points / cell).astype(int), axis=0, return_inverse=True)
    which = which.reshape(-1)
    count = np.bincount(which)
    worst = np.zeros(len(cells))
    np.maximum.at(worst, which, std)
    return WorkspaceMap(
        centre=(cells + 0.5) * cell,
        size=cell,
        std=np.sqrt(np.bincount(which, std**2) / count),
        worst=worst,
        count=count,
    )
