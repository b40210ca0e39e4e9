"""Signals that wait until files are saved.

Elsewhere SIGINT raises `KeyboardInterrupt` between any two instructions, and SIGTERM and SIGHUP end the
process at once. In the block of `defer_signals` they are only noted, and they are delivered at its end.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType
from typing import Any

# Signals that wait. SIGINT is the first one: as soon as it waits, nothing interrupts the installation.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class DeferredSignals:
    """Context in which signals wait; in other threads than the main one it does nothing.

    Python handles signals in the main thread only, so that other threads are not interrupted anyway.
    """

    _active: DeferredSignals | None = None

    def __init__(self) -> None:
        self._received: list[int] = []
        self._previous: dict[int, Any] = {}
        self._is_interruptible = False

    def __enter__(self) -> DeferredSignals:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                previous = signal.getsignal(number)
                # None is a handler that was not installed from Python and that could not be restored.
                if previous is not None and previous != signal.SIG_IGN:
                    self._previous[number] = previous
                    signal.signal(number, self._receive)
                    DeferredSignals._active = self
        return self

    def __exit__(self, *_: object) -> None:
        if DeferredSignals._active is not self:
            return
        DeferredSignals._active = None
        # SIGINT last: once it is restored, an interrupt can end this function.
        for number in reversed(SIGNALS):
            if number in self._previous:
                signal.signal(number, self._previous[number])
        for number in sorted(set(self._received), reverse=True):
            previous = self._previous[number]
            if previous == signal.SIG_DFL:
                os.kill(os.getpid(), number)
            else:
                previous(number, None)

    def _receive(self, number: int, _: FrameType | None) -> None:
        self._received.append(number)
        if self._is_interruptible:
            self._is_interruptible = False
            raise KeyboardInterrupt

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Let signals end a block that may take long, such as waiting for the reader of a pipe."""
        if self._received:
            raise KeyboardInterrupt
        self._is_interruptible = True
        try:
            yield
        finally:
            self._is_interruptible = False


def defer_signals() -> AbstractContextManager[DeferredSignals]:
    """Let SIGINT, SIGTERM and SIGHUP wait until the end of the `with` block."""
    active = DeferredSignals._active
    is_nested = active is not None and threading.current_thread() is threading.main_thread()
    return nullcontext(active) if active is not None and is_nested else DeferredSignals()
