"""Joint ranges of images: outside of them, the corrections of an estimated arm were not verified."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...measurements.base import Measurement
from ...robot.chain import Chain
from ..partition import different_configurations

# Share of the range of a joint below which a warning names it, and largest number of joints that it names.
MIN_SHARE, MAX_JOINTS = 0.5, 3


def small_ranges(chain: Chain, data: Sequence[Measurement]) -> list[str]:
    """List the joints that moved in a small part of their range, with their values, smallest part first."""
    q = different_configurations(data)[0]
    limit = np.where(chain.is_prismatic, np.inf, np.pi)
    ranges = np.minimum(chain.upper, limit) - np.maximum(chain.lower, -limit)
    low, high = q.min(0), q.max(0)
    shares = (high - low) / ranges
    few = [int(i) for i in np.argsort(shares, kind="stable") if shares[i] < MIN_SHARE and ranges[i] < np.inf]
    return [
        f"{chain.joint_names[i]} {1e3 * low[i]:.0f} to {1e3 * high[i]:.0f} mm"
        if chain.is_prismatic[i]
        else f"{chain.joint_names[i]} {np.rad2deg(low[i]):.0f}° to {np.rad2deg(high[i]):.0f}°"
        for i in few
    ]


def seen_ranges_warning(chain: Chain, data: Sequence[Measurement]) -> str:
    """Warn of joints that moved in a small part of their range only."""
    names = small_ranges(chain, data)
    if not names:
        return ""
    more = f", and {len(names) - MAX_JOINTS} more" if len(names) > MAX_JOINTS else ""
    count = "a joint" if len(names) == 1 else f"{len(names)} joints"
    return (
        f"The images show less than half of the range of {count}: {', '.join(names[:MAX_JOINTS])}{more}. "
        "Outside of what they show, the corrections of the arm are not verified."
    )
