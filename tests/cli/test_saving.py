"""Outputs of commands: streams, interrupts, and files that do not belong together."""

import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_line import CALIBRATE, positions_csv
from robots import URDF
from study_runs import SMALL_STUDY

from dhcal_pin.cli import main, outputs, run_job, screens
from dhcal_pin.saving import transaction
from dhcal_pin.studies import open_journal, read_study

JSON_TO_STDOUT = [sys.executable, "-m", "dhcal_pin.cli", *CALIBRATE, "--json", "-"]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# --- streams ---------------------------------------------------------------------------------------


def test_json_into_a_device(run, robot_folder):
    try:
        os.mknod("null", stat.S_IFCHR | 0o600, os.makedev(1, 3))
        Path("null").write_bytes(b"")
    except OSError:
        pytest.skip("devices need the permissions of root")
    assert run(*CALIBRATE, "--json", "null")[0] == 0
    assert stat.S_ISCHR(os.stat("null").st_mode)
    assert run(*CALIBRATE, "--json", "/dev/null")[0] == 0


def test_a_device_needs_no_ending(run, robot_folder):
    """It has the only format of an output."""
    assert run("simulate", "arm.urdf", "-n", "5", "-o", "/dev/null")[0] == 0
    assert run(*CALIBRATE, "--map", "/dev/null")[0] == 2


def test_json_into_a_pipe(run, robot_folder):
    os.mkfifo("pipe")
    received = []
    reader = threading.Thread(target=lambda: received.append(Path("pipe").read_text()))
    reader.start()
    assert run(*CALIBRATE, "--json", "pipe")[0] == 0
    reader.join(10)
    assert json.loads(received[0])["samples"] == 20
    assert stat.S_ISFIFO(os.stat("pipe").st_mode)


