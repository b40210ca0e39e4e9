"""Executors for independent tasks: this process, local processes, or a Dask cluster; threads of BLAS.

The order of the results is the order of the tasks for every executor, so that sums over results do not
depend on the executor and neither does any digit of a calibration.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from ._frozen import frozen
from .exceptions import InvalidArgumentError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from threadpoolctl import ThreadpoolController

_Task = TypeVar("_Task")
_Output = TypeVar("_Output")
# Seconds that a worker without its parent may take to save files.
_SAVING_TIMEOUT_S = 60
# Seconds to wait for a Dask scheduler.
_CONNECT_TIMEOUT_S = 3
# Environment variables that set the number of threads of BLAS.
BLAS_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread, unless the environment sets the number of its threads."""
    # The matrices are small: further threads mostly wait, and a calibration takes twice as long.
    if any(name in os.environ for name in BLAS_VARIABLES):
        yield
    else:
        with _blas_libraries().limit(limits=1):
            yield


@cache
def _blas_libraries() -> ThreadpoolController:
    """Find the BLAS libraries of NumPy and SciPy in this process."""
    from threadpoolctl import ThreadpoolController  # lazy import: not needed by the command line

    return ThreadpoolController().select(user_api="blas")


@frozen
class TaskExecutor:
    """Ordered, memory-bounded `map` on a `concurrent.futures` executor or in the calling thread."""

    # Executor of processes, threads or a cluster; None runs the tasks in the calling thread.
    executor: Executor | None = None
    max_in_flight: int = 8  # Largest number of submitted tasks whose results have not been consumed

    def map(self, function: Callable[[_Task], _Output], tasks: Iterable[_Task]) -> Iterator[_Output]:
        """Apply a function to each task, with at most `max_in_flight` tasks in memory."""
        if self.executor is None:
            for task in tasks:
                yield function(task)
            return
        pending = deque()
        try:
            for task in tasks:
                pending.append(self.executor.submit(function, task))
                if len(pending) >= self.max_in_flight:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


# Runs all tasks in the calling thread.
SERIAL = TaskExecutor()


@contextmanager
def open_executor(jobs: int = 1, scheduler: str | None = None) -> Iterator[TaskExecutor]:
    """Open an executor and close it at the end of the `with` block."""
    if scheduler:
        with _connect_to_dask(scheduler) as client:
            threads = sum(client.nthreads().values())
            yield TaskExecutor(client.get_executor(pure=False), 2 * max(threads, 1))
    elif jobs > 1:
        from concurrent.futures import ProcessPoolExecutor  # lazy import, as the following: few runs need it
        from multiprocessing import get_context

        with ProcessPoolExecutor(jobs, get_context("spawn"), initializer=end_with_parent) as pool:
            yield TaskExecutor(pool, 2 * jobs)
    else:
        yield SERIAL


def end_with_parent() -> None:
    """End this worker process as soon as the process that started it ends, even if that is killed."""
    # A worker waits for its next task on a pipe that its siblings hold open as well: it would wait for ever.
    from multiprocessing import parent_process  # lazy import, as the following: only in workers
    from multiprocessing.connection import wait

    parent = parent_process()
    if parent is not None:

        def watch() -> None:
            wait([parent.sentinel])
            # Waits while files are saved, see `saving.defer_signals`.
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(_SAVING_TIMEOUT_S)
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()


def _connect_to_dask(address: str) -> Any:
    """Connect to a Dask scheduler; raise InvalidArgumentError if Dask or the scheduler is missing."""
    try:
        from distributed import Client
    except ImportError:
        raise InvalidArgumentError(
            "--scheduler: Dask is not installed; run pip install 'dhcal-pin[cluster]' on this machine "
            "and on the workers"
        ) from None
    try:
        return Client(address, timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise InvalidArgumentError(
            f"--scheduler {address}: no Dask scheduler found; expected an address such as tcp://host:8786 "
            f"({error})"
        ) from error
