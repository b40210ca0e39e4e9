"""Worker processes end with the command that started them, even if it is killed."""

import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest
from command_line import positions_csv
from robots import URDF
from slow_cases import some_slow
from study_runs import SMALL_STUDY

STUDY = SMALL_STUDY.replace("seeds = 120", "seeds = 5000")
JOB = '[[job]]\nrobot = "arm.dh.toml"\ndata = "data.csv"\noutput = "{}.urdf"\n'


@pytest.mark.parametrize(
    "command", some_slow(["study s.study.toml -o s.csv", "calibrate a.fleet.toml -o f.csv"], {1})
)
def test_workers_end_with_a_killed_command(tmp_path, command):
    shutil.copy(URDF / "experiment.dh.toml", tmp_path / "arm.dh.toml")
    (tmp_path / "data.csv").write_text(positions_csv(20))
    (tmp_path / "s.study.toml").write_text(STUDY)
    (tmp_path / "a.fleet.toml").write_text("".join(JOB.format(i) for i in range(500)))
    words = [sys.executable, "-m", "dhcal_pin.cli", *command.split(), "--jobs", "2"]
    started = tmp_path / ("s.csv.part" if "study" in command else "0.urdf")
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 60
        # The journal of a study has a line of its own and one for each block.
        while not (started.exists() and (started.suffix == ".urdf" or started.read_text().count("\n") > 1)):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        workers = psutil.Process(process.pid).children(recursive=True)
        assert len(workers) >= 2
        process.send_signal(signal.SIGKILL)
        alive = psutil.wait_procs(workers, timeout=10)[1]
        for worker in alive:
            worker.kill()
        assert alive == []
        # No process holds standard output open.
        assert process.communicate(timeout=10)[0] == b""
