"""All mistakes in the rig of images, corrected in turn."""

from __future__ import annotations

from collections.abc import Sequence

from ...._frozen import frozen
from ....measurements.base import Measurement
from ....robot.chain import Chain
from ..stages import Stage
from .axis_order import Exchange, axis_stages, exchange_axes, reorder
from .inverse_poses import PoseDifference, free_wrong_poses


@frozen
class RigMistakes:
    """Mistakes in a rig."""

    exchanges: tuple[Exchange, ...] = ()  # Exchanged axes
    poses: tuple[PoseDifference, ...] = ()  # Stated poses that are not used as first values

    @property
    def sentences(self) -> list[str]:
        """What is wrong, and what to do about it."""
        inverse = [pose.sentence for pose in self.poses if pose.is_inverse]
        return [*(exchange.sentence for exchange in self.exchanges), *inverse]

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Stages of the calibration that the corrections are."""
        return axis_stages(self.exchanges)


def correct_rig(
    chain: Chain, data: Sequence[Measurement], holdout: Sequence[Measurement], sets: Sequence[str]
) -> tuple[tuple[Measurement, ...], tuple[Measurement, ...], RigMistakes]:
    """Correct the rig of fitted and held-out images before a calibration of some parameter sets."""
    both, poses = free_wrong_poses(chain, data, holdout, sets)
    data, exchanges = exchange_axes(chain, both[: len(data)])
    return data, reorder(both[len(data) :], exchanges), RigMistakes(exchanges, poses)
