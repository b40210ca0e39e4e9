"""Whole commands that are interrupted or killed, what they leave behind, and what the next command says.

Run as a script in a process of its own, because it forks: `interrupted_runs.py FOLDER COMMAND SIGNAL N_STEPS
N_TIMES SEED` interrupts the command at so many instructions of its saving and at so many random times.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, tzinfo
from pathlib import Path

import numpy as np
import psutil
from command_line import positions_csv
from PIL import Image
from recordings import POSES, Recording, write_bag
from robots import URDF
from signal_steps import SignalAtStep, count_steps

from dhcal_pin.cli import main as main_of_cli
from dhcal_pin.cli import outputs
from dhcal_pin.cli.main import main as dhcal
from dhcal_pin.io import check_history, read_robot

FLEET = """
extend = "none"
loss = "linear"
[[job]]
robot = "arm.urdf"
data = "data.csv"
output = "out.urdf"
report = "r.md"
json = "r.json"
"""
STUDY = """
seeds = {seeds}
[settings]
robot = "arm.dh.toml"
poses = [6, 12]
"""
RIG = """
[camera.c]
link = "world"
width = 640
height = 480
[board.b]
link = "tip"
type = "checkerboard"
columns = 7
rows = 5
square_mm = {square}
"""
# Few samples and no choice of error families: the files are what matters here.
QUICK = ("--extend", "none", "--loss", "linear")
CALIBRATE = ("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", *QUICK)
PROGRAM = ("--export", "x.trajectory.csv", "--json", "sub/x.json")
HISTORY = ("--history", "h.jsonl", "--plot", "h.html")
DEMO = "result.json summary.md scene.html report.html experiment.urdf experiment_calibrated.urdf".split()
# Words of each command, and the names of its outputs.
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "calibrate": (CALIBRATE, ("out.urdf", "out.calibration.toml")),
    "in place": (
        ("calibrate", "arm.urdf", "data.csv", "-o", "arm.urdf", "--in-place", *QUICK),
        ("arm.urdf", "arm.calibration.toml"),
    ),
    "report": (
        (*CALIBRATE, "--report", "sub/r.md", "--json", "sub/r.json", "--residuals", "residuals.csv"),
        ("out.urdf", "out.calibration.toml", "sub/r.md", "sub/r.json", "residuals.csv"),
    ),
    "study": (("study", "s.study.toml", "-o", "s.csv"), ("s.csv", "s.svg")),
    "fleet": (
        ("calibrate", "a.fleet.toml", "-o", "f.csv", "--jobs", "1", "--json", "sub/f.json"),
        ("out.urdf", "out.calibration.toml", "r.md", "r.json"),
    ),
    "bundle": ((*CALIBRATE, "--bundle", "b.dhcal.zip"), ("out.urdf", "out.calibration.toml", "b.dhcal.zip")),
    "validate": (
        ("validate", "arm.urdf", "data.csv", "--json", "sub/v.json", "--report", "v.html"),
        ("v.html", "sub/v.json"),
    ),
    "convert": (("convert", "arm.dh.toml", "c.urdf", "--json", "sub/c.json"), ("sub/c.json", "c.urdf")),
    "simulate": (
        ("simulate", "arm.dh.toml", "-n", "5", "--kind", "camera", "-o", "c.csv", "--json", "sub/c.json"),
        ("c.csv", "c.rig.toml", "sub/c.json"),
    ),
    "plan": (
        ("plan", "arm.dh.toml", "-n", "15", "--candidates", "60", "-o", "p.csv", *PROGRAM),
        ("p.csv", "x.trajectory.csv", "sub/x.json"),
    ),
    "compensate": (
        ("compensate", "arm.urdf", "arm.dh.toml", "t.csv", "-o", "c.csv", *PROGRAM),
        ("c.csv", "x.trajectory.csv", "sub/x.json"),
    ),
    "export": (("export", "arm.dh.toml", "-o", "m.h", "--json", "sub/m.json"), ("m.h", "sub/m.json")),
    "view": (("view", "arm.dh.toml", "--html", "v.html", "--json", "sub/v.json"), ("v.html", "sub/v.json")),
    "inspect": (("inspect", "data.csv", "--json", "i.json"), ("i.json",)),
    "diff": (
        ("diff", "arm.urdf", "arm.dh.toml", "--json", "sub/d.json", "--report", "d.html"),
        ("d.html", "sub/d.json"),
    ),
    "check": (("check", "arm.dh.toml", "--json", "sub/k.json"), ("sub/k.json",)),
    "detect": (
        ("detect", "i.png", "--rig", "rig.toml", "-o", "d.csv", "--json", "sub/d.json"),
        ("d.csv", "sub/d.json"),
    ),
    "board": (("board", "rig.toml", "-o", "b.pdf", "--json", "sub/b.json"), ("b.pdf", "sub/b.json")),
    "recheck": (
        ("recheck", "../calibrated.urdf", "data.csv", "--size", "2cm", *HISTORY, "--json", "sub/k.json"),
        ("h.jsonl", "h.html", "sub/k.json"),
    ),
    "demo": (
        ("demo", "-o", "demo", "--no-open", "--json", "sub/d.json"),
        (*(f"demo/{name}" for name in DEMO), "sub/d.json"),
    ),
    "iso9283": (
        ("plan", "arm.dh.toml", "--iso9283", "--cube", "100mm", "-o", "p.csv", *PROGRAM),
        ("p.csv", "x.trajectory.csv", "sub/x.json"),
    ),
    "recording": (
        ("convert", "../arm.bag", "c.csv", "--pose-topic", POSES, "--json", "sub/c.json"),
        ("c.csv", "sub/c.json"),
    ),
    "doctor": (("doctor", "--json", "sub/d.json"), ("sub/d.json",)),
}
# Files that a command may leave for the next run, which continues with them.
JOURNALS = {"study": "s.csv.part"}
# What differs in the outputs of equal runs.
VOLATILE = {"doctor": rb"[\d.]+ s\b"}


class Interruption:
    """One command in a folder with old outputs, which is to replace them by new ones.

    Attributes:
        words: Words of the command.
        names: Names of its outputs.
        old: Content of each output before.
        new: Content of each output after.
    """

    def __init__(self, root: Path, command: str):
        self.root, self.command = root, command
        self.words, self.names = COMMANDS[command]
        os.chdir(root)
        self._make_inputs(old=True)
        self._make_other_files()
        # The modules are loaded here once, and not in each child.
        with contextlib.redirect_stderr(io.StringIO()):
            assert dhcal(self.words) == 0
        self.reset_inputs()
        self._run_alone()
        self.old = self.read()
        self._make_inputs(old=False)
        self._run_alone()
        self.new = self.read()
        if self.old == self.new:
            # The outputs of the command depend on no input.
            self.old = {name: b"older " + (content or b"") for name, content in self.old.items()}
        assert all(self.old.values())
        assert all(self.new.values())
        assert self.old != self.new

    def _make_inputs(self, old: bool) -> None:
        if "arm.urdf" not in self.names or old:
            shutil.copy(URDF / "experiment.urdf", "arm.urdf")
        shutil.copy(URDF / f"experiment{'' if old else '_published'}.dh.toml", "arm.dh.toml")
        (self.root / "sub").mkdir(exist_ok=True)
        Path("data.csv").write_text(positions_csv(12, seed=0 if old else 5))
        Path("s.study.toml").write_text(STUDY.format(seeds=2 if old else 3))
        Path("a.fleet.toml").write_text(FLEET)
        Path("t.csv").write_text("x[mm],y[mm],z[mm]\n400,100,300\n300,-200,400\n")
        Path("rig.toml").write_text(RIG.format(square=20 if old else 25))
        squares = np.kron(np.indices((5, 7)).sum(0) % 2, np.full((40, 40), 255))
        sides = (180, 180) if old else (170, 190)
        picture = np.pad(squares, ((140, 140), sides), constant_values=255)
        Image.fromarray(picture.astype(np.uint8)).save("i.png")

    def _make_other_files(self) -> None:
        """Make inputs that are the same for the old run and the new one, beside the folder."""
        if self.command == "recheck":
            with contextlib.redirect_stderr(io.StringIO()):
                assert dhcal(["calibrate", "arm.urdf", "data.csv", "-o", "../calibrated.urdf", *QUICK]) == 0
        if self.command == "recording":
            stops = np.random.default_rng(0).uniform(-1, 1, (4, 3))
            write_bag(Path("../arm.bag"), Recording(read_robot("arm.dh.toml"), stops))

    def _run_alone(self) -> None:
        status = self._in_child(lambda: dhcal(self.words))
        assert status == 0, Path("stderr").read_text()

    def _in_child(self, function: Callable[[], int], kill_after: float = 0, number: int = 0) -> int:
        """Run a function in a child process, wait for all processes it started, and return its status."""
        # A child that is killed at once says nothing.
        Path("stderr").write_text("")
        begun, has_begun = os.pipe()
        child = os.fork()
        if not child:
            os.setsid()
            signal.signal(signal.SIGINT, signal.default_int_handler)
            descriptor = os.open("stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(descriptor, 2)
            sys.stderr = os.fdopen(2, "w", closefd=False)
            status = 99
            try:
                _announce_start(has_begun)
                status = function()
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            except KeyboardInterrupt:
                # After the end of the command; one that does not handle an interrupt leaves status 99.
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            except Exception:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(status)
        if kill_after:
            os.read(begun, 1)
            time.sleep(kill_after)
            # As a terminal does, for the command and its workers.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, number) if number == signal.SIGINT else os.kill(child, number)
        os.close(begun)
        os.close(has_begun)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        while any(_session(process) == child for process in psutil.process_iter()):
            time.sleep(0.01)
        return status

    def read(self) -> dict[str, bytes | None]:
        """Return the content of each output."""
        paths = {name: self.root / name for name in self.names}
        contents = {name: path.read_bytes() if path.exists() else None for name, path in paths.items()}
        if pattern := VOLATILE.get(self.command):
            contents = {name: content and re.sub(pattern, b"", content) for name, content in contents.items()}
        return contents

    def reset_inputs(self) -> None:
        """Remove everything that a run has left, and make the inputs of the old run."""
        for path in self.files():
            path.unlink()
        self._make_inputs(old=True)

    def reset(self) -> None:
        """Restore the old outputs, and remove everything else that a run has left."""
        self.reset_inputs()
        self._make_inputs(old=False)
        for name, content in self.old.items():
            assert content is not None
            (self.root / name).write_bytes(content)

    def files(self) -> list[Path]:
        """Return all files of the folder."""
        return [path for path in self.root.rglob("*") if path.is_file()]

    def saving_steps(self) -> int:
        """Count the instructions of the saving."""
        self.reset()
        counts = self.root.with_name("count")

        def run() -> int:
            write = outputs.write_outputs
            _replace_write_outputs(lambda *args: counts.write_text(str(count_steps(lambda: write(*args)))))
            return dhcal(self.words)

        self._in_child(run)
        return int(counts.read_text())

    def interrupt_at_step(self, step: int, number: int) -> str:
        """Send a signal at an instruction of the saving and check the consequences."""

        def run() -> int:
            write = outputs.write_outputs

            def traced(*args: object) -> None:
                with SignalAtStep(step, number):
                    write(*args)  # pyright: ignore

            _replace_write_outputs(traced)
            return dhcal(self.words)

        self.reset()
        return self.check(self._in_child(run), number)

    def interrupt_after(self, seconds: float, number: int) -> str:
        """Send a signal at a time and check the consequences."""
        self.reset()
        status = self._in_child(lambda: dhcal(self.words), seconds, number)
        return self.check(status, number)

    def check(self, status: int, number: int) -> str:
        """Check what an interrupted run has left, what it said, and what the next commands do."""
        said = Path("stderr").read_text()
        found = self.read()
        left = "old" if found == self.old else "new" if found == self.new else "mixed"
        details = (status, left, said, [path.name for path in self.files()])
        # No file is partial, however the run ended.
        assert all(content in (self.old[name], self.new[name]) for name, content in found.items()), details
        if number == -status == signal.SIGTERM:
            # It came after the end of the command.
            assert left == "new", details
        elif number in (signal.SIGINT, signal.SIGTERM):
            # The files of an interrupted run are complete, and the message names them.
            assert left != "mixed", details
            assert not [path for path in self.files() if path.name.startswith(".dhcal-")], details
            # A signal to one job of a manifest ends this job only.
            assert status in ((0, 1, 130) if self.command == "fleet" else (0, 130)), details
            if status == 1:
                assert (left == "old") == ("interrupted; nothing written" in said), details
            if self.command != "fleet" and status == 130:
                assert ("these files are written" in said) == (left == "new"), details
        robot = self.names[0]
        if robot.endswith(".urdf"):
            said_next = io.StringIO()
            with contextlib.redirect_stderr(said_next):
                next_status = dhcal(["validate", robot, "data.csv"])
            assert next_status == 0 or self.names[1] in said_next.getvalue(), (details, said_next.getvalue())
            assert next_status == 2 or self.read() in (self.old, self.new), details
        # The next run leaves its own files only.
        self._run_alone()
        if self.command == "recheck" and found["h.jsonl"] == self.new["h.jsonl"]:
            # The history is an input, too.
            assert len(check_history.read_history("h.jsonl")) == 3, details
        elif self.command != "in place":
            assert self.read() == self.new, details
        hidden = [path.name for path in self.files() if path.name.startswith(".dhcal-")]
        assert hidden == [], (details, hidden)
        assert not (self.root / JOURNALS.get(self.command, "none")).exists()
        return left


def _session(process: psutil.Process) -> int:
    try:
        return os.getsid(process.pid) if process.status() != psutil.STATUS_ZOMBIE else 0
    except (psutil.NoSuchProcess, ProcessLookupError):
        return 0


class _FixedTime(datetime):
    """Clock that stands still: the checks of a history have a time."""

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> _FixedTime:
        return cls(2026, 3, 1, tzinfo=tz or UTC)


def _announce_start(pipe: int) -> None:
    """Write a byte to a pipe as soon as a command has begun and can be interrupted."""
    build_parser = main_of_cli.build_parser

    def announce(words: Sequence[str]) -> argparse.ArgumentParser:
        os.write(pipe, b".")
        return build_parser(words)

    main_of_cli.build_parser = announce


def _replace_write_outputs(function: Callable[..., object]) -> None:
    """Replace the function that saves, in all modules that have imported it."""
    from dhcal_pin.cli import fleet, iso_plan, run_job

    for module in (outputs, run_job, fleet, iso_plan):
        module.write_outputs = function  # pyright: ignore


def main(folder: str, command: str, name: str, n_steps: str, n_times: str, seed: str) -> None:
    """Interrupt a command many times, and print how many runs left what."""
    rng, number = random.Random(int(seed)), signal.Signals[name]
    # The disk takes most of the time and does not matter here, as for the start of the jobs of a manifest.
    os.fsync = lambda descriptor: None
    spawn = multiprocessing.get_context
    multiprocessing.get_context = lambda method=None: spawn("fork" if method == "spawn" else method)
    check_history.datetime = _FixedTime
    root = Path(folder).resolve() / "run"
    root.mkdir(parents=True, exist_ok=True)
    interruption = Interruption(root, command)
    left = []
    steps = interruption.saving_steps() if int(n_steps) else 0
    for _ in range(int(n_steps)):
        left.append(interruption.interrupt_at_step(rng.randrange(steps), number))
        print(left[-1], flush=True)
    interruption.reset()
    start = time.perf_counter()
    interruption._run_alone()
    duration = time.perf_counter() - start
    for _ in range(int(n_times)):
        left.append(interruption.interrupt_after(rng.uniform(0, duration), number))
        print(left[-1], flush=True)
    print(json.dumps({key: left.count(key) for key in ("old", "mixed", "new")}))


if __name__ == "__main__":
    main(*sys.argv[1:])
