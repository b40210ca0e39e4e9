"""Information of measurements about a robot: samples and priors, from which a large covariance follows.

The covariance of hundreds of harmonics has no short form. Its inverse has one:

    Σ⁻¹ = Σ_i J_iᵀ·M_i·J_i + W² + A·Aᵀ - B·Bᵀ

- J_i is the Jacobian of the tool at the conditions of sample i, which the robot determines.
- M_i = H_iᵀ·H_i, (6, 6), is the information of sample i about the tool twist, with its whitened observation
  matrix H_i, and W are the prior weights. Both contain the factors of the stated covariance.
- A and B correct what the samples leave out: unknowns of instruments, other measurements, rounding.

Shapes: m samples, p parameters of the robot, b of them geometry, g gauge directions.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..measurements.base import instrument_values
from ..robot.conditions import Conditions, concatenate_conditions
from .problem import Chunk, Linearization, Problem

# Integer that stands for the largest entry of the roots.
ROOT_UNIT = np.iinfo(np.int16).max
# Conditions that the model of a robot does not depend on.
UNUSED_CONDITIONS = ("order", "time")
_UPPER = np.triu_indices(6)


def _nothing() -> Array:
    """Return an array without columns."""
    return np.empty((0, 0))


@frozen(eq=False)
class Samples:
    """Samples and their information M about the tool."""

    conditions: Conditions  #: Conditions of the samples.
    roots: Array  #: Upper parts of the roots of M, in units of the columns and of 1 / `ROOT_UNIT`, (21, m).
    units: Array  #: Units of the columns of the roots, (6,) [1/m and 1/rad].

    @classmethod
    def of(cls, problem: Problem, x: Array) -> Samples | None:
        """Collect the samples that observe the tool at one configuration each; None if there are none."""
        linearization = problem.linearize(x)
        parts = [(chunk.data.conditions(), _information(linearization, chunk)) for chunk in problem.chunks]
        parts = [(conditions, information) for conditions, information in parts if information is not None]
        conditions = concatenate_conditions([conditions for conditions, _ in parts]) if parts else None
        if conditions is None:
            return None
        information = np.concatenate([information for _, information in parts])
        counts = np.any(information != 0, (1, 2))
        conditions = replace(conditions[counts], **dict.fromkeys(UNUSED_CONDITIONS))
        return cls._rounded(conditions, information[counts]) if counts.any() else None

    @classmethod
    def _rounded(cls, conditions: Conditions, information: Array) -> Samples:
        """Round conditions and information to the numbers of files."""
        largest = np.sqrt(information.max(0).diagonal())
        units = np.repeat([largest[:3].max(), largest[3:].max()], 3)
        units[units == 0] = 1.0
        values, axes = np.linalg.eigh(information / np.outer(units, units))
        roots = axes * np.sqrt(np.maximum(values, 0.0))[:, None] @ axes.swapaxes(1, 2)
        known = {name: getattr(conditions, name) for name in (*conditions.names, "q")}
        rounded = {name: values.astype(np.float32).astype(float) for name, values in known.items()}
        return cls(Conditions(**rounded), np.rint(ROOT_UNIT * roots[:, *_UPPER].T), units)

    def rows(self, twists: Array) -> Array:
        """Compute the whitened rows (..., 6, m) of tool twists (..., 6, m)."""
        roots = np.zeros((6, 6, self.roots.shape[1]))
        roots[_UPPER] = roots[_UPPER[::-1]] = self.roots / ROOT_UNIT
        return np.einsum("ijm,...jm->...im", roots * self.units[:, None], twists)


@frozen(eq=False)
class Information:
    """What determines the covariance of a calibrated robot; see the equation of this module."""

    samples: Samples
    geometry: Array  #: Body twists per geometric parameter, as rows of an uncertainty, (6(k+1), b).
    prior: Array  #: Prior weights W, (p,).
    factor: float = 1.0  #: Factor on the information of the samples.
    added: Array = field(default_factory=_nothing)  #: Directions A, (p, ·).
    removed: Array = field(default_factory=_nothing)  #: Directions B, (p, ·).
    gauge: Array = field(default_factory=_nothing)  #: Gauge directions of free frames, (6(k+1)+e, g).
    coordinates: Array = field(default_factory=_nothing)  #: Gauge coordinates per parameter, (p, g).
    #: Root of the covariance of the parameters, (p, ·), of which a file has no copy.
    root: Array = field(default_factory=_nothing)


def _information(linearization: Linearization, chunk: Chunk) -> Array | None:
    """Compute the information of each sample about the tool, (m, 6, 6); None for other measurements."""
    data = chunk.data
    if data.configurations_per_row != 1 or not data.has_length_scale:
        return None
    frames, u = chunk.frames(linearization.chain), instrument_values(chunk.data, linearization.instruments)
    observation = data.observation_matrix(frames, u, data.residual(frames, u))
    if observation.body is not None:
        return None
    rows = np.zeros((len(data.rows), data.residual_dim, 6))
    for row, component, values in zip(
        observation.rows, observation.components, observation.coefficients, strict=True
    ):
        rows[:, row, component] += values
    return rows.swapaxes(1, 2) @ rows
