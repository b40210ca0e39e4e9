"""Joint positions over time, as a smooth path through samples."""

from __future__ import annotations

from typing import Any

import numpy as np

from .._typing import Array


def joint_path(times: Array, q: Array) -> Any:
    """Return a cubic spline through joint positions (m, n) at times (m,); constant with a single time."""
    from scipy.interpolate import CubicSpline, PPoly  # lazy import: slow

    kept = np.diff(times, prepend=-np.inf) > 0
    if kept.sum() < 2:
        return PPoly(q[:1][None], np.array([0.0, 1.0]))
    return CubicSpline(times[kept], q[kept])
