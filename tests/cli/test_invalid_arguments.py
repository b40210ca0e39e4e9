"""Invalid arguments and settings: one line, and no file is changed."""

import os
from pathlib import Path

import pytest
from command_line import CALIBRATE, positions_csv
from robots import URDF

ARGUMENTS = {
    "no command": ([], ["COMMAND", "--help"]),
    "unknown command": (["calibrat"], ["'calibrat' (did you mean calibrate?)", "--help"]),
    "unlike any command": (["foo"], ["'foo'", "calibrate", "--help"]),
    "unknown option": ([*CALIBRATE, "--xyz", "9"], ["--xyz; see dhcal calibrate --help"]),
    "abbreviated option": ([*CALIBRATE, "--tool", "f"], ["--tool (did you mean --tool-frame?)"]),
    "abbreviated options": ([*CALIBRATE, "--re=1"], ["--re (did you mean", " or --report"]),
    "misspelt option": ([*CALIBRATE, "--methid", "gn"], ["--methid (did you mean --method?)"]),
    "misspelt required option": (
        [*CALIBRATE[:-2], "--ouput", "out.urdf"],
        ["--ouput (did you mean --output?)"],
    ),
    "option of another command": (
        [*CALIBRATE, "--fit-frames"],
        ["unrecognized arguments: --fit-frames (an option of validate, view); see"],
    ),
    "unlike any option": ([*CALIBRATE, "--speed", "1"], ["unrecognized arguments: --speed; see"]),
    "misspelt option without a command": (["--verison"], ["--verison (did you mean --version?)"]),
    "unknown option without a command": (["-x"], ["unrecognized arguments: -x; see dhcal --help"]),
    "option before the command": (
        ["--tip", "tool0", *CALIBRATE],
        ["--tip stands before the command; expected dhcal calibrate ... --tip; see dhcal --help"],
    ),
    "option with its value before the command": (
        ["--tip=tool0", *CALIBRATE],
        ["--tip stands before the command; expected dhcal calibrate ... --tip; see dhcal --help"],
    ),
    "option without a command": (
        ["-o", "out.urdf"],
        ["-o stands before the command; expected dhcal COMMAND"],
    ),
    "misspelt choice": ([*CALIBRATE, "--arm", "lowcost"], ["'lowcost' (did you mean low-cost?)"]),
    "no output": (["calibrate", "arm.dh.toml", "data.csv"], ["-o", "required", "dhcal calibrate --help"]),
    "no data": (["calibrate", "arm.dh.toml", "-o", "out.urdf"], ["DATA", "required"]),
    "no robot": (
        ["calibrate", "data.csv", "-o", "out.urdf"],
        ["data.csv: ROBOT is required; name the file of the robot before that of the measurements"],
    ),
    "no data for a table": (["calibrate", "arm.dh.csv", "-o", "out.urdf"], ["arm.dh.csv: DATA is required"]),
    "no such robot": (["calibrate", "no.urdf", "data.csv", "-o", "out.urdf"], ["no.urdf", "No such file"]),
    "no such table": (
        ["calibrate", "no.dh.toml", "data.csv", "-o", "out.urdf"],
        ["no.dh.toml", "No such file"],
    ),
    "no such data": (["calibrate", "arm.urdf", "no.csv", "-o", "out.urdf"], ["no.csv", "No such file"]),
    "a folder as data": (["calibrate", "arm.urdf", ".", "-o", "out.urdf"], [".: cannot read", "directory"]),
    "no such second data": ([*CALIBRATE[:3], "no.csv", *CALIBRATE[3:]], ["no.csv", "No such file"]),
    "unknown tip": (
        ["calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--tip", "tool"],
        ["'tool'", "'tool0'"],
    ),
    "data before the robot": (
        ["calibrate", "data.csv", "arm.urdf", "--tip", "tool0", "-o", "out.urdf"],
        ["data.csv: expected a DH table", "the file of the robot comes first"],
    ),
    "tip of a table": ([*CALIBRATE, "--tip", "tool0"], ["arm.dh.toml", "leave out --tip"]),
    "unknown set": ([*CALIBRATE, "--parameters", "dh,gains"], ["'gains'", "dh, modified-dh"]),
    "empty set": ([*CALIBRATE, "--parameters", ""], ["''", "dh, modified-dh"]),
    "fixed and freed": ([*CALIBRATE, "--fix", "tool.x", "--free", "tool.x"], ["'tool.x'", "leave out"]),
    "unknown to fix": ([*CALIBRATE, "--fix", "d9"], ["cannot fix 'd9'", "d1"]),
    "unknown to free": ([*CALIBRATE, "--free", "d9"], ["cannot free 'd9'", "d1"]),
    "all fixed": ([*CALIBRATE, "--fix", "dh"], ["fix fewer"]),
    "unknown method": ([*CALIBRATE, "--method", "newton"], ["'newton'", "lm", "gn"]),
    "no iterations": ([*CALIBRATE, "--max-iterations", "0"], ["--max-iterations", "integer of at least 1"]),
    "seed below zero": ([*CALIBRATE, "--seed", "-1"], ["--seed", "integer of at least 0"]),
    "seed in words": ([*CALIBRATE, "--seed", "one"], ["--seed", "'one' is invalid", "integer"]),
    "holdout in words": (
        [*CALIBRATE, "--holdout", "some"],
        ["--holdout some", "neither a file nor a number"],
    ),
    "holdout too big": ([*CALIBRATE, "--holdout", "1.5"], ["holdout=1.5", "in [0, 1)"]),
    "holdout of all": ([*CALIBRATE, "--holdout", "1"], ["holdout=1.0", "in [0, 1)"]),
    "holdout below zero": ([*CALIBRATE, "--holdout", "-0.1"], ["holdout=-0.1", "in [0, 1)"]),
    "holdout nan": ([*CALIBRATE, "--holdout", "nan"], ["holdout=nan", "in [0, 1)"]),
    "nothing left": ([*CALIBRATE, "--holdout", "0.99"], ["for the fit", "expected a smaller fraction"]),
    "nothing held out": ([*CALIBRATE, "--holdout", "0.01"], ["holds out none", "expected a larger fraction"]),
    "holdout fitted": ([*CALIBRATE, "--holdout", "./data.csv"], ["data.csv: is given twice", "once"]),
    "data twice": (
        ["calibrate", "arm.urdf", "data.csv", "data.csv", "-o", "out.urdf"],
        ["data.csv: is given twice"],
    ),
    "no such priors": ([*CALIBRATE, "--priors", "no.toml"], ["--priors no.toml", "default, none"]),
    "output is the robot": (
        ["calibrate", "arm.urdf", "data.csv", "-o", "./arm.urdf"],
        ["arm.urdf: is an input"],
    ),
    "output is a table": ([*CALIBRATE[:-1], "arm.dh.toml"], ["arm.dh.toml", ".urdf"]),
    "output is the data": ([*CALIBRATE[:-1], "data.csv"], ["data.csv", ".urdf"]),
    "JSON is the robot": ([*CALIBRATE, "--json", "arm.dh.toml"], ["arm.dh.toml: is an input"]),
    "JSON is the robot in place": (
        ["calibrate", "arm.urdf", "data.csv", "-o", "arm.urdf", "--in-place", "--json", "arm.urdf"],
        ["arm.urdf: is an input"],
    ),
    "JSON is the data": ([*CALIBRATE, "--json", "data.csv"], ["data.csv: is an input"]),
    "JSON is the URDF": ([*CALIBRATE, "--json", "out.urdf"], ["out.urdf: is another output"]),
    "no such folder": ([*CALIBRATE[:-1], "no/out.urdf"], ["no/out.urdf", "no folder no", "make it first"]),
    "no such folder for JSON": ([*CALIBRATE, "--json", "no/r.json"], ["no/r.json", "no folder no"]),
    "a folder as JSON": ([*CALIBRATE, "--json", "."], [".: is a folder", "name a file"]),
    "a file as folder": ([*CALIBRATE[:-1], "data.csv/out.urdf"], ["data.csv/out.urdf", "no folder data.csv"]),
    "validate with no sidecar": (
        ["validate", "arm.urdf", "data.csv", "--sidecar", "no.toml"],
        ["no.toml", "No such"],
    ),
    "validate over its data": (
        ["validate", "arm.urdf", "data.csv", "--json", "data.csv"],
        ["data.csv: is an input"],
    ),
    **{
        f"{words[0]} a sheet of a CSV file": (
            [*words, "--sheet", "Foo"],
            ["--sheet Foo: no input is an Excel file; expected .xlsx"],
        )
        for words in (
            CALIBRATE,
            ["validate", "arm.urdf", "data.csv"],
            ["recheck", "arm.urdf", "data.csv"],
            ["inspect", "data.csv"],
            ["view", "arm.urdf", "--data", "data.csv", "--html", "scene.html"],
            ["plan", "arm.urdf", "-n", "9", "-o", "poses.csv", "--data", "data.csv"],
        )
    },
    "plan to a PDF": (
        ["plan", "arm.urdf", "-n", "9", "-o", "poses.pdf"],
        ["poses.pdf: unknown ending; write poses as .csv"],
    ),
    "plan of ISO 9283 to a PDF": (
        ["plan", "arm.urdf", "--iso9283", "-o", "poses.pdf"],
        ["poses.pdf: unknown ending; write poses as .csv"],
    ),
    "plan with a scene as text": (
        ["plan", "arm.urdf", "-n", "9", "-o", "poses.csv", "--html", "scene.txt"],
        ["scene.txt: unknown ending; write a scene as .html"],
    ),
    "view as text": (
        ["view", "arm.urdf", "--html", "scene.txt"],
        ["scene.txt: unknown ending; write a scene as .html"],
    ),
    "check over its robot": (["check", "arm.urdf", "--json", "arm.urdf"], ["arm.urdf: is an input"]),
    "check nothing": (["check", "no.urdf"], ["no.urdf", "No such file"]),
    "no samples": (
        ["simulate", "arm.urdf", "-m", "0", "-o", "s.csv"],
        ["--samples", "integer of at least 1"],
    ),
    "samples in words": (
        ["simulate", "arm.urdf", "-m", "many", "-o", "s.csv"],
        ["'many' is invalid", "integer"],
    ),
    "noise without a unit": (
        ["simulate", "arm.urdf", "-m", "5", "--noise", "0.1", "-o", "s.csv"],
        ["'0.1'", "0.1mm"],
    ),
    "noise of feet": (
        ["simulate", "arm.urdf", "-m", "5", "--noise", "1ft", "-o", "s.csv"],
        ["'1ft'", "0.1mm"],
    ),
    "noise below zero": (["simulate", "arm.urdf", "-m", "5", "--noise=-1mm", "-o", "s.csv"], ["'-1mm'", "0"]),
    "simulate to a workbook": (
        ["simulate", "arm.urdf", "-m", "5", "-o", "s.xlsx"],
        ["s.xlsx: unknown ending; write measurements as .csv"],
    ),
    "compensate to JSON": (
        ["compensate", "arm.urdf", "arm.urdf", "targets.csv", "-o", "c.json"],
        ["c.json: unknown ending; write corrected targets as .csv"],
    ),
    "study to a workbook": (
        ["study", "figure3", "-o", "results.xlsx"],
        ["results.xlsx: unknown ending; write a table of results as .csv"],
    ),
    "simulate over the robot": (
        ["simulate", "arm.urdf", "-m", "5", "-o", "arm.urdf"],
        ["arm.urdf: is an input"],
    ),
    "simulate over the truth": (
        ["simulate", "arm.urdf", "--truth", "arm.dh.toml", "-m", "5", "-o", "arm.dh.toml"],
        ["arm.dh.toml: is an input"],
    ),
    "another arm as truth": (
        ["simulate", "arm.urdf", "--truth", URDF / "sim_6dof.dh.toml", "-m", "5", "-o", "s.csv"],
        ["sim_6dof.dh.toml", "joint_6", "arm.urdf"],
    ),
    "convert in place": (["convert", "arm.urdf", "arm.urdf"], ["arm.urdf: is an input"]),
    "convert to a picture": (
        ["convert", "arm.dh.toml", "arm.png"],
        ["arm.png", ".urdf", ".dh.toml", ".dh.csv"],
    ),
    "convert to no ending": (["convert", "arm.urdf", "arm"], ["arm:", ".dh.toml", ".dh.csv"]),
    "convert nothing": (["convert", "no.dh.csv", "no.urdf"], ["no.dh.csv", "No such file"]),
    "convert with a tip": (["convert", "arm.dh.toml", "a.urdf", "--tip", "tool0"], ["arm.dh.toml", "--tip"]),
    "demo into a file": (["demo", "--out", "data.csv"], ["data.csv", "folder"]),
    "demo with JSON nowhere": (
        ["demo", "--out", "demo", "--json", "no/r.json"],
        ["no/r.json", "no folder no"],
    ),
}


