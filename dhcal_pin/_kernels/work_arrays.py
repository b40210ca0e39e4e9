"""Reusable work memory, and NumPy settings for loops over long rows.

The first write to newly allocated memory costs page faults, which take about as long as the arithmetic of a
kernel. Work arrays are therefore kept per thread and name. A work array is valid until the next call of
`work_array` with the same name in the same thread.
"""

from __future__ import annotations

import math
import threading
from contextlib import ContextDecorator

import numpy as np

from .._typing import Array

_store = threading.local()
# Size of NumPy's ufunc buffer in `UnbufferedRows` [elements].
_BUFFER_SIZE = 64


def work_array(name: str, *shape: int) -> Array:
    """Return an uninitialized array; the next call with this name in this thread reuses its memory."""
    size = math.prod(shape)
    memory: Array | None = _store.__dict__.get(name)
    if memory is None or memory.size < size:
        memory = _store.__dict__[name] = np.empty(size)
    return memory[:size].reshape(shape)


class UnbufferedRows(ContextDecorator):
    """Context in which NumPy operates on strided rows directly, without copying them into its buffer.

    NumPy copies rows that fit into its ufunc buffer, and uses longer rows in place. A small buffer therefore
    halves the time of an operation on rows of samples. Contexts can be nested.
    """

    def __enter__(self) -> None:
        """Reduce the ufunc buffer size of this thread."""
        self.is_outermost = not getattr(_store, "has_small_buffer", False)
        if self.is_outermost:
            self.previous_size = np.setbufsize(_BUFFER_SIZE)
            _store.has_small_buffer = True

    def __exit__(self, *_: object) -> None:
        """Restore the previous ufunc buffer size."""
        if self.is_outermost:
            np.setbufsize(self.previous_size)
            _store.has_small_buffer = False

    def _recreate_cm(self) -> UnbufferedRows:
        """Return a new context for each call of a decorated function."""
        return UnbufferedRows()
