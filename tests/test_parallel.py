"""Executors: order of the results and number of tasks in memory."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from dhcal_pin.parallel import SERIAL, TaskExecutor


def test_results_are_in_the_order_of_the_tasks():
    with ThreadPoolExecutor(4) as pool:
        for executor in (SERIAL, TaskExecutor(pool), TaskExecutor(pool, max_in_flight=1)):
            assert list(executor.map(lambda i: i**2, range(50))) == [i**2 for i in range(50)]


@pytest.mark.parametrize("max_in_flight", [1, 3])
def test_tasks_in_memory_are_limited(max_in_flight):
    n_started = 0

    def tasks():
        nonlocal n_started
        for i in range(20):
            n_started += 1
            yield i

    with ThreadPoolExecutor(2) as pool:
        for n_done, _ in enumerate(TaskExecutor(pool, max_in_flight).map(lambda i: i, tasks())):
            assert n_started <= n_done + max_in_flight
