"""Rows of a linear model whose noise is estimated, alone or beside noise that is known.

The whitened rows [J | r] are in classes c. The variance of the rows of a class is

    v_c = 1 - t_c + t_c·s²

with the noise s, which is common to all classes, and the share t_c of the variance that it scales: 1 if
nothing is known of the noise, 0 if it is known. Corners of an image are between the two: they have the
noise of their detection and a displacement of the arm, see `calibration.cameras.displacement_rows`.

With the squared residuals C_c of the n_c rows of a class, γ_c of which the unknowns take up, the noise of
greatest evidence is the fixed point of

    s² = Σ (C_c - (n_c - γ_c)·(1 - t_c))·t_c/v_c² / Σ (n_c - γ_c)·t_c²/v_c².

Shapes: p unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .._typing import Array
from .folds import FoldSystems
from .qr import TriangularSystem, merge_r_factors


@dataclass(frozen=True, eq=False)
class NoiseClass:
    """Rows of one variance."""

    system: TriangularSystem  # System of the rows
    n_rows: int  # Number of rows
    share: float = 1.0  # Share t of the variance that the noise scales

    def variance(self, noise: float) -> float:
        """Return the variance of the rows."""
        return 1 - self.share + self.share * noise**2


@dataclass(frozen=True, eq=False)
class NoisyRows:
    """Rows of all classes, at one x (p,)."""

    classes: tuple[NoiseClass, ...]

    @property
    def n_scaled(self) -> int:
        """Number of rows whose noise is estimated."""
        return sum(one.n_rows for one in self.classes if one.share)

    def select(self, columns: Array) -> NoisyRows:
        """Return the rows of some of the unknowns, the others held."""
        return NoisyRows(
            tuple(NoiseClass(one.system.select(columns), one.n_rows, one.share) for one in self.classes)
        )

    def at(self, noise: float) -> TriangularSystem:
        """Return the system of all rows, divided by their standard deviations."""
        used = [one for one in self.classes if one.n_rows]
        scaled = [one.system.scaled(1 / np.sqrt(one.variance(noise))) for one in used]
        if len(scaled) == 1:
            return scaled[0]
        return TriangularSystem(merge_r_factors([one.rows for one in scaled]))

    def log_det(self, noise: float) -> float:
        """Return the sum of the logarithms of the standard deviations of all rows."""
        return 0.5 * sum(one.n_rows * float(np.log(one.variance(noise))) for one in self.classes)

    def noise_after(self, noise: float, step: Array, root: Array) -> float:
        """Return the noise that the rows show after a step (p,), from the noise before.

        The root is that of the covariance of the unknowns, see `TriangularSystem.sqrt_covariance`.
        """
        total = weight = smallest = 0.0
        for one in self.classes:
            if one.share and one.n_rows:
                variance = one.variance(noise)
                freedom = one.n_rows - one.system.predicted_variance(root) / variance
                excess = one.system.squared_error(step) - freedom * (1 - one.share)
                total += excess * one.share / variance**2
                weight += freedom * (one.share / variance) ** 2
                smallest = max(smallest, (one.share / variance) ** 2)
        return float(np.sqrt(max(total / max(weight, smallest), 0.0)))


@dataclass(frozen=True, eq=False)
class NoisyFold:
    """Rows of the fitted and of the held-out samples of a fold, at one x (p,)."""

    fitted: NoisyRows
    held_out: TriangularSystem  # System of the held-out rows whose noise is estimated
    n_rows: int  # Number of these rows

    def squared_error(self, noise: float, weights: Array, x: Array, columns: Array) -> float:
        """Compute the sum of the squared held-out rows under the fit of the other rows."""
        systems = FoldSystems(self.fitted.at(noise), self.held_out, self.n_rows)
        return self.n_rows * systems.error(weights, x, columns) ** 2


def join_classes(parts: Sequence[NoisyRows]) -> NoisyRows:
    """Join the rows of several parts of the samples, class by class."""
    return NoisyRows(
        tuple(
            NoiseClass(
                TriangularSystem(merge_r_factors([one.system.rows for one in same])),
                sum(one.n_rows for one in same),
                same[0].share,
            )
            for same in zip(*(part.classes for part in parts), strict=True)
        )
    )
