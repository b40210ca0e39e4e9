"""A process that ends itself, or interrupts itself, at a chosen instruction of a function."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any


class SignalAtStep:
    """Context that sends a signal to this process at one instruction.

    Attributes:
        step: Number of the instruction, counted from 0 over all Python functions that are called.
        number: Signal; None only counts the instructions.
        count: Number of instructions so far.
    """

    def __init__(self, step: int = -1, number: int | None = None):
        self.step, self.number, self.count = step, number, 0

    def __enter__(self) -> SignalAtStep:
        sys.settrace(self._trace)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _trace(self, frame: FrameType, event: str, _: Any) -> Callable[..., Any]:
        frame.f_trace_opcodes = True
        if event == "opcode":
            if self.count == self.step and self.number is not None:
                self.count += 1
                os.kill(os.getpid(), self.number)
            else:
                self.count += 1
        return self._trace


def count_steps(function: Callable[[], object]) -> int:
    """Count the instructions of a function."""
    with SignalAtStep() as steps:
        function()
    return steps.count


def run_in_child(function: Callable[[], object], step: int, number: int) -> int:
    """Run a function in a child process that gets a signal at a step; return how the child ended.

    Returns:
        0 for a normal end, 130 after `KeyboardInterrupt`, minus the number of the signal that killed it.
    """
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with SignalAtStep(step, number):
            function()
        status = 0
    except KeyboardInterrupt:
        status = 130
    finally:
        os._exit(status)
