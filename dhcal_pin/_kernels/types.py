"""Frames and velocities of a serial arm over many samples, components first: samples are contiguous."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._typing import Array


@dataclass(frozen=True, eq=False)
class JointState:
    """What m configurations ask of a chain's joints; errors do not change it, so one serves a whole search.

    Attributes:
        independent: (n, m) values of the independent joints, rad or m.
        positions: (k, m) of the moving joints, rad or m.
        cos, sin: (k, m) of the values.
    """

    independent: Array
    positions: Array
    cos: Array
    sin: Array


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Frames of a chain at m samples, components first so that the samples are contiguous.

    Attributes:
        columns: (k+1, 7, 3, m) columns x, y, z, p of each body's frame in the measuring frame, and room for
            how a point moves that turns about x, y and z. A body's frame has its joint's axis along z.
        tool: (4, 3, m) columns of the tool's frame.
        terms: (t, n, m) of the independent joints' transmission, where the chain has one.
    """

    columns: Array
    tool: Array
    terms: Array | None = None

    @property
    def bodies(self) -> Array:
        """Columns x, y, z, p (k+1, 4, 3, m) of each body's frame."""
        return self.columns[:, :4]

    def poses(self) -> Array:
        """Tool poses (m, 4, 4) in the measuring frame."""
        out = np.zeros((self.tool.shape[-1], 4, 4))
        out[:, :3, :] = self.tool.transpose(2, 1, 0)
        out[:, 3, 3] = 1.0
        return out


@dataclass(frozen=True, eq=False)
class ObservationMatrix:
    """How the rows of m samples follow from the tool's velocity at c configurations of each.

    Each of n terms adds a share of one component of the velocity to one row.

    Attributes:
        rows: (n,) ascending.
        components: (n,) 0 to 5 for vx, vy, vz, ωx, ωy, ωz in the first configuration, 6 to 11 in the second.
        coefficients: (n, m).
    """

    rows: Array
    components: Array
    coefficients: Array
