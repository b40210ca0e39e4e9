"""Saving: all files or none."""

import os

import pytest
from robots import write

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.saving import write_files


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
        places.append(os.path.basename(target))
        if places[-1] == "c":
            raise error
        rename(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(DhcalError if isinstance(error, OSError) else KeyboardInterrupt):
        write_files({tmp_path / "a": "new", tmp_path / "b": "new", tmp_path / "c": "new"})
    assert [name for name in places if name in "abc"] == ["a", "b", "c", "a"]
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


def test_two_paths_of_one_file_are_refused(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "a")
    with pytest.raises(DhcalError, match="is another output already"):
        write_files({tmp_path / "a": "1", tmp_path / "link": "2"})
    assert os.listdir(tmp_path) == ["link"]


def test_a_file_is_removed_together_with_the_writing_of_others(tmp_path):
    write(tmp_path, "journal", "old")
    write_files({tmp_path / "a": "new", tmp_path / "journal": None, tmp_path / "none": None})
    assert os.listdir(tmp_path) == ["a"]
    write_files({tmp_path / "a": None})
    assert os.listdir(tmp_path) == []


def test_a_failure_before_the_commit_changes_nothing(tmp_path):
    write(tmp_path, "a", "old")

    def fail():
        assert (tmp_path / "a").read_text() == "old"
        raise DhcalError("closed")

    with pytest.raises(DhcalError, match="closed"):
        write_files({tmp_path / "a": "new", tmp_path / "b": "new"}, fail)
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_text() == "old"


def test_everything_is_flushed_to_the_disk_before_it_is_renamed(tmp_path, monkeypatch):
    """Otherwise a power failure could leave an empty file under the new name."""
    events = []

    def name_of(descriptor):
        return os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}")).split("-")[-1]

    fsync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda d: events.append(f"flush {name_of(d)}") or fsync(d))
    monkeypatch.setattr(
        os, "replace", lambda a, b: events.append(f"rename {os.path.basename(b)}") or rename(a, b)
    )
    write_files({tmp_path / "a": "1", tmp_path / "b": "2"})
    folder = f"flush {tmp_path.name.split('-')[-1]}"
    assert events == [
        *("flush 0.new", "flush 1.new", folder),
        *("flush 2.new", "rename .dhcal-save.json", folder),
        *("rename a", "rename b", folder),
    ]
