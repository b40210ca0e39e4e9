"""Files of 100 MB are handled or refused within 20 s and 1 GB, and small files take seconds."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dhcal_pin.cli.main import main

SIZE = 100_000_000
CALIBRATE = ("calibrate", "arm.urdf", "data.csv", "-o", "o.urdf")
# Largest processor time [s] and memory [byte] of a command.
MAX_SECONDS, MAX_BYTES = 20, 1_000_000_000


def repeated(path: str, begin: str, line: str, end: str = "") -> None:
    count = (SIZE - len(begin) - len(end)) // len(line)
    Path(path).write_text(begin + line * count + end)


def assert_small(*words: str, seconds: float = MAX_SECONDS, size: int = MAX_BYTES) -> str:
    """Assert that a command is quick and needs little memory; return what it says."""
    with open("said", "w") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "dhcal_pin.cli", *words], stdout=said, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    text = Path("said").read_text()
    assert process.returncode in (0, 2), text
    assert process.returncode == 0 or text.count("\n") == 1, text
    assert "Traceback" not in text
    assert usage.ru_utime + usage.ru_stime < seconds
    # Linux counts KiB, macOS bytes.
    assert usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) < size
    return text


REFUSED = {
    "big.csv": (("inspect", "big.csv", "--robot", "arm.urdf"), "", "1,2,3,4,5,6\n"),
    "big.dh.csv": (("convert", "big.dh.csv", "o.urdf"), "", "a,revolute,0,1,2,3\n"),
    "big.dh.toml": (("convert", "big.dh.toml", "o.urdf"), "", "[[joint]]\na = 1\n"),
    "big.urdf": (("convert", "big.urdf", "o.dh.toml"), "<robot name='r'>", "<link name='a'/>"),
    "big.yaml": (("convert", "big.yaml", "o.urdf"), "", "kinematics: 1\n"),
    "big.study.toml": (("study", "big.study.toml", "-o", "s.csv"), "", "a = 1\n"),
    "big.fleet.toml": (("calibrate", "big.fleet.toml", "-o", "s.csv"), "", "[[job]]\n"),
    "map.toml": ((*CALIBRATE, "--columns", "map.toml"), "", "a = 1\n"),
    "rig.toml": ((*CALIBRATE, "--rig", "rig.toml"), "", "a = 1\n"),
    "bounds.toml": ((*CALIBRATE, "--bounds", "bounds.toml"), "", "a = 1\n"),
    "priors.toml": ((*CALIBRATE, "--priors", "priors.toml"), "", "a = 1\n"),
    "instrument.toml": ((*CALIBRATE, "--instrument", "instrument.toml"), "", "a = 1\n"),
    "arm.calibration.toml": (("validate", "arm.urdf", "data.csv"), "", "a = 1\n"),
    "big.xlsx": (("inspect", "big.xlsx", "--robot", "arm.urdf"), "", "PK"),
    "big.parquet": (("inspect", "big.parquet", "--robot", "arm.urdf"), "PAR1", "1"),
    "big.bag": (("convert", "big.bag", "o.csv"), "#ROSBAG V2.0\n", "a"),
    "big.mcap": (("convert", "big.mcap", "o.csv"), "\x89MCAP0\r\n", "a"),
    "s.csv.part": (("study", "arm.study.toml", "-o", "s.csv"), "", "[[1]]\n"),
    ".dhcal-save.json": (("inspect", "data.csv", "--robot", "arm.urdf"), "", "[1]\n"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_large_files_are_refused(robot_folder, name):
    words, begin, line = REFUSED[name]
    Path("arm.study.toml").write_text('seeds = 2\n[settings]\nrobot = "arm.dh.toml"\nposes = 8\n')
    repeated(name, begin, line)
    assert name in assert_small(*words)


@pytest.mark.slow
def test_a_million_rows_are_calibrated(run, robot_folder):
    """In the working folder of `robot_folder`, whose arm is `arm.urdf`."""
    assert (
        run("simulate", "arm.urdf", "-n", "1000", "--kind", "position", "--sigma", "0.1mm", "-o", "few.csv")[
            0
        ]
        == 0
    )
    comment, header, *rows = Path("few.csv").read_text().splitlines()
    Path("data.csv").write_text("\n".join([comment, header, *rows * 1000]))
    text = assert_small(*CALIBRATE, "--extend", "none", seconds=30, size=1_500_000_000)
    assert "200000 of 1000000 rows are used, drawn at random" in text


def test_touched_points_with_a_robust_loss_take_seconds(robot_folder):
    """Few touched points and no priors once took half a minute."""
    words = ("-m", "25", "--kind", "point", "--noise", "0.1mm", "--errors", "1mm,0.3deg", "-o", "points.csv")
    assert main(["simulate", "arm.urdf", *words]) == 0
    start = time.process_time()
    words = ("-o", "out.urdf", "--loss", "tukey", "--priors", "none")
    assert main(["calibrate", "arm.urdf", "points.csv", *words]) == 0
    assert time.process_time() - start < 12
