"""Data structures that the kernels share with the packages above them.

Letters in shapes: m samples, n independent joints, k moving joints, t transmission terms, c configurations
per sample, r residuals per sample. The samples are on the last axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array


@frozen(eq=False)
class JointState:
    """Positions of a chain's joints at m configurations.

    Kinematic errors of links and frames do not change it. A fit therefore computes it once, unless it
    estimates transmission errors.
    """

    positions: Array  # Positions of the moving joints, shape (k, m) [rad or m]
    cos: Array  # Cosines of `positions`, shape (k, m)
    sin: Array  # Sines of `positions`, shape (k, m)


@frozen(eq=False)
class FrameBatch:
    """Frames of a chain at m samples."""

    # Columns x, y, z, p of the body frames in the measuring frame, then three columns of work memory for
    # `point_jacobian`, shape (k+1, 7, 3, m) [1, m]. The z axis of body frame j is the axis of joint j.
    columns: Array
    tool: Array  # Columns x, y, z, p of the tool frame, shape (4, 3, m) [1, m]
    # Transmission terms of the independent joints, shape (t, n, m); None without transmission errors.
    terms: Array | None = None
    conditions: Any = None  # Conditions of the samples; None if they are not known

    @property
    def bodies(self) -> Array:
        """Columns x, y, z, p of the body frames, shape (k+1, 4, 3, m)."""
        return self.columns[:, :4]

    def poses(self) -> Array:
        """Compute the tool poses in the measuring frame, shape (m, 4, 4)."""
        out = np.zeros((self.tool.shape[-1], 4, 4))
        out[:, :3, :] = self.tool.transpose(2, 1, 0)
        out[:, 3, 3] = 1.0
        return out


@frozen(eq=False)
class ObservationMatrix:
    """Sparse matrix H of a measurement: maps tool velocities to the r residual rows of each of m samples.

    The velocities are those of the tool point. If a measurement observes another body than the last one, they
    are those that the tool point would have if it were fixed to that body.

    With the tool velocity y = [vx, vy, vz, ωx, ωy, ωz] of the first configuration, followed by that of the
    second one for relative measurements, row i of sample t is the sum of coefficients[j, t]·y[components[j]]
    over the terms j with rows[j] = i. This is the Jacobian of the whitened residual by the tool pose.
    """

    rows: Array  # Row of each term, ascending, shape (j,)
    # Velocity component of each term (j,): 0 to 5 in the first, 6 to 11 in the second configuration.
    components: Array
    coefficients: Array  # Coefficients of the terms, shape (j, m)
    body: int | None = None  # Number of the observed body, 1 to k; None for the tool


def twists_before(body: int | None, bodies: Array, twists: Array) -> Array:
    """Return twists (..., p, 6) of bodies (p,), zero where they do not move the frame of an observed body."""
    return twists if body is None else np.where((bodies < body)[:, None], twists, 0.0)
