"""Type aliases that all packages share."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

# NumPy array; docstrings give its shape and unit.
Array = NDArray[Any]
# Path of a file, as `open` accepts it.
PathLike = str | os.PathLike[str]
# Callback of a long computation: name of the phase, number of its current step, and largest number of steps.
Progress = Callable[[str, int, int], None]


def no_progress(phase: str, step: int, total: int) -> None:
    """Receive the progress if nobody else does."""
