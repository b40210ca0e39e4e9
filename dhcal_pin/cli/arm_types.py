"""Type of an arm, which options of commands name: its default parameters."""

from __future__ import annotations

from dataclasses import replace

from ..exceptions import InvalidArgumentError
from ..plausibility.evidence import HAND_BUILT
from ..robot.chain import Chain


def with_arm_type(chain: Chain, arm: str | None, servos: str | None, parameters: str | None) -> Chain:
    """Return a chain with the default parameters of --arm, or with --servos those of a low-cost arm."""
    if arm and parameters:
        raise InvalidArgumentError("--arm: not allowed with --parameters, which may name the set low-cost")
    is_low_cost = arm == "low-cost" or (servos and arm is None and parameters is None)
    return replace(chain, parameters=HAND_BUILT) if is_low_cost else chain
