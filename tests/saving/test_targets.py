"""Devices, pipes and open descriptors are written to and stay what they are."""

import os
import signal
import stat
import subprocess
import sys
import threading
import time

import pytest

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.saving import is_stream, require_writable, write_files


@pytest.fixture
def null(tmp_path):
    """A device like /dev/null in a folder of its own."""
    path = tmp_path / "null"
    try:
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 3))
        path.write_bytes(b"")
    except OSError:
        pytest.skip("devices need the permissions of root")
    return path


def test_a_device_stays_a_device(null, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(null)
    write_files({null: "text", link: b"bytes", tmp_path / "file": "x"})
    assert stat.S_ISCHR(null.stat().st_mode)
    assert link.is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["file", "link", "null"]


def test_the_reader_of_a_pipe_gets_the_content(tmp_path):
    pipe, received = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: received.append(pipe.read_bytes()))
    reader.start()
    # More than the buffer of a pipe.
    write_files({pipe: b"x" * 200_000, tmp_path / "file": "y"})
    reader.join(10)
    assert received == [b"x" * 200_000]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert (tmp_path / "file").read_text() == "y"


@pytest.mark.parametrize("path", ["/dev/full", "closed"])
def test_a_stream_that_fails_changes_no_file(tmp_path, path):
    (tmp_path / "file").write_text("old")
    if path == "closed":
        path = str(tmp_path / "pipe")
        os.mkfifo(path)
        # A reader that closes the pipe at once.
        threading.Thread(target=lambda: os.close(os.open(path, os.O_RDONLY))).start()
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(DhcalError, match=r"cannot write there: .*; no file is changed"):
        write_files({tmp_path / "file": "new", path: b"x" * 10_000_000, tmp_path / "other": "new"})
    assert sorted(os.listdir(tmp_path)) == before
    assert (tmp_path / "file").read_text() == "old"


WAIT = """
import sys
from dhcal_pin.saving import write_files
try:
    write_files({"pipe": "x", "file": "new"})
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_waiting_for_the_reader_of_a_pipe_can_be_interrupted(tmp_path, number, status):
    os.mkfifo(tmp_path / "pipe")
    # A process in the background ignores interrupts, and its children inherit that.
    run = subprocess.Popen(
        [sys.executable, "-c", WAIT],
        cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler) and None,
    )
    deadline = time.monotonic() + 20
    while not list(tmp_path.glob(".dhcal-*.new")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.2)
    run.send_signal(number)
    assert run.wait(10) == status
    assert os.listdir(tmp_path) == ["pipe"]


def test_descriptors_are_written_to(tmp_path):
    """Opening /dev/stdout again would write over the beginning of a redirected file."""
    script = (
        "import sys; from dhcal_pin.saving import write_files; print('a'); write_files({sys.argv[1]: 'b\\n'})"
    )
    for path in ("/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"):
        out = tmp_path / "out"
        with out.open("w") as file:
            file.write("before\n")
            file.flush()
            subprocess.run([sys.executable, "-c", script, path], stdout=file, check=True)
        assert out.read_text() == "before\na\nb\n"
    assert os.listdir(tmp_path) == ["out"]


def test_regular_files_are_no_streams(tmp_path):
    (tmp_path / "file").touch()
    assert not is_stream(tmp_path / "file")
    assert not is_stream(tmp_path)
    assert not is_stream(tmp_path / "none")
    assert not is_stream("/dev/shm/none")
    assert not is_stream("a\0b")
    assert is_stream("/dev/null")
    assert is_stream("/dev/stderr")


def test_paths_without_a_folder_are_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    require_writable("a.urdf")
    with pytest.raises(DhcalError, match="no folder sub; make it first"):
        require_writable("sub/a.urdf")
