"""Saving that is interrupted, ended or killed at any instruction: all files or none."""

import json
import subprocess
import sys
from pathlib import Path

import interrupted_saves
import pytest
from slow_cases import some_slow

SCRIPT = Path(interrupted_saves.__file__)


def outcomes(folder: Path, name: str, start: int, stride: int) -> dict[str, int]:
    """Interrupt saves in another process, which checks all files; count how they were left."""
    command = [sys.executable, str(SCRIPT), str(folder), name, str(start), str(stride)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("name", "start"),
    some_slow([("SIGINT", 11), ("SIGTERM", 150), ("SIGHUP", 290), ("SIGKILL", 70)], {0, 1, 3}),
)
def test_interrupted_saves_leave_all_files_or_none(tmp_path, name, start):
    left = outcomes(tmp_path, name, start, 401)
    assert min(left["old"], left["new"]) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_a_thousand_interrupted_saves_leave_all_files_or_none(tmp_path, name):
    left = outcomes(tmp_path, name, 0, 19)
    assert left["old"] + left["mixed"] + left["new"] > 1000
    assert min(left["old"], left["new"]) > 20
