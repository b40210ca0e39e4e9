"""Causes of errors during a session, and how they change the robot over time.

A cause is a block of columns of the linear model, such as the six of the base, times functions f of time:

- a step: f is -1 before it and 0 after it;
- a drift: f rises from -1 at the beginning to 0 at the end, linearly or as 1 - exp(-t/τ);
- a free drift: the first functions of the Karhunen-Loève expansion of a random walk that ends at 0,
  f = √2·sin(ω·(1 - s))/ω with ω = (i - ½)·π, for i = 1, 2, ... and the time s from 0 to 1;
- a constant: f = 1, for a lag of the joint values and a scale of one axis of the instrument; and for a
  payload that was never stated, beside a step of the payload.

A scale of all axes is a step between two measurement files, and the zero of a wire a step anywhere.

Every f but the constant is 0 at the end, so that the robot of the fit is that at the end of the session.

Reference: M. Loève, Probability Theory II, 4th edition, 1978, section 37.5.

Shapes: m samples, F functions of time, c columns of a block.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from .._frozen import frozen
from .._typing import Array

# Size of a change that is held at zero.
HELD_SIZE = 1e-12
# Number of functions of a free drift.
N_FUNCTIONS = 8

Kind = Literal["base", "tool", "joint", "links", "payload", "robot", "lag", "scale", "range", "wire"]


@frozen
class Step:
    """Step between two samples."""

    number: int  # Number of the first sample after it

    def values(self, numbers: Array, times: Array) -> Array:
        """Return f at samples, (m, 1)."""
        return np.where(numbers < self.number, -1.0, 0.0)[:, None]


@frozen
class Drift:
    """Drift from the first to the last sample."""

    begin: float  # Time of the first sample
    end: float  # Time of the last sample
    # Time constant τ of an exponential in the same unit; infinite for a linear drift.
    time_constant: float = np.inf

    def values(self, numbers: Array, times: Array) -> Array:
        """Return f at samples, (m, 1)."""
        share = _elapsed(self.begin, self.end, times)
        if np.isinf(self.time_constant):
            return (share - 1)[:, None]
        rate = (self.end - self.begin) / self.time_constant
        return (np.expm1(-rate * share) / np.expm1(-rate) - 1)[:, None]


@frozen
class FreeDrift:
    """Drift without a simple law, as a random walk."""

    begin: float  # Time of the first sample
    end: float  # Time of the last sample

    def values(self, numbers: Array, times: Array) -> Array:
        """Return the functions f at samples, (m, F)."""
        rates = (np.arange(N_FUNCTIONS) + 0.5) * np.pi
        return np.sqrt(2) * np.sin(rates * (1 - _elapsed(self.begin, self.end, times)[:, None])) / rates


@frozen
class Constant:
    """Cause that is the same for all samples."""

    def values(self, numbers: Array, times: Array) -> Array:
        """Return f at samples, (m, 1)."""
        return np.ones((len(numbers), 1))


def _elapsed(begin: float, end: float, times: Array) -> Array:
    """Return the share of the session that has passed at times (m,)."""
    return np.clip((times - begin) / (end - begin), 0.0, 1.0) if end > begin else np.ones(len(times))


Change = Step | Drift | FreeDrift
Shape = Change | Constant


@frozen(eq=False)
class Block:
    """Columns of the linear model that one cause uses."""

    kind: Kind  # What changes
    # Name of the joint, axis or wire, or of what moved if not base or tool; else empty.
    of: str
    columns: Array  # Indices of the columns, (c,)
    sizes: Array  # Change of each column that moves the tool by about 1 m, (c,)
    index: int = 0  # Number of the joint or of the axis of a scale; 0 for other blocks
    # Types of functions of time that are looked for.
    shapes: tuple[type[Shape], ...] = (Step, Drift, FreeDrift)
    is_of_recording: bool = False  # Whether it is an error of the recording, not a change of the robot
    # Point whose motion is stated, in the frame of base or tool, (3,) [m].
    origin: Sequence[float] | Array = (0.0, 0.0, 0.0)
    # Touched points in the frame of the base, (k, 3) [m], whose motion is stated in place of that of a point.
    touched: Array | None = None

    @property
    def is_of_values(self) -> bool:
        """Whether it is an error of measured values, which the conditions of a sample do not contain."""
        return self.is_of_recording and self.kind != "lag"

    @property
    def changes_between_files(self) -> bool:
        """Whether it is a scale of all axes, which shows only where it differs between files."""
        return self.kind == "scale" and not self.of

    @property
    def levers(self) -> Array:
        """Motion of the tool per unit of each column, (c,); 0 for columns that are held at zero."""
        is_free = self.sizes > HELD_SIZE
        return np.where(is_free, 1 / np.where(is_free, self.sizes, 1.0), 0.0)


@frozen(eq=False)
class Cause:
    """Something that changed during a session."""

    block: Block  # What changed
    shape: Shape  # How it changed over time
    # Its coefficients, (F·c,): those of the first function of time, of the second one, and so on.
    values: Array
    covariance: Array  # Their covariance, (F·c, F·c)
    log_evidence: float = 0.0  # Logarithm of the ratio of the evidence with and without it

    @property
    def sizes(self) -> Array:
        """Change of each coefficient that moves the tool by about 1 m, (F·c,)."""
        return np.tile(self.block.sizes, len(self.values) // len(self.block.sizes))

    @property
    def amplitudes(self) -> Array:
        """Coefficients of each function of time, (F, c)."""
        return self.values.reshape(-1, len(self.block.sizes))

    def columns_of(self, rows: Array, numbers: Array, times: Array) -> Array:
        """Return the columns of the coefficients in whitened rows (m, k, ·), (m, k, F·c)."""
        f = self.shape.values(numbers, times)
        own = rows[..., None, self.block.columns] * f[:, None, :, None]
        return own.reshape(*rows.shape[:2], -1)
