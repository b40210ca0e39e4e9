"""Run a module as `python -m` does, and end with the process that holds the other end of its standard input.

The server may be killed. The system then closes the pipe, and the command ends with all processes that it
started.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading


def _end_with_input() -> None:
    """Wait for the end of the standard input, and end this group of processes."""
    # Not `sys.stdin`, whose lock would hold up the end of the interpreter.
    os.read(0, 1)
    os.killpg(0, signal.SIGKILL)


# Processes that the command starts import this module, too.
if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
