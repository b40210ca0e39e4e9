"""Numbers and tables as people read them: millimetres, degrees, digits as far as they are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se3
from .._typing import Array
from ..estimation.error_model import ErrorParameter
from ..formatting import format_quantity
from ..measurements.base import InstrumentParameter
from ..robot.chain import BASE_FRAME, Chain


@dataclass(frozen=True)
class Estimate:
    """What was found of one parameter, m and rad.

    Attributes:
        name, unit: of the parameter.
        nominal, value: before and after.
        std: standard deviation, infinite where nothing tells.
        prior: standard deviation expected before any measurement, infinite without a prior.
        observability: how far the data see it, 0 to 1.
        posterior_to_prior_std: the share that std is of what was expected before the measurement.
        fixed: whether it was held.
        category: "robot", "frame" (base and tool) or "instrument".
    """

    name: str
    unit: str
    nominal: float
    value: float
    std: float
    prior: float
    observability: float
    posterior_to_prior_std: float
    fixed: bool
    category: str

    @property
    def change(self) -> float:
        """Value minus nominal; NaN for a frame, whose nominal place means nothing."""
        return math.nan if self.category == "frame" else self.value - self.nominal

    @property
    def certainty(self) -> str:
        """The standard deviation in words."""
        if self.fixed:
            return "fixed"
        return (
            "not seen" if math.isinf(self.std) else format_quantity(self.std, self.unit, self.std, small=True)
        )


def estimates(
    chain: Chain,
    parameters: Sequence[ErrorParameter | InstrumentParameter],
    figures: Array,
    fixed: Sequence[ErrorParameter],
) -> tuple[Estimate, ...]:
    """What was found of each unknown, then the parameters that were held.

    Args:
        chain: calibrated; base and tool are given by component of their place, others as nominal plus error.
        parameters: of the robot and the instruments, p of them.
        figures: (p, 5) found error, standard deviation, prior, observability and share remaining of each.
        fixed: parameters that were held.
    """
    frames = {BASE_FRAME: chain.base, chain.tool_frame_index: chain.tool}
    sixes = {at: np.append(pose[:3, 3], se3.log3(pose[:3, :3])) for at, pose in frames.items()}
    rows = [(p, row, False) for p, row in zip(parameters, figures.tolist(), strict=True)]
    rows += [(p, [0.0] * 5, True) for p in fixed]
    out = []
    for p, (x, std, prior, seen, left), held in rows:
        nominal, value, place = p.nominal, p.nominal + x, "instrument"
        if isinstance(p, ErrorParameter):
            place = "frame" if p.error_frame in frames else "robot"
        if isinstance(p, ErrorParameter) and place == "frame":
            value = float(sixes[p.error_frame] @ np.array(p.twist))
            nominal = value if held else nominal
        out.append(Estimate(p.name, p.unit, nominal, value, std, prior, seen, left, held, place))
    return tuple(out)