@pytest.mark.parametrize("case", ARGUMENTS)
def test_invalid_arguments_are_refused(assert_refused, case):
    args, words = ARGUMENTS[case]
    assert_refused(words, *args)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a1 = 'small'\n", ["priors.toml", "a1 = 'small'", "m or rad"]),
        ("a1 = 0\n", ["priors.toml", "a1 = 0", "positive"]),
        ("a1 = nan\n", ["priors.toml", "a1 = nan", "positive"]),
        ("[dh]\na1 = 1\n", ["priors.toml", "dh = ", "m or rad"]),
        ("a9 = 0.1\n", ["'a9'", "no such parameter", "a1"]),
        ("a1 0.1\n", ["priors.toml", "not TOML", "line 1"]),
    ],
)
def test_invalid_priors_are_refused(assert_refused, text, words):
    Path("priors.toml").write_text(text)
    assert_refused(words, *CALIBRATE, "--priors", "priors.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a1 = 0.1\n", ["bounds.toml", "a1 = 0.1", "such as"]),
        ("a1 = [0.2, 0.1]\n", ["bounds.toml", "a1 = [0.2, 0.1]", "m or rad"]),
        ("a9 = [0.1, 0.2]\n", ["'a9'", "no such parameter", "a1"]),
        ("a1 = [5.0, 6.0]\n", ["'a1'", "must contain the nominal"]),
    ],
)
def test_invalid_bounds_are_refused(assert_refused, text, words):
    Path("bounds.toml").write_text(text)
    assert_refused(words, *CALIBRATE, "--bounds", "bounds.toml")


