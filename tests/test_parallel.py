"""Executors: order of the results and number of tasks in memory."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from robots import paper, with_small_errors
from threadpoolctl import ThreadpoolController, threadpool_limits

from dhcal_pin import Chain, calibrate
from dhcal_pin.measurements import Pose
from dhcal_pin.parallel import BLAS_VARIABLES, SERIAL, TaskExecutor


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


def _blas_threads() -> set[int]:
    """Return the numbers of threads of the BLAS libraries in this process."""
    return {library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info()}


@pytest.mark.parametrize(("variable", "expected"), [(None, {1}), ("OPENBLAS_NUM_THREADS", {2})])
def test_a_calibration_uses_one_thread_of_blas_unless_the_user_set_a_number(variable, expected, monkeypatch):
    for name in BLAS_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, "2")
    nominal, rng = Chain.from_dh(paper("sim_6dof")), np.random.default_rng(0)
    actual, q = with_small_errors(nominal, rng), rng.uniform(-1, 1, (20, 6))
    data, seen = Pose(q, actual.poses(q)), set()
    with threadpool_limits(2, user_api="blas"):
        calibrate(nominal, data, "dh", progress=lambda *_: seen.update(_blas_threads()))
        assert seen == expected
        assert _blas_threads() == {2}
