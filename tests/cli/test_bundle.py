"""Bundles: a calibration is repeated with equal bytes, and changed or unsafe bundles are refused."""

import json
import os
import re
import zipfile
from pathlib import Path

import pytest
from robots import URDF
from slow_cases import some_slow

from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import FileFormatError
from dhcal_pin.io.bundle import read_bundle

OPTIONS = ("--extend", "none", "--session", "off")
OUTPUTS = ("out.urdf", "out.calibration.toml", "residuals.csv")


# Manifest without files.
MANIFEST = {"format": "dhcal bundle", "version": 1, "options": {}, "versions": {}, "joints": [], "tip": "",
            "sha256": {}}  # fmt: skip


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """Calibrate a simulated arm in a folder, with paths outside of it; return the folder."""
    folder = tmp_path_factory.mktemp("first")
    data = folder.parent / "laser.csv"
    arm = str(URDF / "sim_6dof.dh.toml")
    assert main(["simulate", arm, "-m", "20", "--noise", "0.1mm", "-o", str(data)]) == 0
    outputs = [
        "-o",
        "out.urdf",
        "--json",
        "r.json",
        "--residuals",
        "residuals.csv",
        "--bundle",
        "arm.dhcal.zip",
    ]
    old = os.getcwd()
    os.chdir(folder)
    try:
        assert main(["calibrate", arm, f"../{data.name}", *OPTIONS, *outputs]) == 0
    finally:
        os.chdir(old)
    return folder


