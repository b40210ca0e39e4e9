"""What inner loops over rows of samples need to run at the speed of the arithmetic."""

from __future__ import annotations

import math
import threading
from contextlib import ContextDecorator

import numpy as np

from .._typing import Array

_store = threading.local()


def work_array(name: str, *shape: int) -> Array:
    """An uninitialised array, which the next one of that name in this thread overwrites.

    Fresh pages would cost as much as filling them. It must not leave the function that asked for it,
    unless its caller knows.
    """
    size = math.prod(shape)
    held: Array | None = _store.__dict__.get(name)
    if held is None or held.size < size:
        held = _store.__dict__[name] = np.empty(size)
    return held[:size].reshape(shape)


class UnbufferedRows(ContextDecorator):
    """Keeps NumPy from gathering rows of samples into its buffer first, which doubles an operation's time."""

    def __enter__(self) -> None:
        """Rows longer than the buffer are used where they are."""
        self.outermost = not getattr(_store, "long_rows", False)
        if self.outermost:
            self.before = np.setbufsize(64)
            _store.long_rows = True

    def __exit__(self, *_: object) -> None:
        """As it was."""
        if self.outermost:
            np.setbufsize(self.before)
            _store.long_rows = False

    def _recreate_cm(self) -> UnbufferedRows:
        return UnbufferedRows()
