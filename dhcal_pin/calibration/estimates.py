"""Estimates: nominal and identified value of each parameter with its uncertainty.

A parameter of the robot is identified as an error x of its nominal value, so its value is nominal + x. The
components of base and tool are those of a pose: position and rotation vector of the calibrated base or tool.
Their nominal value is only the start of the fit and not an expectation, so they have no change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.error_model import ErrorParameter, frame_name
from ..formatting import format_quantity
from ..measurements.base import InstrumentParameter
from ..robot.chain import BASE_FRAME, Chain


@frozen
class Estimate:
    """Estimate of one parameter, in its unit (m, rad, or a rate)."""

    name: str  # Name of the parameter
    unit: str  # Unit of the parameter
    nominal: float  # Value before the calibration
    value: float  # Value after the calibration
    std: float  # Standard deviation of the value; infinite if neither measurements nor a prior determine it
    prior: float  # Standard deviation of its prior; infinite without a prior
    observability: float  # Fraction of the parameter that the measurements determine, 0 to 1
    posterior_to_prior_std: float  # Ratio of `std` to the standard deviation expected before the measurement
    fixed: bool  # Whether the parameter was held at its nominal value
    category: str  # "robot", "frame" (base and tool) or "instrument"
    # Frame in whose axes the parameter is defined, see `error_model.frame_name`; the measuring frame for the
    # base, the tip link for the tool, and empty for an instrument.
    frame: str = ""
    direction: str = ""  # Direction in this frame, such as "along x" or "about z"

    @property
    def change(self) -> float:
        """Value minus nominal value; NaN for a component of base or tool."""
        return math.nan if self.category == "frame" else self.value - self.nominal

    @property
    def certainty(self) -> str:
        """Standard deviation with its unit, "fixed" or "not observable"."""
        if self.fixed:
            return "fixed"
        if math.isinf(self.std):
            return "not observable"
        return format_quantity(self.std, self.unit, self.std, small=True)


def make_estimates(
    chain: Chain,
    parameters: Sequence[ErrorParameter | InstrumentParameter],
    figures: Array,
    fixed: Sequence[ErrorParameter],
) -> tuple[Estimate, ...]:
    """Make the estimates of all identified parameters, then those of the fixed ones."""
    frames = {BASE_FRAME: chain.base, chain.tool_frame_index: chain.tool}
    # Position and rotation vector of base and tool, shape (6,).
    components = {frame: se3.position_and_rotvec(pose) for frame, pose in frames.items()}
    rows = [(p, row, False) for p, row in zip(parameters, figures.tolist(), strict=True)]
    rows += [(p, [0.0] * 5, True) for p in fixed]
    estimates = []
    for p, (x, std, prior, observability, ratio), is_fixed in rows:
        nominal, value, category = p.nominal, p.nominal + x, "instrument"
        frame, direction = p.definition(chain) if isinstance(p, ErrorParameter) else ("", "")
        if isinstance(p, ErrorParameter):
            category = "frame" if p.error_frame in frames else "robot"
        if isinstance(p, ErrorParameter) and category == "frame":
            value = float(components[p.error_frame] @ np.array(p.twist))
            nominal = value if is_fixed else nominal
            frame = "measuring frame" if p.error_frame == BASE_FRAME else frame_name(chain, chain.tip_frame)
        figures_of_one = (nominal, value, std, prior, observability, ratio)
        estimates.append(Estimate(p.name, p.unit, *figures_of_one, is_fixed, category, frame, direction))
    return tuple(estimates)
