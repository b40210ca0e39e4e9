"""Mutated URDFs through whole commands: done, or refused in one line with nothing written."""

import contextlib
import io
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from mutations import mutated
from urdf_mutations import EXAMPLES, LENIENT, WORD

from dhcal_pin.cli.main import main


def run(*arguments: str) -> int:
    """One command; its complaint, if any, is one line."""
    said, out = io.StringIO(), io.StringIO()
    start = time.perf_counter()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(out):
        status = main(arguments)
    assert time.perf_counter() - start < 5
    assert status in (0, 2)
    if status == 2:
        assert said.getvalue().count("\n") == 1, said.getvalue()
        assert said.getvalue().startswith("dhcal: ")
    assert out.getvalue() == ""
    return status


def survive(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        robot, data_file, out, table = (
            Path(folder) / name for name in ("r.urdf", "d.csv", "o.urdf", "t.dh.toml")
        )
        robot.write_bytes(data)
        inputs = {robot}
        if run("simulate", str(robot), "-m", "8", "-o", str(data_file)) == 0:
            inputs.add(data_file)
            status = run("calibrate", str(robot), str(data_file), "-o", str(out), "--max-iterations", "3")
            if status == 2:
                assert set(Path(folder).iterdir()) == inputs
            else:
                inputs = set(Path(folder).iterdir())
        if run("convert", str(robot), str(table)) == 2:
            assert set(Path(folder).iterdir()) == inputs
        assert robot.read_bytes() == data


@settings(max_examples=75, deadline=None, derandomize=True, suppress_health_check=LENIENT)
@given(**EXAMPLES)
def test_commands_survive_any_robot(data, mutations):
    survive(mutated(data, mutations, WORD))


@pytest.mark.slow
@settings(max_examples=2500, deadline=None, derandomize=True, suppress_health_check=LENIENT)
@given(**EXAMPLES)
def test_commands_survive_thousands_of_robots(data, mutations):
    survive(mutated(data, mutations, WORD))
