"""Causes of errors during a session, and how they change the robot over time.

A cause is a block of columns of the linear model, such as the six of the base, times a function f of time:

- a step: f is -1 before it and 0 after it;
- a drift: f rises from -1 at the begin to 0 at the end, linearly or as 1 - exp(-t/τ);
- a constant: f = 1, for a lag of the joint values and a scale of the instrument.

Every f but the constant is 0 at the end, so that the robot of the fit is that at the end of the session.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .._typing import Array

Kind = Literal["base", "tool", "joint", "links", "robot", "lag", "scale"]


@dataclass(frozen=True, eq=False)
class Block:
    """Columns of the linear model that one cause uses.

    Attributes:
        kind: What changes.
        of: Name of the joint, or of the axis of a scale; else empty.
        index: Number of the joint; 0 for other blocks.
        columns: Indices of the columns, (c,).
        sizes: Change of each column that moves the tool by about 1 m, (c,).
        is_constant: Whether it is the same for all samples.
    """

    kind: Kind
    of: str
    index: int
    columns: Array
    sizes: Array
    is_constant: bool = False


@dataclass(frozen=True)
class Step:
    """Step between two samples.

    Attributes:
        number: Number of the first sample after it.
    """

    number: int

    def values(self, numbers: Array, times: Array) -> Array:
        """Return f at samples (m,)."""
        return np.where(numbers < self.number, -1.0, 0.0)


@dataclass(frozen=True)
class Drift:
    """Drift from the first to the last sample.

    Attributes:
        begin: Time of the first sample.
        end: Time of the last sample.
        time_constant: Time constant τ of an exponential in the same unit; infinite for a linear drift.
    """

    begin: float
    end: float
    time_constant: float = np.inf

    def values(self, numbers: Array, times: Array) -> Array:
        """Return f at samples (m,)."""
        span = self.end - self.begin
        share = np.clip((times - self.begin) / span, 0.0, 1.0) if span else np.ones(len(times))
        if np.isinf(self.time_constant):
            return share - 1
        rate = span / self.time_constant
        return np.expm1(-rate * share) / np.expm1(-rate) - 1


@dataclass(frozen=True)
class Constant:
    """Cause that is the same for all samples."""

    def values(self, numbers: Array, times: Array) -> Array:
        """Return f at samples (m,)."""
        return np.ones(len(numbers))


Shape = Step | Drift | Constant


@dataclass(frozen=True, eq=False)
class Cause:
    """Something that changed during a session.

    Attributes:
        block: What changed.
        shape: How it changed over time.
        values: Its c coefficients, (c,).
        covariance: Their covariance, (c, c).
        log_evidence: Logarithm of the ratio of the evidence with and without it.
        effect: RMS of its effect on the residuals of the samples that it concerns, in standard deviations.
    """

    block: Block
    shape: Shape
    values: Array
    covariance: Array
    log_evidence: float = 0.0
    effect: float = 0.0
