"""Messages that compiled libraries print themselves, below Python."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# File descriptor of standard error.
_STDERR = 2
# A second thread would otherwise take the discarded stream for the original one.
_LOCK = threading.RLock()


@contextmanager
def discard_native_messages() -> Iterator[None]:
    """Discard what compiled libraries, and anything else, print to standard error in the `with` block."""
    with _LOCK:
        try:
            original = os.dup(_STDERR)
        except OSError:  # standard error is closed
            yield
            return
        null = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, _STDERR)
            yield
        finally:
            os.dup2(original, _STDERR)
            os.close(original)
            os.close(null)
