"""Predicted accuracy of a calibrated robot over its workspace, beside measured errors.

The covariance of the estimated parameters predicts the standard deviation of the tool position in any
configuration. `predict_workspace` returns it for single configurations, `workspace_map` and
`uncertainty_cells` by cells of the workspace:

    std = √(mean of std_i² over the configurations i whose tool point lies in the cell)

Where the measurements leave the pose of base or tool free, as images do, positions are relative to the base
and tool poses that fit the measured configurations best, see `estimation.frame_gauge`.

A position is reached in many configurations, and not equally well in all of them. Errors that the model lacks
come on top of the prediction; the measured errors of a cell contain them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array
from ...estimation.uncertainty import Predictor
from ...formatting import round_down
from ...measurements.base import Measurement
from ...robot.sampling import ConfigurationSampler, WorkspaceConstraints, random_configurations
from ..evaluation import position_errors

# Configurations of a prediction by configurations, and of a map by cells.
N_PREDICTED_CONFIGURATIONS, N_MAP_CONFIGURATIONS = 6000, 20_000
# Smallest number of cells of a scene along the largest extent of the workspace; a cell of a robot with six
# joints contains about ten of the predicted configurations.
MIN_SCENE_CELLS = 10
# Added to texts on predictions where the measurements leave the pose of base or tool free.
RELATIVE_TEXT = (
    "The measurements leave the pose of the base or of the tool free, at least in part: unknown poses of "
    "cameras, boards or instruments take its place. The prediction is therefore that of positions relative "
    "to the base and tool poses that fit the measured samples best."
)
# Predictions that are computed at once; more need more memory and are not faster.
CHUNK_SIZE = 2000


@frozen(eq=False)
class WorkspacePrediction:
    """Predicted accuracy in single configurations."""

    points: Array  # Tool points in the base frame of s configurations all over the joint ranges, (s, 3) [m]
    std: Array  # Predicted standard deviations of their positions, (s,) [m]; infinite if not determined
    measured: Array  # Tool points of the measured samples in the base frame, (m, 3) [m]
    measured_std: Array  # Predicted standard deviations of their positions, (m,) [m]


def predict_workspace(model: Predictor, data: Sequence[Measurement]) -> WorkspacePrediction:
    """Predict the accuracy in configurations all over the joint ranges, and in the measured ones."""
    points, std = _predict_drawn_positions(model, N_PREDICTED_CONFIGURATIONS)
    measured = [item.configurations() for item in data if item.configurations_per_row > 0]
    q = np.concatenate([np.empty((0, model.chain.n_joints)), *measured])
    measured_points, measured_std = _predict_positions(model, q)
    base = se3.inverse(model.chain.base)
    return WorkspacePrediction(
        se3.transform_points(base, points), std, se3.transform_points(base, measured_points), measured_std
    )


@frozen(eq=False)
class WorkspaceMap:
    """Predicted and measured accuracy by cells of the workspace."""

    centre: Array  # Centres of the c cells that the tool reaches, in the measuring frame, (c, 3) [m]
    size: float  # Side of the cells [m]
    # Predicted RMS distance between tool and model over the configurations that reach the cell, (c,) [m];
    # infinite if it is not determined.
    std: Array
    worst: Array  # Largest predicted distance of these configurations, (c,) [m]
    count: Array  # Number of configurations, (c,)
    readings: Array  # Number of measured positions, (c,)
    # RMS distance between measured and modelled positions, (c,) [m]; NaN without measurements.
    measured: Array
    # Predicted RMS distance in the measured configurations, without the noise of the instrument, (c,) [m];
    # NaN without measurements.
    expected: Array


def workspace_map(
    model: Predictor,
    data: Sequence[Measurement] = (),
    known: Mapping[str, float] | None = None,
    cell: float = 0.1,
    samples: int = N_MAP_CONFIGURATIONS,
    seed: int = 0,
) -> WorkspaceMap:
    """Predict the position uncertainty of a calibrated robot by cells of its workspace.

    Args:
        model: Calibration, or what its sidecar file contains of it.
        data: Measurements to compare with; kinds without positions are ignored.
        known: Values of their instrument parameters by name; others are fitted to the data.
        cell: Side of a cell [m].
        samples: Number of configurations, drawn evenly from the joint ranges.
        seed: Seed of the draw.

    Returns:
        The cells that the tool reaches.
    """
    sampler = ConfigurationSampler.from_chain(model.chain, WorkspaceConstraints(), 0.0, 0.0)
    points, drawn_std = _predict_positions(model, sampler.draw(samples, np.random.default_rng(seed)))
    q, errors = position_errors(model.chain, data, known)
    measured_points, measured_std = _predict_positions(model, q)
    cells, index = _cells(np.concatenate([points, measured_points]), cell)
    measured_index = index[len(points) :]
    std = np.concatenate([drawn_std, measured_std])
    worst = np.zeros(len(cells))
    # NaN where the noise, and with it the uncertainty, is not known.
    with np.errstate(invalid="ignore"):
        np.maximum.at(worst, index, std)
    return WorkspaceMap(
        centre=(cells + 0.5) * cell,
        size=cell,
        std=_root_mean(index, std**2, len(cells)),
        worst=worst,
        count=np.bincount(index),
        readings=np.bincount(measured_index, minlength=len(cells)),
        measured=_root_mean(measured_index, errors**2, len(cells)),
        expected=_root_mean(measured_index, measured_std**2, len(cells)),
    )


@frozen(eq=False)
class UncertaintyCells:
    """Cells that the tool reaches, for a scene."""

    size: float  # Side of a cell [m]; 1, 2 or 5 times a power of ten
    # Integer coordinates, (c, 3): cell i contains the points p with floor(p / size) = index[i], in the frame
    # of the base link.
    index: Array
    std: Array  # Predicted standard deviation of the tool position, (c,) [m]


def uncertainty_cells(model: Predictor) -> UncertaintyCells:
    """Predict the uncertainty of the tool position by cells; configurations without one are left out."""
    points, std = _predict_drawn_positions(model, N_PREDICTED_CONFIGURATIONS)
    is_finite = np.isfinite(std)
    points = se3.transform_points(se3.inverse(model.chain.base), points[is_finite])
    if not len(points):
        return UncertaintyCells(1.0, np.empty((0, 3), int), np.empty(0))
    size = round_down(max(float(np.ptp(points, axis=0).max()) / MIN_SCENE_CELLS, 1e-3))
    cells, index = _cells(points, size)
    return UncertaintyCells(size, cells, _root_mean(index, std[is_finite] ** 2, len(cells)))


# A report has a map and a scene of the same robot.
@lru_cache(maxsize=1)
def _predict_drawn_positions(model: Predictor, count: int) -> tuple[Array, Array]:
    """Return tool points in configurations all over the joint ranges, and their standard deviations."""
    return _predict_positions(model, random_configurations(model.chain, count))


def _predict_positions(model: Predictor, q: Array) -> tuple[Array, Array]:
    """Return tool points (m, 3) in the measuring frame and their standard deviations (m,) [m]."""
    relative = model.relative
    predictions = [relative.predict(part) for part in np.array_split(q, len(q) // CHUNK_SIZE + 1)]
    points = np.concatenate([one.poses[:, :3, 3] for one in predictions])
    return points, np.concatenate([one.position_std for one in predictions])


def _cells(points: Array, size: float) -> tuple[Array, Array]:
    """Return integer coordinates (c, 3) of the cells with points (m, 3), and the cell of each point (m,)."""
    cells, index = np.unique(np.floor(points / size).astype(int), axis=0, return_inverse=True)
    return cells, index.reshape(-1)


def _root_mean(index: Array, squares: Array, count: int) -> Array:
    """Return the root of the mean of squares (m,) by cell, (count,); NaN for cells without any."""
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.bincount(index, squares, count) / np.bincount(index, minlength=count))