@pytest.mark.parametrize("target", ["a full disk", "a closed pipe"])
def test_json_to_standard_output_that_fails(robot_folder, target):
    before = names(robot_folder)
    with open("/dev/full", "w") as full:
        if target == "a full disk":
            done = subprocess.run(JSON_TO_STDOUT, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
            status, err = done.returncode, done.stderr
        else:
            process = subprocess.Popen(
                JSON_TO_STDOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            assert process.stdout is not None
            process.stdout.close()
            process.stdout = None
            err = process.communicate()[1]
            status = process.returncode
    assert status == 2
    assert err.count("\n") == 1
    assert err.startswith("dhcal: standard output: cannot write the JSON: ")
    assert "no file is written" in err
    assert names(robot_folder) == before


def test_json_for_a_terminal_of_another_encoding(robot_folder):
    shutil.copy("arm.dh.toml", os.fsdecode(b"\xff\xc3\xa4.dh.toml"))
    command = [*JSON_TO_STDOUT[:4], os.fsdecode(b"\xff\xc3\xa4.dh.toml"), *JSON_TO_STDOUT[5:]]
    environment = os.environ | {"PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(command, capture_output=True, env=environment, check=True)
    assert "\udcff\u00e4.dh.toml" in json.loads(done.stdout.decode("latin-1"))["inputs"]


# --- interrupts ------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _interrupts_are_not_ignored():
    """A shell starts commands in the background with interrupts ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt(*_, **__):
    signal.raise_signal(signal.SIGINT)


def test_interrupt_before_the_files_are_saved(run, robot_folder, monkeypatch):
    before = names(robot_folder)
    monkeypatch.setattr(run_job, "write_outputs", interrupt)
    assert run(*CALIBRATE)[::2] == (130, "dhcal: interrupted; nothing written\n")
    assert names(robot_folder) == before


def test_interrupt_while_the_files_are_saved(run, robot_folder, monkeypatch):
    """The message said "nothing written", although everything was."""
    commit = transaction._commit
    with monkeypatch.context() as patched:
        patched.setattr(transaction, "_commit", lambda *args: (interrupt(), commit(*args)))
        status, _, err = run(*CALIBRATE, "--json", "r.json", "--report", "r.md")
    assert status == 130
    assert err == (
        "dhcal: interrupted; these files are written: out.urdf, out.calibration.toml, r.md, r.json\n"
    )
    assert run("validate", "out.urdf", "data.csv")[0] == 0


def test_interrupt_after_the_files_are_saved(run, robot_folder, monkeypatch):
    monkeypatch.setattr(screens, "show", interrupt)
    status, _, err = run(*CALIBRATE)
    assert (status, "these files are written: out.urdf" in err) == (130, True)
    # The next command of the process starts anew.
    monkeypatch.setattr(run_job, "write_outputs", interrupt)
    assert run(*CALIBRATE)[::2] == (130, "dhcal: interrupted; nothing written\n")


# --- files that do not belong together -------------------------------------------------------------

READERS = {
    "validate": ["validate", "out.urdf", "data.csv"],
    "validate with a sidecar": ["validate", "copy.urdf", "data.csv", "--sidecar", "out.calibration.toml"],
    "calibrate": ["calibrate", "out.urdf", "data.csv", "-o", "again.urdf"],
    "plan": ["plan", "out.urdf", "-n", "5", "-o", "p.csv", "--candidates", "50"],
    "view": ["view", "arm.urdf", "out.urdf", "--html", "v.html"],
    "simulate": ["simulate", "out.urdf", "-m", "5", "-o", "s.csv"],
    "compensate": ["compensate", "arm.urdf", "out.urdf", "targets.csv", "-o", "c.csv"],
    "convert": ["convert", "out.urdf", "c.dh.toml"],
    "check": ["check", "out.urdf"],
}


@pytest.fixture(scope="module")
def mixed_files(tmp_path_factory):
    """Folder for `mixed`."""
    folder = tmp_path_factory.mktemp("mixed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        shutil.copy(URDF / "experiment.dh.toml", "arm.dh.toml")
        Path("data.csv").write_text(positions_csv(20))
        assert main.main(CALIBRATE) == 0
        first = Path("out.urdf").read_bytes()
        Path("data.csv").write_text(positions_csv(20, seed=5))
        assert main.main(CALIBRATE) == 0
        assert Path("out.urdf").read_bytes() != first
        Path("out.urdf").write_bytes(first)
        shutil.copy("out.urdf", "copy.urdf")
        Path("targets.csv").write_text("x[mm],y[mm],z[mm]\n500,100,600\n")
    return folder


@pytest.fixture
def mixed(mixed_files, robot_folder):
    """A new URDF beside the sidecar of another run, as a kill between two renames left them."""
    return shutil.copytree(mixed_files, robot_folder, dirs_exist_ok=True)


@pytest.mark.parametrize("command", READERS)
def test_every_reader_names_a_sidecar_of_another_urdf(mixed, assert_refused, command):
    words = ["out.calibration.toml: does not belong to", ".urdf", "calibrate again", "urdf_sha256 = "]
    assert_refused(words, *READERS[command])


def test_changes_of_other_parts_than_the_joints_do_not_matter(run, robot_folder):
    assert run(*CALIBRATE)[0] == 0
    text = Path("out.urdf").read_text()
    gripper = (
        '<link name="g"/><joint name="g" type="fixed"><parent link="tool0"/><child link="g"/></joint></robot>'
    )
    Path("out.urdf").write_text(text.replace("</robot>", gripper).replace("<visual>", "<visual name='v'>"))
    assert run("validate", "out.urdf", "data.csv", "--tip", "tool0")[0] == 0
    joint = text.index("<origin", text.index("<joint"))
    Path("out.urdf").write_text(f"{text[:joint]}<!-- -->{text[joint:]}")
    assert run("validate", "out.urdf", "data.csv")[0] == 0
    Path("out.urdf").write_text(text.replace('xyz="', 'xyz="1', 1))
    status, _, err = run("validate", "out.urdf", "data.csv")
    assert (status, "out.calibration.toml: does not belong to out.urdf" in err) == (2, True)


def test_an_edited_robot_is_accepted_with_its_new_hash(mixed, run):
    _, _, err = run("validate", "out.urdf", "data.csv")
    digest = err.split('urdf_sha256 = "')[1][:64]
    sidecar = Path("out.calibration.toml")
    lines = sidecar.read_text().splitlines()
    sidecar.write_text(
        "\n".join(f'urdf_sha256 = "{digest}"' if "urdf_sha256" in line else line for line in lines)
    )
    assert run("validate", "out.urdf", "data.csv")[0] == 0
    # A sidecar without a manifest, as it is written by hand, is not checked.
    sidecar.write_text(re.sub(r"(?ms)^\[manifest\].*?(?=^\[|\Z)", "", sidecar.read_text()))
    assert run("validate", "out.urdf", "data.csv")[0] == 0


@pytest.mark.parametrize("options", [[], ["--tool-frame", "measured"], ["--world-joint"]])
def test_the_manifest_has_the_hash_of_the_file(run, robot_folder, options):
    assert run(*CALIBRATE, *options, "--parameters", "dh,base,tool")[0] == 0
    digest = subprocess.run(["sha256sum", "out.urdf"], capture_output=True, text=True, check=True).stdout[:64]
    assert f'urdf_sha256 = "{digest}"' in Path("out.calibration.toml").read_text()
    assert run("validate", "out.urdf", "data.csv", "--tip", "tool0")[0] == 0


# --- studies ---------------------------------------------------------------------------------------


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(URDF / "sim_6dof.dh.toml", "sim_6dof.dh.toml")
    Path("s.study.toml").write_text(SMALL_STUDY)
    return read_study("s.study.toml")


STUDY = ("study", "s.study.toml", "-o", "s.csv")


def test_a_study_with_an_output_that_another_run_uses_is_refused(run, study, tmp_path):
    with open_journal("s.csv.part", study) as journal:
        status, _, err = run(*STUDY)
        assert (status, err.count("\n")) == (2, 1)
        assert "s.csv.part: another run of this study is using it" in err
        assert journal.blocks == []
    assert run(*STUDY)[0] == 0
    assert names(tmp_path) == ["s.csv", "s.study.toml", "sim_6dof.dh.toml"]


def test_a_full_disk_in_a_study(run, study, monkeypatch):
    write, count = os.write, 0

    def full(descriptor, data):
        nonlocal count
        count += 1
        if count == 4:
            # A part of the line still fits.
            write(descriptor, data[:20])
            raise OSError(28, "No space left on device")
        return write(descriptor, data)

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        status, _, err = run(*STUDY)
    assert (status, err.count("\n")) == (2, 1)
    assert "s.csv.part: cannot write there: No space left on device; the journal contains 2 blocks" in err
    status, _, err = run(*STUDY)
    assert (status, "resuming after 2 of 4 blocks" in err) == (0, True)
    resumed = Path("s.csv").read_bytes()
    assert run(*STUDY)[0] == 0
    assert Path("s.csv").read_bytes() == resumed


@pytest.mark.parametrize(
    "text",
    [
        *("", "1234", "{digest}", "{digest}\n[[1, 2]]\n", "{digest}\n[]\n5\n", "{digest}\nx\n"),
        *("{digest}\n" + "[" * 100_000 + "\n", "{digest}\n" + "[" * 3_000_000),
        "{digest}\n[[" + ", ".join(["9" * 400] * 10) + "]]\n",
    ],
)
def test_a_damaged_journal_is_continued(run, study, text):
    Path("s.csv.part").write_text(text.replace("{digest}", study.digest))
    assert run(*STUDY)[0] == 0
    assert not Path("s.csv.part").exists()


def test_a_journal_is_a_regular_file(run, study):
    os.mkfifo("s.csv.part")
    status, _, err = run(*STUDY)
    assert (status, "s.csv.part: is not a regular file" in err) == (2, True)


def test_interrupt_of_a_study(run, study, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(outputs, "write_outputs", interrupt)
        status, _, err = run(*STUDY)
    assert (status, "s.csv.part contains 4 of 4 blocks; run the same command to resume" in err) == (130, True)
    monkeypatch.setattr(screens, "show", interrupt)
    status, _, err = run(*STUDY)
    assert (status, err.splitlines()[-1]) == (
        130,
        "dhcal: interrupted; these files are written: s.csv",
    )
