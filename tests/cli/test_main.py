"""Parser and exit status of the command `dhcal`."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import CALIBRATE, folder_contents, parse_json, stdout_of
from robots import paper, random_joints

from dhcal_pin import Noise, Pose, read_robot, robot
from dhcal_pin.calibration import model_selection
from dhcal_pin.cli import main
from dhcal_pin.io import measurement_text

COMMANDS = tuple(main.COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_each_command_has_an_example_that_parses(run, name):
    status, out, err = run(name, "--help")
    assert (status, err) == (0, "")
    example = out.split("example:\n")[1].strip()
    args = main.build_parser().parse_args(example.split()[1:])
    assert args.command == name


def test_help_lists_all_commands(run):
    out = stdout_of(run("--help"))
    assert {line.split()[0] for line in out.splitlines() if re.match(r"    \w", line)} == set(COMMANDS)
    assert run("--version")[1].startswith("dhcal 0.")


@pytest.mark.parametrize(
    "args",
    [["--help"], ["calibrate"], ["calibrate", "arm.urdf", "data.csv", "--seed", "x"], ["--version"]],
)
def test_help_and_argument_errors_load_nothing_heavy(args):
    script = (
        "import sys\n"
        "from dhcal_pin.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "print(*sorted({'numpy', 'scipy', 'pinocchio', 'rich'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script, *args], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == ""


def test_a_calibration_loads_no_searches_in_images_no_other_commands_and_no_slow_library(robot_folder):
    chain = read_robot("arm.dh.toml")
    rng = np.random.default_rng(0)
    data = Pose.simulate(chain, random_joints(rng, paper("experiment"), 100), Noise(1e-4, 1e-4), rng)
    Path("data.csv").write_text(measurement_text(data, chain))
    script = "import sys\nfrom dhcal_pin.cli.main import main\nmain(sys.argv[1:])\nprint(*sys.modules)"
    command = [sys.executable, "-c", script, *CALIBRATE]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert "dhcal_pin.calibration.verdict" in loaded
    others = (
        "calibration.cameras.image_checks",
        "calibration.cameras.mistakes",
        "diagnostics.inspection",
        "planning",
    )
    assert not {f"dhcal_pin.{name}" for name in others} & {*loaded}
    assert not {"matplotlib", "meshcat", "scipy.linalg", "scipy.optimize", "scipy.special"} & {*loaded}


def test_installed_command(robot_folder):
    command = [Path(sys.executable).with_name("dhcal"), *CALIBRATE, "--json", "-"]
    good = subprocess.run(command, capture_output=True, text=True, check=False)
    assert good.returncode == 0
    assert parse_json(good.stdout)["samples"] == 20
    assert "wrote urdf: out.urdf" in good.stderr
    command[3] = "no.csv"
    bad = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (bad.returncode, bad.stdout) == (2, "")
    assert bad.stderr.count("\n") == 1
    assert "no.csv" in bad.stderr


def interrupted_in_a_library():
    """Do what NumPy does if it is interrupted while it compares structured arrays."""
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise TypeError("Cannot compare structured arrays") from None


def terminated():
    assert signal.getsignal(signal.SIGTERM) != signal.SIG_DFL
    signal.raise_signal(signal.SIGTERM)


def interrupted():
    raise KeyboardInterrupt


@pytest.mark.parametrize("stop", [interrupted, interrupted_in_a_library, terminated])
def test_interrupt_writes_nothing(run, robot_folder, monkeypatch, stop):
    def interrupt(*_, **__):
        stop()

    before = folder_contents(robot_folder)
    monkeypatch.setattr(model_selection, "extend", interrupt)
    assert run(*CALIBRATE, "--json", "-") == (130, "", "dhcal: interrupted; nothing written\n")
    assert folder_contents(robot_folder) == before
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.parametrize(("words", "status"), [("completion bash", 0), ("check no.urdf", -signal.SIGINT)])
def test_an_interrupt_at_the_end_of_the_process_gives_no_traceback(tmp_path, words, status):
    """A finished command keeps its exit status."""
    script = (
        "import atexit, signal, sys\n"
        "from dhcal_pin.cli.main import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "atexit.register(signal.raise_signal, signal.SIGINT)\n"
        "sys.exit(main())"
    )
    command = [sys.executable, "-c", script, *words.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert "Traceback" not in done.stderr


def test_lack_of_memory_is_one_line(assert_refused, monkeypatch):
    def fail(*_):
        raise MemoryError

    monkeypatch.setattr(robot, "joint_range", fail)
    assert_refused(
        ["not enough memory", "fewer"], "simulate", "arm.urdf", "-m", "1000000000000", "-o", "s.csv"
    )
