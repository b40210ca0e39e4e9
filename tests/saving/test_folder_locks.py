"""Several runs that save the same files: one after the other."""

import errno
import fcntl
import os
import subprocess
import sys

import pytest

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.saving import folder_locks, write_files
from dhcal_pin.saving.commit_record import temporary_name
from dhcal_pin.saving.folder_locks import lock_folders
from dhcal_pin.saving.signals import DeferredSignals

SAVE = """
import sys
from dhcal_pin.saving import write_files
print("ready", flush=True)
sys.stdin.readline()
for i in range(40):
    text = f"{sys.argv[1]} {i}"
    write_files({"a/robot": text, "b/sidecar": text, "a/report": text})
"""


def test_files_of_concurrent_runs_are_not_mixed(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    command, pipe = [sys.executable, "-c", SAVE], subprocess.PIPE
    names = ("one", "two", "three")
    runs = [
        subprocess.Popen([*command, name], cwd=tmp_path, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        for name in names
    ]
    for run in runs:
        assert run.stdout is not None
        assert run.stdout.readline() == "ready\n"
    for run in runs:
        assert run.stdin is not None
        run.stdin.write("start\n")
        run.stdin.flush()
    folders = [str(tmp_path / name) for name in "ab"]
    while any(run.poll() is None for run in runs):
        with lock_folders(folders, DeferredSignals()) as is_locked:
            assert is_locked
            texts = [path.read_text() for path in sorted(tmp_path.rglob("*")) if path.is_file()]
        assert len(texts) in (0, 3)
        assert len(set(texts)) <= 1
    assert [run.communicate()[1] for run in runs] == ["", "", ""]
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == [
        "report",
        "robot",
        "sidecar",
    ]


def test_a_run_that_does_not_end_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_locks, "TIMEOUT_S", 0.1)
    with lock_folders([str(tmp_path)], DeferredSignals()):
        with pytest.raises(DhcalError, match="another run has been saving files there"):
            write_files({tmp_path / "a": ""})
    assert os.listdir(tmp_path) == []
    write_files({tmp_path / "a": ""})


def test_without_locks_nothing_of_others_is_removed(tmp_path, monkeypatch):
    """Network file systems may have no locks, and the temporary file may be in use."""

    def none(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    other = temporary_name("f" * 16, 0, "new")
    (tmp_path / other).touch()
    write_files({tmp_path / "a": "x", tmp_path / "b": "y"})
    assert sorted(os.listdir(tmp_path)) == sorted([other, "a", "b"])