def test_a_bundle_repeats_the_calibration_with_equal_bytes(first, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("LC_ALL", "C")
    bundle = str(first / "arm.dhcal.zip")
    assert main(["calibrate", "--from", bundle, "-o", "out.urdf", "--bundle", "arm.dhcal.zip"]) == 0
    for name in (*OUTPUTS, "r.json", "arm.dhcal.zip"):
        assert (tmp_path / name).read_bytes() == (first / name).read_bytes(), name
    with zipfile.ZipFile(bundle) as archive:
        # No time is earlier in a zip file.
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert set(json.loads((tmp_path / "r.json").read_text())["inputs"]) == {"sim_6dof.dh.toml", "laser.csv"}


def test_a_warning_about_a_robot_elsewhere_is_shown_with_a_bundle(first, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["calibrate", "--from", str(first / "arm.dhcal.zip"), "-o", "out.urdf", "--bundle", "b.dhcal.zip"]
    assert main([*words, "--curves", "c.csv"]) == 0
    text = " ".join(capsys.readouterr().err.split())
    assert "sim_6dof.dh.toml: warning: the table of --curves has no rows" in text


def test_inspect_says_what_a_bundle_holds(first, capsys):
    assert main(["inspect", str(first / "arm.dhcal.zip"), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["data"] == ["laser.csv"]
    assert document["options"]["extend"] == "none"
    assert document["verdict"]["status"] in ("ok", "caution")
    assert document["accuracy"]["after"]["position_rms_m"] > 0


def changed(source, target, name, data):
    """Copy a zip file with another content of a member, or with a further one."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for info in old.infolist():
            new.writestr(info, data if info.filename == name else old.read(info))
        if name not in old.namelist():
            new.writestr(name, data)
        new.comment = old.comment
    return target


@pytest.mark.parametrize(
    ("member", "data", "message"),
    [
        ("inputs/laser.csv", b"x", "was changed"),
        ("manifest.json", b"x", "no manifest"),
        ("manifest.json", b"[" * 10**5, "no manifest"),
        ("manifest.json", b"[]", "no manifest"),
        ("manifest.json", b"[1]", "no manifest"),
        ("manifest.json", json.dumps(MANIFEST | {"format": "zip"}).encode(), "no manifest"),
        ("manifest.json", json.dumps(MANIFEST | {"joints": "j1"}).encode(), "no manifest"),
        (
            "manifest.json",
            json.dumps(MANIFEST | {"version": 2}).encode(),
            "version '2' of the format; expected 1",
        ),
        ("inputs/more.csv", b"x", "was changed"),
        ("../out.txt", b"x", "bad.dhcal.zip: unsafe name"),
        ("/tmp/out.txt", b"x", "bad.dhcal.zip: unsafe name"),
        ("inputs/../../out.txt", b"x", "bad.dhcal.zip: unsafe name"),
    ],
    ids=range(12),
)
def test_changed_and_unsafe_bundles_are_refused(first, tmp_path, capsys, member, data, message):
    path = changed(first / "arm.dhcal.zip", tmp_path / "bad.dhcal.zip", member, data)
    assert main(["calibrate", "--from", str(path), "-o", str(tmp_path / "out.urdf")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == error.count("bad.dhcal.zip") == 1
    assert [each.name for each in tmp_path.iterdir()] == ["bad.dhcal.zip"]


def test_a_missing_file_is_named_before_a_bundle_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["none.csv", "-o", "out.urdf", "--bundle", "arm.dhcal.zip"]
    assert main(["calibrate", str(URDF / "sim_6dof.dh.toml"), *words]) == 2
    assert capsys.readouterr().err.startswith("dhcal: none.csv: cannot read it: ")
    assert not list(tmp_path.iterdir())


def test_a_large_content_and_other_files_are_refused(first, tmp_path, monkeypatch):
    with zipfile.ZipFile(first / "arm.dhcal.zip") as archive:
        size = sum(info.file_size for info in archive.infolist())
    monkeypatch.setattr("dhcal_pin.io.bundle.MAX_BYTES", size)
    read_bundle(first / "arm.dhcal.zip")
    monkeypatch.setattr("dhcal_pin.io.bundle.MAX_BYTES", size - 1)
    with pytest.raises(FileFormatError, match="too large"):
        read_bundle(first / "arm.dhcal.zip")
    (tmp_path / "text.dhcal.zip").write_text("no zip file")
    with pytest.raises(FileFormatError, match="not a bundle"):
        read_bundle(tmp_path / "text.dhcal.zip")


def test_another_robot_must_have_the_joints_of_the_bundle(first, tmp_path, capsys):
    output = str(tmp_path / "out.urdf")
    other = str(URDF / "ur10.dh.toml")
    assert main(["calibrate", "--from", str(first / "arm.dhcal.zip"), other, "-o", output]) == 2
    assert "its joints are" in capsys.readouterr().err


def continued(first, folder, *options) -> dict:
    """Continue a calibration with options; return its JSON document."""
    outputs = ["-o", str(folder / "out.urdf"), "--json", str(folder / "r.json")]
    assert main(["calibrate", "--from", str(first / "arm.dhcal.zip"), *map(str, options), *outputs]) == 0
    return json.loads((folder / "r.json").read_text())


def test_a_bundle_is_continued_with_more_measurements(first, tmp_path):
    more, bundle = [tmp_path / each / "day" / "laser.csv" for each in "ab"], tmp_path / "next.dhcal.zip"
    robot = str(URDF / "sim_6dof.dh.toml")
    for seed, path in enumerate(more, 5):
        path.parent.mkdir(parents=True)
        words = ["-m", "9", "--noise", "0.1mm", "--seed", str(seed), "-o", str(path)]
        assert main(["simulate", robot, *words]) == 0
    found = continued(first, tmp_path, *more, "--bundle", bundle)
    assert found["samples"] == 38
    # The names of the added files are other ones in the bundle.
    names = {"laser.csv", "sim_6dof.dh.toml", "a/day/laser.csv", "b/day/laser.csv"}
    assert set(read_bundle(bundle).inputs) == names
    again = tmp_path / "again"
    again.mkdir()
    assert main(["calibrate", "--from", str(bundle), "-o", str(again / "out.urdf")]) == 0
    assert (again / "out.urdf").read_bytes() == (tmp_path / "out.urdf").read_bytes()


def test_a_bundle_is_continued_with_another_robot_and_other_options(first, tmp_path):
    old = json.loads((first / "r.json").read_text())
    robot = tmp_path / "other.dh.toml"
    text = (URDF / "sim_6dof.dh.toml").read_text()
    robot.write_text(re.sub(r"(?m)^d = ([1-9]\S*)", lambda match: f"d = {float(match[1]) + 1}", text))
    assert robot.read_text() != text
    found = continued(first, tmp_path, robot, "--holdout", "0.25", "--loss", "linear")
    assert any(name.endswith("other.dh.toml") for name in found["inputs"])
    assert found["before"]["position_rms_m"] != old["before"]["position_rms_m"]
    assert (old["samples"], found["samples"], found["samples_holdout"]) == (20, 15, 5)


@pytest.mark.parametrize("curves", some_slow(["", ",curves"], [0]))
def test_a_bundle_with_a_report_is_repeated_with_equal_bytes(first, tmp_path, monkeypatch, curves):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    more = ("--parameters", f"minimal,base,tool{curves}", "--report", "r.html", "--bundle", "c.dhcal.zip")
    assert main(["calibrate", "--from", str(first / "arm.dhcal.zip"), *more, "-o", "out.urdf"]) == 0
    monkeypatch.chdir(tmp_path / "b")
    assert main(["calibrate", "--from", "../a/c.dhcal.zip", "-o", "out.urdf"]) == 0
    assert ("[uncertainty.information]" in Path("out.calibration.toml").read_text()) == bool(curves)
    for path in (tmp_path / "b").iterdir():
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes(), path.name
    assert {path.name for path in (tmp_path / "b").iterdir()} >= {"out.urdf", "r.html"}
