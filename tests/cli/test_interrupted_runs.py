"""Commands that are interrupted or killed: old files or new ones, and no trace after the next run."""

import json
import subprocess
import sys
from pathlib import Path

import interrupted_runs
import pytest
from slow_cases import some_slow


def outcomes(folder: Path, command: str, name: str, n_steps: int, n_times: int) -> dict[str, int]:
    """Interrupt a command in another process, which checks all files; count how they were left."""
    words = [interrupted_runs.__file__, str(folder), command, name, str(n_steps), str(n_times), "1"]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


COMMANDS = some_slow([("report", "SIGKILL"), ("study", "SIGINT"), ("calibrate", "SIGTERM")], {0, 2})


@pytest.mark.parametrize(("command", "name"), COMMANDS)
def test_interrupted_commands_leave_old_or_new_files(tmp_path, command, name):
    assert sum(outcomes(tmp_path, command, name, 1, 1).values()) == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGKILL", "SIGINT", "SIGTERM"])
@pytest.mark.parametrize("command", interrupted_runs.COMMANDS)
def test_hundreds_of_interrupted_commands_leave_old_or_new_files(tmp_path, command, name):
    left = outcomes(tmp_path, command, name, 25, 20)
    assert sum(left.values()) == 45
    assert min(left["old"], left["new"]) > 0
