"""Even subsampling of long series, so that drawings stay small and fast."""

from __future__ import annotations

import numpy as np

from ._typing import Array


def evenly_spaced_indices(count: int, limit: int) -> Array:
    """Choose at most `limit` indices that are spread evenly over a series."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))
