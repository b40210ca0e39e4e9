"""`dhcal calibrate` over the robots of a manifest."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from failing_jobs import dies
from robots import URDF, paper

from dhcal_pin.cli import main
from dhcal_pin.cli.fleet import FAILED, read_fleet, run_fleet
from dhcal_pin.io.measurement_csv import measurement_text
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.robot.chain import Chain


def job(robot, output, *more, data="data.csv"):
    return "\n".join(
        ["[[job]]", f'robot = "{robot}"', f'data = ["{data}"]', f'output = "{output}"', *more, ""]
    )


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder `cells` with the paper's arm and measurements of the one that it really is."""
    folder = tmp_path / "cells"
    folder.mkdir()
    shutil.copy(URDF / "sim_6dof.dh.toml", folder / "arm.dh.toml")
    true = Chain.from_dh(paper("sim_6dof_actual"))
    rng = np.random.default_rng(0)
    data = Pose.simulate(true, rng.uniform(-3, 3, (30, 6)), Noise(), rng)
    (folder / "data.csv").write_text(measurement_text(data, true))
    monkeypatch.chdir(tmp_path)
    return folder


def fleet(folder, text):
    (folder / "all.fleet.toml").write_text(text)


RUN = ("calibrate", "cells/all.fleet.toml", "-o", "summary.csv")


def test_a_failure_stops_no_other(place, capsys):
    missing = job("no.dh.toml", "c.urdf", 'name = "the third"')
    fleet(
        place,
        "holdout = 0.3\n"
        + job("arm.dh.toml", "a.urdf", 'json = "a.json"')
        + job("arm.dh.toml", "b.urdf", 'parameters = "offset"', "seed = 5", "max-iterations = 50")
        + missing,
    )
    assert main.main([*RUN, "--jobs", "2", "--json", "summary.json"]) == 1
    said = capsys.readouterr().err
    assert sum("failed" in line for line in said.splitlines()) == 1
    assert "2 of 3 robots calibrated" in said
    rows = list(csv.DictReader(Path("summary.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["arm", "arm", "the third"]
    assert [row["status"] for row in rows] == ["ok", "ok", "failed"]
    assert "no.dh.toml" in rows[2]["message"]
    assert [row["samples_holdout"] for row in rows] == ["9", "9", ""]
    # Without noise the whole model is exact, and joint zeros alone are not.
    assert float(rows[0]["holdout_after_position_rms[mm]"]) < 1e-6
    assert float(rows[1]["holdout_after_position_rms[mm]"]) > 0.1
    whole = json.loads(Path("summary.json").read_text())
    assert (whole["robots"], whole["failed"]) == (3, 1)
    assert whole["jobs"][2]["result"] is None
    # Each robot's files are those that it gets alone, from its own folder.
    os.chdir(place)
    assert main.main(["calibrate", "arm.dh.toml", "data.csv", "-o", "a2.urdf", "--holdout", "0.3"]) == 0
    assert Path("a.urdf").read_bytes() == Path("a2.urdf").read_bytes()
    alone = json.loads(Path("a.json").read_text())
    assert whole["jobs"][0]["result"]["holdout_after"] == alone["holdout_after"]
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
def test_a_wrong_manifest_is_refused_before_anything_runs(place, capsys, text, words):
    fleet(place, text)
    before = sorted(place.iterdir())
    assert main.main(RUN) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    for word in words:
        assert word in said
    assert sorted(place.iterdir()) == before
    assert not Path("summary.csv").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["cells/data.csv"], ["data.csv", "[[job]]"]),
        (["--tip", "tool0"], ["--tip", "manifest"]),
        (["--max-iterations", "5"], ["--max-iterations", "manifest"]),
    ],
)
def test_options_beside_a_manifest(place, capsys, more, words):
    fleet(place, job("arm.dh.toml", "a.urdf"))
    assert main.main([RUN[0], RUN[1], *more, *RUN[2:]]) == 2
    said = capsys.readouterr().err
    for word in words:
        assert word in said


def test_what_is_hard_to_believe_of_a_robot_is_told(place, capsys):
    """A joint's sign that is wrong in one robot's file."""
    lines = (place / "data.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    wrong = [",".join([*row[:2], repr(-float(row[2])), *row[3:]]) for row in rows]
    (place / "wrong.csv").write_text("\n".join([lines[0], *wrong]))
    fleet(place, job("arm.dh.toml", "a.urdf") + job("arm.dh.toml", "b.urdf", data="wrong.csv"))
    assert main.main([*RUN, "--jobs", "1", "--json", "summary.json"]) == 0
    said = capsys.readouterr().err.splitlines()
    (line,) = [line for line in said if "warning:" in line]
    assert "warning: wrong.csv: " in line
    assert "the opposite sign of joint joint_3" in line
    first, second = csv.DictReader(Path("summary.csv").read_text().splitlines())
    assert first["message"] == ""
    assert "joint_3" in second["message"]
    jobs = json.loads(Path("summary.json").read_text())["jobs"]
    assert jobs[0]["result"]["warnings"] == []
    assert [text.split(":")[0] for text in jobs[1]["result"]["warnings"]] == ["wrong.csv"]


def test_a_process_that_dies_takes_no_other_with_it(place):
    names = ["a", "killer", "b", "defect", "slow", "wrong"]
    fleet(place, "".join(job(name, f"{name}.out") for name in names))
    entries = read_fleet(place / "all.fleet.toml")
    told = {}
    found = run_fleet(entries, place / "all.fleet.toml", dies, 2, told.__setitem__)
    assert [outcome.status for outcome in found] == ["ok", FAILED, "ok", FAILED, "not converged", FAILED]
    assert "killed" in found[1].message
    assert "by nought" in found[3].message
    assert found[5].message == "wrong: input"
    assert found[0].document["folder"] == str(place)
    assert [told[number] for number in range(len(names))] == found


def test_an_interrupt_leaves_whole_files(place):
    fleet(place, "".join(job("arm.dh.toml", f"{i}.urdf", 'parameters = "offset"') for i in range(12)))
    command = [sys.executable, "-m", "dhcal_pin.cli", *RUN, "--jobs", "1"]
    root = str(URDF.parent)
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Where the tests run in the background, interrupts are ignored, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        env=os.environ | {"PYTHONPATH": root},
    ) as running:
        assert running.stderr is not None
        first = running.stderr.readline()
        os.killpg(running.pid, signal.SIGINT)
        rest = running.stderr.read()
    assert running.returncode == 130, rest
    assert "1 of 12" in first.replace("  ", " ")
    assert "interrupted" in rest
    assert "Traceback" not in rest
    assert not Path("summary.csv").exists()
    written = [path for path in place.iterdir() if path.suffix == ".urdf"]
    assert 1 <= len(written) < 12
    assert all(path.read_text().rstrip().endswith("</robot>") for path in written)
    assert not [path for path in place.iterdir() if path.name.startswith(".dhcal")]
