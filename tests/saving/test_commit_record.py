"""Records of commits: completed by the next command, harmless if they come from somebody else."""

import json
import os

import pytest

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.saving import complete_interrupted_save, write_files
from dhcal_pin.saving.commit_record import RECORD_NAME, CommitRecord

TOKEN = "0123456789abcdef"
STAGED = f".dhcal-{TOKEN}-0.new"


@pytest.fixture
def victim(tmp_path):
    """A file that a record in the folder beside it must not change."""
    (tmp_path / "home").mkdir()
    (tmp_path / "data").mkdir()
    path = tmp_path / "home" / "victim"
    path.write_text("mine")
    (tmp_path / "data" / STAGED).write_text("evil")
    return path


def leave_record(folder, renames=(), removals=(), folders=None, token=TOKEN):
    record = {"token": token, "folders": folders or [str(folder)], "renames": renames, "removals": removals}
    (folder / RECORD_NAME).write_text(json.dumps(record))


def test_a_committed_save_is_completed(tmp_path):
    (tmp_path / STAGED).write_text("new")
    (tmp_path / "journal").write_text("")
    leave_record(tmp_path, [[STAGED, "robot"]], ["journal"])
    complete_interrupted_save(tmp_path / "other")
    assert os.listdir(tmp_path) == ["robot"]
    assert (tmp_path / "robot").read_text() == "new"


def test_a_save_that_was_not_committed_is_discarded(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    (tmp_path / "b" / STAGED).write_text("new")
    (tmp_path / "b" / "robot").write_text("old")
    # The record of the primary folder a is missing.
    leave_record(tmp_path / "b", [[STAGED, "robot"]], folders=[str(tmp_path / name) for name in "ab"])
    write_files({tmp_path / "b" / "other": "x"})
    assert sorted(os.listdir(tmp_path / "b")) == ["other", "robot"]
    assert (tmp_path / "b" / "robot").read_text() == "old"


@pytest.mark.parametrize("name", ["../home/victim", "/tmp/victim", "..", ".", "", 5, None])
def test_a_record_does_not_lead_out_of_its_folder(victim, name):
    folder = victim.parents[1] / "data"
    for renames, removals in (([[STAGED, name]], []), ([], [name]), ([[name, "x"]], [])):
        leave_record(folder, renames, removals)
        with pytest.raises(DhcalError, match=r"\.dhcal-save\.json: .*; remove this file"):
            complete_interrupted_save(folder / "robot.urdf")
        assert victim.read_text() == "mine"


def test_a_record_does_nothing_in_folders_without_records(victim):
    folder = victim.parents[1] / "data"
    leave_record(folder, removals=["x"], folders=[str(folder), str(victim.parent)])
    leave_record(victim.parent, removals=["victim"], folders=[str(victim.parent)], token="f" * 16)
    complete_interrupted_save(folder / "robot.urdf")
    assert victim.read_text() == "mine"
    assert not (folder / RECORD_NAME).exists()


NO_JSON = [(text, "cannot be read: it is damaged") for text in ("", "{", "\x00")]
NO_RECORD = [(text, "is not a record") for text in ("[]", "{}", '{"token": 1}', '{"a": 1}', "5")]


@pytest.mark.parametrize(("text", "said"), NO_JSON + NO_RECORD)
def test_other_files_with_the_name_of_a_record_are_named(tmp_path, text, said):
    (tmp_path / RECORD_NAME).write_text(text)
    message = rf"^\S*/\.dhcal-save\.json: {said}.*; remove this file$"
    with pytest.raises(DhcalError, match=message) as caught:
        complete_interrupted_save(tmp_path / "robot.urdf")
    assert "__init__" not in str(caught.value)
    with pytest.raises(DhcalError, match=message):
        write_files({tmp_path / "a": "", tmp_path / "b": ""})


def test_no_pipe_is_read_as_a_record(tmp_path):
    os.mkfifo(tmp_path / RECORD_NAME)
    complete_interrupted_save(tmp_path / "robot.urdf")
    assert CommitRecord.read(str(tmp_path)) is None


def test_a_commit_that_cannot_be_completed_is_named(tmp_path):
    (tmp_path / STAGED).write_text("new")
    (tmp_path / "robot.urdf").mkdir()
    leave_record(tmp_path, [[STAGED, "robot.urdf"]])
    with pytest.raises(
        DhcalError, match=r"killed while it saved robot\.urdf, and this cannot be completed: Is a"
    ):
        complete_interrupted_save(tmp_path / "robot.calibration.toml")


def test_only_own_temporary_files_are_removed(tmp_path):
    stale = [STAGED, f".dhcal-{TOKEN}-12.old"]
    others = [".dhcal-notes.new", ".dhcal-0123-0.new", "x.dhcal-0123456789abcdef-0.new", f"{STAGED}~"]
    for name in (*stale, *others):
        (tmp_path / name).write_text("")
    write_files({tmp_path / "a": "new"})
    assert sorted(os.listdir(tmp_path)) == sorted([*others, "a"])
