"""Fixtures that run commands in a folder with a robot and its measurements."""

import shutil
from pathlib import Path

import pytest
from command_line import folder_contents, positions_csv
from robots import URDF


@pytest.fixture
def robot_folder(tmp_path, monkeypatch):
    """Working folder with a robot as DH table and as URDF, and twenty measurements of it."""
    monkeypatch.chdir(tmp_path)
    for suffix in (".dh.toml", ".urdf"):
        shutil.copy(URDF / f"experiment{suffix}", f"arm{suffix}")
    Path("data.csv").write_text(positions_csv(20))
    return tmp_path


@pytest.fixture
def assert_refused(run, robot_folder):
    """Function that runs a command that must fail with one line with some words, and change no file."""

    def call(words, *args):
        before = folder_contents(robot_folder), sorted(robot_folder.rglob("*"))
        status, out, err = run(*args)
        assert (status, out) == (2, "")
        assert err.endswith("\n")
        assert err.count("\n") == 1
        assert err.startswith("dhcal")
        for word in words:
            assert word in err
        assert (folder_contents(robot_folder), sorted(robot_folder.rglob("*"))) == before

    return call
