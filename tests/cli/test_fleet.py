"""Command calibrate with a manifest of several robots."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import error_of, stderr_of, unfolded
from failing_jobs import run_or_fail
from robots import URDF, paper

from dhcal_pin.cli import main
from dhcal_pin.cli.fleet import FAILED, read_fleet, run_fleet
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot import Chain


def job(robot, output, *more, data="data.csv"):
    return "\n".join(
        ["[[job]]", f'robot = "{robot}"', f'data = ["{data}"]', f'output = "{output}"', *more, ""]
    )


@pytest.fixture
def cells(tmp_path, monkeypatch):
    """Folder `cells` with a robot of the paper and measurements of one with errors."""
    folder = tmp_path / "cells"
    folder.mkdir()
    shutil.copy(URDF / "sim_6dof.dh.toml", folder / "arm.dh.toml")
    # Errors that nobody takes for mixed-up measurements.
    table = paper("sim_6dof")
    true = Chain.from_dh(replace(table, theta=table.theta + 6e-3, a=table.a + 1e-3))
    rng = np.random.default_rng(0)
    data = Pose.simulate(true, rng.uniform(-3, 3, (30, 6)), Noise(), rng)
    (folder / "data.csv").write_text(measurement_text(data, true))
    monkeypatch.chdir(tmp_path)
    return folder


def write_manifest(folder, text):
    (folder / "all.fleet.toml").write_text(text)


RUN = ("calibrate", "cells/all.fleet.toml", "-o", "summary.csv")


def test_strict_tells_a_robot_with_caution(cells):
    write_manifest(cells, job("arm.dh.toml", "b.urdf", 'parameters = "offset"'))
    assert main.main([*RUN, "--jobs", "1", "--strict"]) == 4


def test_failed_job_does_not_stop_the_others(cells, capsys):
    missing = job("no.dh.toml", "c.urdf", 'name = "the third"')
    write_manifest(
        cells,
        "holdout = 0.3\n"
        + job("arm.dh.toml", "a.urdf", 'json = "a.json"')
        + job("arm.dh.toml", "b.urdf", 'parameters = "offset"', "seed = 5", "max-iterations = 50")
        + missing,
    )
    assert main.main([*RUN, "--jobs", "2", "--json", "summary.json"]) == 1
    err = capsys.readouterr().err
    assert sum("failed" in line for line in err.splitlines()) == 1
    assert "2 of 3 robots calibrated" in err
    rows = list(csv.DictReader(Path("summary.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["arm", "arm", "the third"]
    assert [row["status"] for row in rows] == ["ok", "caution", "failed"]
    assert "the chosen parameters cannot represent the errors" in rows[1]["message"]
    assert "no.dh.toml" in rows[2]["message"]
    assert [row["samples_holdout"] for row in rows] == ["9", "9", ""]
    # Without noise the full model is exact; joint offsets alone are not.
    assert float(rows[0]["holdout_after_position_rms[mm]"]) < 1e-6
    assert float(rows[1]["holdout_after_position_rms[mm]"]) > 0.1
    summary = json.loads(Path("summary.json").read_text())
    assert (summary["robots"], summary["failed"]) == (3, 1)
    assert summary["jobs"][2]["result"] is None
    # Each robot has the files of a calibration alone, started in the folder of the manifest.
    os.chdir(cells)
    assert main.main(["calibrate", "arm.dh.toml", "data.csv", "-o", "a2.urdf", "--holdout", "0.3"]) == 0
    assert Path("a.urdf").read_bytes() == Path("a2.urdf").read_bytes()
    single = json.loads(Path("a.json").read_text())
    assert summary["jobs"][0]["result"]["holdout_after"] == single["holdout_after"]
    assert not Path("c.urdf").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["all.fleet.toml", "[[job]]"]),
        ("job = 3\n", ["all.fleet.toml", "[[job]]"]),
        ("[[job]]\n", ["job 1", "robot"]),
        ("[[job]]\nrobot = 'a.urdf'\noutput = 'b.urdf'\n", ["job 1", "data"]),
        (job("a.urdf", "b.urdf", "speed = 3"), ["job 1", "'speed'", "choose from", "holdout"]),
        (job("a.urdf", "b.urdf", "seed = 'x'"), ["job 1", "seed", "integer"]),
        (job("a.urdf", "b.urdf", "in_place = 1"), ["job 1", "in_place", "true"]),
        (job("a.urdf", "b.urdf", "tip = true"), ["job 1", "tip", "text"]),
        (job("a.urdf", "b.urdf", "method = 'best'"), ["job 1", "method", "lm or gn"]),
        (job("a.urdf", "b.urdf", "json = '-'"), ["job 1", "json", "path of a file"]),
        (job("a.urdf", "b.urdf") + job("c.urdf", "./b.urdf"), ["job 2", "job 1", "its own output"]),
        (job("a.urdf", "b.urdf") + job("b.urdf", "c.urdf"), ["job 1", "job 2"]),
        (job("a.urdf", "../summary.csv"), ["summary.csv", "is an input"]),
        ("[[job]\n", ["all.fleet.toml", "not TOML"]),
    ],
)
def test_invalid_manifest_is_refused_before_a_job_runs(cells, run, text, words):
    write_manifest(cells, text)
    before = sorted(cells.iterdir())
    err = error_of(run(*RUN))
    for word in words:
        assert word in err
    assert sorted(cells.iterdir()) == before
    assert not Path("summary.csv").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["cells/data.csv"], ["data.csv", "[[job]]"]),
        (["--tip", "tool0"], ["--tip", "manifest"]),
        (["--max-iterations", "5"], ["--max-iterations", "manifest"]),
    ],
)
def test_options_beside_a_manifest_are_refused(cells, run, more, words):
    write_manifest(cells, job("arm.dh.toml", "a.urdf"))
    err = error_of(run(RUN[0], RUN[1], *more, *RUN[2:]))
    for word in words:
        assert word in err


def test_warnings_are_in_console_and_summary(cells, run):
    """One row of a file is a copy of another."""
    lines = (cells / "data.csv").read_text().splitlines()
    (cells / "copied.csv").write_text("\n".join([*lines, lines[3]]))
    jobs = job("arm.dh.toml", "a.urdf") + job("arm.dh.toml", "b.urdf", data="copied.csv")
    write_manifest(cells, f'parameters = "dh"\nextend = "none"\n{jobs}')
    line = unfolded(stderr_of(run(*RUN, "--jobs", "1", "--json", "summary.json")))
    assert line.count("warning:") == 1
    assert "warning: copied.csv: " in line
    assert "identical to other rows" in line
    first, second = csv.DictReader(Path("summary.csv").read_text().splitlines())
    assert first["message"] == ""
    assert "identical to other rows" in second["message"]
    jobs = json.loads(Path("summary.json").read_text())["jobs"]
    assert jobs[0]["result"]["warnings"] == []
    assert [text.split(":")[0] for text in jobs[1]["result"]["warnings"]] == ["copied.csv"]


def test_killed_process_does_not_stop_the_others(cells):
    names = ["a", "killer", "b", "defect", "slow", "wrong"]
    write_manifest(cells, "".join(job(name, f"{name}.out") for name in names))
    entries = read_fleet(cells / "all.fleet.toml")
    outcomes = {}
    result = run_fleet(entries, cells / "all.fleet.toml", run_or_fail, 2, outcomes.__setitem__)
    assert [outcome.status for outcome in result] == ["ok", FAILED, "ok", FAILED, "refused", FAILED]
    assert "killed" in result[1].message
    assert "by zero" in result[3].message
    assert result[5].message == "wrong: input"
    assert result[0].document["folder"] == str(cells)
    assert [outcomes[number] for number in range(len(names))] == result


def test_interrupt_leaves_complete_files(cells):
    write_manifest(
        cells,
        "".join(job("arm.dh.toml", f"{i}.urdf", 'parameters = "dh"', 'extend = "none"') for i in range(12)),
    )
    command = [sys.executable, "-m", "dhcal_pin.cli", *RUN, "--jobs", "1", "--verbose"]
    root = str(URDF.parent)
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A process in the background ignores interrupts, and its children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        env=os.environ | {"PYTHONPATH": root},
    ) as running:
        assert running.stderr is not None
        first = running.stderr.readline()
        os.killpg(running.pid, signal.SIGINT)
        rest = running.stderr.read()
    assert running.returncode == 130, rest
    assert first.startswith("1 of 12")
    assert "interrupted" in rest
    assert "Traceback" not in rest
    assert not Path("summary.csv").exists()
    written = [path for path in cells.iterdir() if path.suffix == ".urdf"]
    assert 1 <= len(written) < 12
    assert all(path.read_text().rstrip().endswith("</robot>") for path in written)
    assert not [path for path in cells.iterdir() if path.name.startswith(".dhcal")]
