"""How far measurements lie outside the region of joint space that a robot was calibrated in.

The accuracy of a calibration is known within its measured region. Errors of samples inside and outside are
therefore compared separately. Of new configurations that are drawn like those of the calibration, 5 % lie
outside, see `measurements.measured_region`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._frozen import frozen
from ..calibration.evaluation import Accuracy, compute_errors, take_errors
from ..formatting import format_quantity, list_first
from ..measurements.base import Measurement
from ..measurements.groups import ERROR_GROUPS
from ..measurements.measured_region import MeasuredRegion
from ..robot.chain import Chain

# A joint value is beyond the measured range of its joint if it exceeds it by more than this [rad or m].
_MIN_EXCESS = 1e-6
# Largest number of joints that a sentence names.
_MAX_JOINTS = 3


@frozen(eq=False)
class Extrapolation:
    """Samples inside and outside the measured region of a calibration."""

    n_samples: int  #: Number of samples.
    n_outside: int  #: Number of samples outside the region.
    n_beyond_reach: int  #: Number of samples that are farther away than regions that were left out.
    #: Largest distance of a sample from the region's configurations, in radii of the region.
    max_distance: float
    #: Largest distance of a joint value from the measured range of each joint [rad or m]; only joints that
    #: exceed it.
    max_excess: Mapping[str, float]
    is_prismatic: Mapping[str, bool]  #: Whether each of these joints is prismatic.
    inside: Accuracy  #: Accuracy of the samples inside; empty if there are none.
    outside: Accuracy  #: Accuracy of the samples outside; empty if there are none.

    @property
    def sentences(self) -> list[str]:
        """Sentences on the number of samples outside, the errors there, and the joints that exceed."""
        if not self.n_samples:
            return []
        if not self.n_outside:
            return [f"All {self.n_samples} samples are within the measured region of the calibration."]
        share = 100 * self.n_outside / self.n_samples
        out = [
            f"{self.n_outside} of {self.n_samples} samples ({share:.0f} %) {_verb(self.n_outside)} outside "
            "the measured region of the calibration."
        ]
        if self.n_beyond_reach:
            out.append(
                f"{self.n_beyond_reach} of them {_verb(self.n_beyond_reach)} farther away than the regions "
                "that were left out to judge the calibration: no accuracy was stated there."
            )
        for group in [name for name in self.inside.groups if name in self.outside.groups]:
            inside, outside = self.inside.groups[group], self.outside.groups[group]
            texts = [
                format_quantity(side.rms, side.unit, side.rms_std, small=True) for side in (inside, outside)
            ]
            out.append(f"RMS {ERROR_GROUPS[group].label}: {texts[0]} inside, {texts[1]} outside.")
        exceeding = [f"{name} by {self._describe_excess(name)}" for name in self.max_excess]
        if not exceeding:
            text = (
                "No joint is beyond its measured range, but the combinations of joint values are new or rare."
            )
            return [*out, text]
        return [*out, f"Beyond the measured range: {list_first(exceeding, _MAX_JOINTS, 'joint')}."]

    def _describe_excess(self, name: str) -> str:
        """Return how far a joint is beyond its measured range, in mm or degrees."""
        value, is_prismatic = self.max_excess[name], self.is_prismatic[name]
        size, unit = (1e3 * value, " mm") if is_prismatic else (np.rad2deg(value), "°")
        return f"{size:.0f}{unit}" if size >= 1 else f"under 1{unit}"

    def to_dict(self) -> dict[str, Any]:
        """Return the content for the JSON document."""
        return {
            "samples_outside": self.n_outside,
            "samples_beyond_reach": self.n_beyond_reach,
            "largest_distance": self.max_distance,
            "largest_excess": dict(self.max_excess),
            "inside": self.inside.to_dict(),
            "outside": self.outside.to_dict(),
        }


def _verb(count: int) -> str:
    return "is" if count == 1 else "are"


def find_extrapolation(
    region: MeasuredRegion, chain: Chain, data: Sequence[Measurement], known: Mapping[str, float]
) -> Extrapolation:
    """Find the samples outside the measured region of a calibration, and the errors inside and outside."""
    data = [item for item in data if item.configurations_per_row and len(item.rows)]
    errors = compute_errors(chain, data, known)
    # The distance of a sample is that of its farthest configuration.
    distances = [
        region.distances(item.configurations()).reshape(item.configurations_per_row, -1).max(0)
        for item in data
    ]
    is_outside = [each > region.radius for each in distances]
    inside, outside = (
        Accuracy.from_errors(take_errors(errors, masks))
        for masks in ([np.logical_not(mask) for mask in is_outside], is_outside)
    )
    q = np.concatenate([item.configurations() for item in data] or [np.empty((0, chain.n_joints))])
    excess = dict(zip(chain.joint_names, region.excess(q).max(0, initial=0.0).tolist(), strict=True))
    beyond = {name: value for name, value in excess.items() if value > _MIN_EXCESS}
    prismatic = dict(zip(chain.joint_names, chain.is_prismatic.tolist(), strict=True))
    distance = max((float(each.max()) for each in distances), default=0.0)
    return Extrapolation(
        n_samples=sum(map(len, is_outside)),
        n_outside=int(sum(mask.sum() for mask in is_outside)),
        n_beyond_reach=int(sum(np.sum(each > region.reach) for each in distances)),
        max_distance=distance / region.radius if region.radius else (np.inf if distance else 0.0),
        max_excess=dict(sorted(beyond.items(), key=lambda item: -item[1])),
        is_prismatic={name: prismatic[name] for name in beyond},
        inside=inside,
        outside=outside,
    )
