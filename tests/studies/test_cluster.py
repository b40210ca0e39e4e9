"""Work shared out to a real Dask scheduler with two workers, one of which may die."""

import os
import signal
import warnings
from functools import partial

import numpy as np
import pytest
from study_runs import LARGE_STUDY, SMALL_STUDY, table_of

from dhcal_pin.calibration import calibrate_stream
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import iter_measurements, measurement_text
from dhcal_pin.measurements import Noise, Position
from dhcal_pin.parallel import open_executor
from dhcal_pin.studies import read_study, run

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


def test_cluster_gives_the_same_table(cluster, tmp_path):
    there = table_of(tmp_path, "there", "--scheduler", cluster.scheduler_address)
    assert there == table_of(tmp_path, "here")


@pytest.mark.slow
def test_ten_thousand_calibrations_on_a_cluster(cluster, tmp_path):
    there = table_of(tmp_path, "there", "--scheduler", cluster.scheduler_address, text=LARGE_STUDY)
    assert there == table_of(tmp_path, "here", text=LARGE_STUDY)


@pytest.mark.slow
def test_lost_worker_does_not_change_the_results(cluster, tmp_path):
    (tmp_path / "s.study.toml").write_text(SMALL_STUDY.replace("seeds = 120", "seeds = 400"))
    study = read_study(tmp_path / "s.study.toml")
    here = list(run(study))
    with open_executor(scheduler=cluster.scheduler_address) as where, distributed.Client(cluster) as client:
        victim = client.run(os.getpid)
        found = []
        for block in run(study, 0, where):
            found.append(block)
            if len(found) == 2:
                os.kill(next(iter(victim.values())), signal.SIGKILL)
        survivors = client.run(os.getpid)
    np.testing.assert_array_equal(found, here)
    assert next(iter(victim.values())) not in survivors.values()


def test_lost_worker_does_not_change_a_streamed_calibration(cluster, tmp_path, sim_6dof, sim_6dof_actual):
    """Parts of a file that both workers see; one worker dies after the first few triangles."""
    rng = np.random.default_rng(0)
    data = Position.simulate(sim_6dof_actual, rng.uniform(-3, 3, (1200, 6)), Noise(1e-4), rng)
    path = tmp_path / "laser.csv"
    path.write_text(measurement_text(data, sim_6dof))
    parts = partial(iter_measurements, path, sim_6dof, 100)
    here = calibrate_stream(sim_6dof, parts, "dh")
    with open_executor(scheduler=cluster.scheduler_address) as where, distributed.Client(cluster) as client:
        client.wait_for_workers(2)
        np.testing.assert_array_equal(calibrate_stream(sim_6dof, parts, "dh", executor=where).x, here.x)
        victims = client.run(os.getpid)
        killed = []

        def progress(iteration: int, cost: float) -> None:
            if not killed:
                killed.append(next(iter(victims.values())))
                os.kill(killed[0], signal.SIGKILL)

        there = calibrate_stream(sim_6dof, parts, "dh", executor=where, progress=progress)
        survivors = client.run(os.getpid)
    np.testing.assert_array_equal(there.x, here.x)
    np.testing.assert_array_equal(there.solution.system.r, here.solution.system.r)
    assert killed
    assert killed[0] not in survivors.values()


def test_unreachable_scheduler_is_refused():
    with (
        pytest.raises(DhcalError, match="no Dask scheduler found"),
        open_executor(scheduler="tcp://127.0.0.1:1"),
    ):
        pass
