"""What inner loops over rows of samples need to run at the speed of the arithmetic."""

from __future__ import annotations

import math
import threading
from contextlib import ContextDecorator

import numpy as np

from .se3 import Array

_store = threading.local()


def scratch(name: str, *shape: int) -> Array:
    """An uninitialised array, which the next one of that name in this thread overwrites.

    Fresh pages would cost as much as filling them. It must not leave the function that asked for it,
    unless its caller knows.
    """
    size = math.prod(shape)
    held: Array | None = getattr(_store, name, None)
    if held is None or held.size < size:
        held = np.empty(size)
        setattr(_store, name, held)
    return held[:size].reshape(shape)


class LongRows(ContextDecorator):
    """Keeps NumPy from gathering rows of samples into its buffer first, which doubles an operation's time."""

    def __enter__(self) -> None:
        """Rows longer than the buffer are used where they are."""
        self.before = np.setbufsize(64)

    def __exit__(self, *_: object) -> None:
        """As it was."""
        np.setbufsize(self.before)

    def _recreate_cm(self) -> LongRows:
        return LongRows()
