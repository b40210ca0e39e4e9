"""Names and labels of files do not control the terminal, and no library prints on it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import HEADER, assert_harmless, positions_csv, stderr_of
from robots import URDF

# Clears the screen, rings the bell, turns the text around; also as a C1 control character.
HOSTILE = "\x1b[2J\x07\u202e\x9b31m"


def hostile_name(name):
    """A file with control characters in its name."""
    path = f"{HOSTILE}{name}"
    shutil.copy(name, path)
    return path


@pytest.mark.parametrize("wrong", [(), (3,)])
def test_paths(run, robot_folder, wrong):
    Path("data.csv").write_text(positions_csv(20, wrong=wrong))
    robot, data = hostile_name("arm.dh.toml"), hostile_name("data.csv")
    status, out, err = run("calibrate", robot, data, "-o", f"{HOSTILE}o.urdf", "--json", "-")
    assert status == 0, err
    assert r"\x1b[2J\x07\u202e\x9b31mo.urdf" in err
    assert_harmless(err)
    assert json.loads(out)["files"]["urdf"] == f"{HOSTILE}o.urdf"
    assert_harmless(run("validate", robot, data)[2])
    assert_harmless(run("validate", robot, f"{HOSTILE}none.csv")[2])
    assert_harmless(run("calibrate", robot, "--tip", HOSTILE, data, "-o", "o.urdf")[2])
    assert_harmless(run("calibrate", robot, data, "-o", "o.urdf", "--method", HOSTILE)[2])


def test_labels_of_points(run, robot_folder):
    header, rows = HEADER.split(",x[mm]")[0], [f"{10 * i},20,30,{HOSTILE}{i % 2}" for i in range(8)]
    Path("touch.csv").write_text("\n".join([f"{header},point", *rows]), encoding="utf-8")
    Path("lengths.csv").write_text(
        f"point_a,point_b,distance[mm]\n{HOSTILE}0,{HOSTILE}2,90\n", encoding="utf-8"
    )
    status, _, err = run("calibrate", "arm.urdf", "touch.csv", "lengths.csv", "-o", "o.urdf")
    assert status == 2
    assert r"\x1b[2J\x07\u202e\x9b31m2" in err
    assert r"choose from \x1b[2J\x07\u202e\x9b31m0, \x1b" in err
    assert_harmless(err)


def test_names_in_a_manifest_and_in_a_study(run, robot_folder):
    name = json.dumps(HOSTILE)
    Path("a.fleet.toml").write_text(
        f'[[job]]\nname = {name}\nrobot = {name}\ndata = "data.csv"\noutput = "o.urdf"\n', encoding="utf-8"
    )
    status, _, err = run("calibrate", "a.fleet.toml", "-o", "s.csv")
    assert status == 1
    assert r"\x1b[2J" in err
    assert_harmless(err)
    shutil.copy(URDF / "sim_3dof.dh.toml", "sim.dh.toml")
    Path("s.study.toml").write_text(
        f'title = {name}\nseeds = 3\n[settings]\nrobot = "sim.dh.toml"\nposes = 10\n', encoding="utf-8"
    )
    err = stderr_of(run("study", "s.study.toml", "-o", "s.csv"))
    assert_harmless(err)


def test_nothing_but_the_command_prints(robot_folder):
    """NumPy and the parser of URDFs printed warnings, which Python's own capture does not see."""
    text = Path("arm.urdf").read_text()
    # Two hundred equal rows, and an element that the parser of URDFs reports.
    Path("chatty.urdf").write_text(text.replace("</link>", "<visual/></link>", 1))
    Path("equal.csv").write_text("\n".join([HEADER, *["10,20,30,500,250,750"] * 200]))
    command = [sys.executable, "-m", "dhcal_pin.cli", "calibrate", "chatty.urdf", "equal.csv", "-o", "o.urdf"]
    # Without this variable, Python shows a warning and goes on.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONWARNINGS"}
    for options in ([], ["--parameters", "dh", "--priors", "none"], ["--force"]):
        done = subprocess.run(
            [*command, *options], capture_output=True, text=True, env=environment, check=False
        )
        assert done.returncode in (0, 3), done.stderr
        assert "Warning" not in done.stderr
        assert "Error:" not in done.stderr


def program(*words, **options):
    """Run the command as a process of its own; return its status and standard output."""
    command = [sys.executable, "-m", "dhcal_pin.cli", *words]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False, **options)
    return done.returncode, done.stdout


def test_json_is_not_changed_by_the_status_line(robot_folder):
    """On a terminal, a status line is shown while the JSON is written to another file."""
    Path("data.csv").write_text(positions_csv(20))
    words = ("calibrate", "arm.dh.toml", "data.csv", "-o", "o.urdf", "--json", "-")
    environment = os.environ | {"FORCE_COLOR": "1", "COLUMNS": "40"}
    status, out = program(*words, stderr=subprocess.PIPE, env=environment)
    assert status == 0
    assert json.loads(out)["verdict"]["status"] == "ok"


def test_exit_status_does_not_depend_on_the_reader(robot_folder):
    """If nobody reads stderr, the files are written and the exit status is that of the result."""
    Path("data.csv").write_text(positions_csv(20))
    reader, writer = os.pipe()
    os.close(reader)
    assert program("calibrate", "arm.dh.toml", "data.csv", "-o", "o.urdf", stderr=writer) == (0, b"")
    os.close(writer)
    assert Path("o.urdf").is_file()


def test_closed_standard_output(robot_folder):
    """A JSON document for a closed standard output is an error in one line, and nothing is written."""
    Path("data.csv").write_text(positions_csv(20))
    words = "calibrate arm.dh.toml data.csv -o o.urdf --json -"
    command = f"{sys.executable} -m dhcal_pin.cli {words} >&-"
    done = subprocess.run(command, shell=True, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == ("dhcal: standard output is closed; no file is written; name a file with --json\n")
    assert not Path("o.urdf").exists()


@pytest.mark.parametrize(
    ("words", "noun"),
    [
        ("--version", "version"),
        ("--help", "help"),
        ("calibrate --help", "help"),
        ("completion bash", "script"),
    ],
)
def test_standard_output_without_a_reader(words, noun):
    """It is an error in one line, as for a JSON document."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "dhcal_pin.cli", *words.split()]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert done.returncode == 2
    assert done.stderr == (
        f"dhcal: standard output: cannot write the {noun}: Broken pipe; expected an open file or pipe\n"
    )


@pytest.mark.parametrize("words", ["calibrat", "calibrate --xyz", "validate no.urdf no.csv", "validate"])
def test_error_without_a_reader(words):
    """The exit status is that of the error."""
    reader, writer = os.pipe()
    os.close(reader)
    assert program(*words.split(), stderr=writer) == (2, b"")
    os.close(writer)
