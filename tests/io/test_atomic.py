"""Atomic writing: all files or none."""

from __future__ import annotations

import os

import pytest
from robots import write

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import require_writable, write_files


def test_all_files_are_written(tmp_path):
    write_files({tmp_path / "a": "ä", str(tmp_path / "b"): b"\xff"})
    assert (tmp_path / "a").read_bytes() == "ä".encode()
    assert (tmp_path / "b").read_bytes() == b"\xff"
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]


def test_a_new_file_has_the_usual_permissions(tmp_path):
    (tmp_path / "usual").touch()
    write_files({tmp_path / "a": ""})
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_the_target_of_a_link_is_written_and_keeps_its_permissions(tmp_path):
    """So a robot behind a link is calibrated in place where it is, and no more people may read it."""
    (tmp_path / "far").mkdir()
    real, link = write(tmp_path / "far", "real", "old"), tmp_path / "link"
    real.chmod(0o600)
    link.symlink_to(real)
    write_files({link: "new"})
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert real.stat().st_mode & 0o777 == 0o600
    assert sorted(os.listdir(tmp_path / "far")) == ["real"]


@pytest.mark.parametrize(
    ("bad", "words"), [("none/b", "make it first"), ("folder", "name a file in it"), ("a/b", "make it first")]
)
def test_if_the_second_file_cannot_be_written_the_first_one_is_not_written(tmp_path, bad, words):
    (tmp_path / "folder").mkdir()
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(DhcalError, match=f"{bad}: .*{words}"):
        write_files({tmp_path / "a": "new", tmp_path / bad: "new"})
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failing_rename_restores_the_old_files(tmp_path, monkeypatch, error):
    write(tmp_path, "a", "old")
    rename, places = os.replace, []

    def failing(source, target):
        places.append(target)
        if len(places) == 3:
            raise error
        rename(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(DhcalError if isinstance(error, OSError) else KeyboardInterrupt):
        write_files({tmp_path / "a": "new", tmp_path / "b": "new", tmp_path / "c": "new"})
    assert places[:3] == [str((tmp_path / name).resolve()) for name in "abc"]
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_backups_without_hard_links(tmp_path, monkeypatch):
    def none(*_):
        raise PermissionError(1, "no links here")

    monkeypatch.setattr(os, "link", none)
    write(tmp_path, "a", "old")
    write_files({tmp_path / "a": "new"})
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "new"


def test_an_open_file_keeps_its_old_content(tmp_path):
    write(tmp_path, "a", "old")
    with open(tmp_path / "a") as reader:
        write_files({tmp_path / "a": "new"})
        assert reader.read() == "old"
    assert (tmp_path / "a").read_text() == "new"


def test_paths_without_a_folder_are_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    require_writable("a.urdf")
    with pytest.raises(DhcalError, match="no folder sub; make it first"):
        require_writable("sub/a.urdf")
