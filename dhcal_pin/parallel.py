"""Where independent pieces of work run: here, in processes, or on a cluster; the results always in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, TypeVar

from .exceptions import DhcalError

_Task = TypeVar("_Task")


_Done = TypeVar("_Done")


@dataclass(frozen=True)
class TaskExecutor:
    """Any `concurrent.futures` executor, or none for this process.

    Attributes:
        executor: processes, threads, a cluster's.
        max_in_flight: how many tasks are handed out before the first of them is back.
    """

    executor: Executor | None = None
    max_in_flight: int = 8

    def map(self, function: Callable[[_Task], _Done], tasks: Iterable[_Task]) -> Iterator[_Done]:
        """Results in the order of the tasks, of which never more than `ahead` are in memory."""
        if self.executor is None:
            for task in tasks:
                yield function(task)
            return
        waiting = deque()
        try:
            for task in tasks:
                waiting.append(self.executor.submit(function, task))
                if len(waiting) >= self.max_in_flight:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


SERIAL = TaskExecutor()


@contextmanager
def open_executor(jobs: int = 1, scheduler: str | None = None) -> Iterator[TaskExecutor]:
    """This process, `jobs` processes, or the cluster of a Dask scheduler at an address.

    Raises:
        DhcalError: Dask is not installed, or there is no scheduler at that address.
    """
    if scheduler:
        with _cluster(scheduler) as client:
            threads = sum(client.nthreads().values())
            yield TaskExecutor(client.get_executor(pure=False), 2 * max(threads, 1))
    elif jobs > 1:
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            yield TaskExecutor(pool, 2 * jobs)
    else:
        yield SERIAL


def _cluster(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise DhcalError(
            "--scheduler needs Dask: pip install 'dhcal-pin[cluster]', here and on the workers"
        ) from None
    try:
        return Client(address, timeout=3)
    except (OSError, ValueError) as error:
        raise DhcalError(f"--scheduler {address}: no Dask scheduler there: {error}") from error
