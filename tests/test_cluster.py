"""Work shared out to a real Dask scheduler with two workers, one of which may die."""

from __future__ import annotations

import os
import signal
import warnings

import numpy as np
import pytest
from test_study import MANY, table_of

from dhcal_pin.errors import DhcalError
from dhcal_pin.executors import workers
from dhcal_pin.study import read_study, run

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster:
            cluster.wait_for_workers(2)
            yield cluster


def test_a_cluster_gives_the_same_table(cluster, tmp_path):
    there = table_of(tmp_path, "there", "--scheduler", cluster.scheduler_address)
    assert there == table_of(tmp_path, "here")


@pytest.mark.slow
def test_ten_thousand_calibrations_on_a_cluster(cluster, tmp_path):
    text = MANY.replace("seeds = 120", "seeds = 1000").replace("poses = 12", "poses = [8, 10, 12, 20, 30]")
    there = table_of(tmp_path, "there", "--scheduler", cluster.scheduler_address, text=text)
    assert there == table_of(tmp_path, "here", text=text)


def test_a_worker_lost_in_the_middle_changes_nothing(cluster, tmp_path):
    (tmp_path / "s.study.toml").write_text(MANY.replace("seeds = 120", "seeds = 400"))
    study = read_study(tmp_path / "s.study.toml")
    here = list(run(study))
    with workers(scheduler=cluster.scheduler_address) as where, distributed.Client(cluster) as client:
        victim = client.run(os.getpid)
        found = []
        for block in run(study, 0, where):
            found.append(block)
            if len(found) == 2:
                os.kill(next(iter(victim.values())), signal.SIGKILL)
        survivors = client.run(os.getpid)
    np.testing.assert_array_equal(found, here)
    assert next(iter(victim.values())) not in survivors.values()


def test_no_scheduler_is_said():
    with pytest.raises(DhcalError, match="no Dask scheduler there"), workers(scheduler="tcp://127.0.0.1:1"):
        pass