def test_outputs_do_not_overwrite_inputs(assert_refused):
    Path("held.csv").write_text(positions_csv(5, 1))
    Path("out.calibration.toml").write_text("a1 = 0.1\n")
    assert_refused(["held.csv: is an input"], *CALIBRATE, "--holdout", "held.csv", "--json", "held.csv")
    assert_refused(["out.calibration.toml: is an input"], *CALIBRATE, "--priors", "out.calibration.toml")
    os.link("arm.urdf", "link.urdf")
    assert_refused(["link.urdf: is an input"], "calibrate", "arm.urdf", "data.csv", "-o", "link.urdf")


def test_an_empty_file_of_targets_is_answered_with_the_header_of_targets(assert_refused):
    Path("empty.csv").write_text("")
    words = ["empty.csv: is empty", "a header such as x[mm],y[mm],z[mm]"]
    assert_refused(words, "compensate", "arm.urdf", "arm.urdf", "empty.csv", "-o", "c.csv")


@pytest.mark.parametrize("command", ["calibrate", "validate", "check"])
def test_invalid_robot_is_one_line_in_every_command(assert_refused, command):
    Path("bad.dh.toml").write_text(Path("arm.dh.toml").read_text().replace('convention = "standard"', ""))
    Path("bad.urdf").write_text("<robot name='r'><link name='a'/>")
    for robot, word in (("bad.dh.toml", "convention"), ("bad.urdf", "bad.urdf:1: broken XML")):
        arguments = {
            "calibrate": ["calibrate", robot, "data.csv", "-o", "out.urdf"],
            "validate": ["validate", robot, "data.csv"],
            "check": ["check", robot],
        }
        assert_refused([robot, word], *arguments[command])


@pytest.mark.skipif(os.geteuid() == 0, reason="root has all permissions")
def test_folder_without_permission(assert_refused, robot_folder):
    (robot_folder / "locked").mkdir(mode=0o500)
    assert_refused(["locked/out.urdf", "Permission denied"], *CALIBRATE[:-1], "locked/out.urdf")


def test_full_disk_writes_nothing(assert_refused, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    assert_refused(["out.urdf", "No space left"], *CALIBRATE, "--json", "r.json")


def test_no_warning_is_shown_before_an_error(assert_refused):
    Path("data.csv").write_text(positions_csv(20, wrong=[3]))
    assert_refused(["cannot free"], *CALIBRATE, "--free", "d9")
