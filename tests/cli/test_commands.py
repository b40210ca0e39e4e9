"""The `dhcal` command: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from robots import URDF
from scipy.spatial.transform import Rotation

from dhcal_pin.calibration import model_selection
from dhcal_pin.cli import console, main
from dhcal_pin.io.dh_file import read_dh
from dhcal_pin.io.measurement_csv import measurement_text, read_measurement_file
from dhcal_pin.io.robot import read_robot
from dhcal_pin.measurements.position import Position
from dhcal_pin.paper import factors, jacobian_check, simulations
from dhcal_pin.robot import sampling
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.urdf import read_urdf

KEYS = {
    *("converged", "iterations", "samples", "samples_holdout", "rank", "parameters_total", "condition"),
    *("before", "after", "holdout_before", "holdout_after", "parameters", "unobservable", "outliers"),
    *("files", "versions", "inputs"),
}
ACCURACY = {"position_rms_m", "position_max_m", "orientation_rms_rad"}
HEADER = "joint_1[deg],joint_2[deg],joint_3[deg],x[mm],y[mm],z[mm]"


def tip(degrees):
    """Where the paper's measured arm has its tool, mm: an upright axis and two links in its plane."""
    q1, q2, q3 = np.radians(degrees).T
    out = 400 * np.cos(q2) + 345 * np.cos(q2 + q3)
    up = 433 + 400 * np.sin(q2) + 345 * np.sin(q2 + q3)
    return np.stack([out * np.cos(q1), out * np.sin(q1), up], -1)


def csv(count, seed=0, wrong=(), error=1.0):
    """Positions of that arm, each coordinate off by about `error` mm, and rows (from 1) off by a metre."""
    rng = np.random.default_rng(seed)
    degrees = rng.uniform(-80, 80, (count, 3))
    seen = tip(degrees) + error * rng.normal(size=(count, 3))
    seen[[row - 1 for row in wrong]] += 1000
    rows = np.concatenate([degrees, seen], 1).tolist()
    return "\n".join([HEADER, *(",".join(map(repr, row)) for row in rows)]) + "\n"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working folder with an arm as DH table and URDF, and twenty measurements of it."""
    monkeypatch.chdir(tmp_path)
    for suffix in (".dh.toml", ".urdf"):
        shutil.copy(URDF / f"experiment{suffix}", f"arm{suffix}")
    Path("data.csv").write_text(csv(20))
    return tmp_path


@pytest.fixture
def run(capsys):
    def call(*args):
        """Exit status, stdout and stderr of a command."""
        try:
            status = main.main([str(arg) for arg in args])
        except SystemExit as stop:
            status = stop.code
        said = capsys.readouterr()
        return status, said.out, said.err

    return call


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def refused(run, place):
    def call(words, *args):
        """A command that must be turned down in one line with these words, and leave everything as it was."""
        before = contents(place), sorted(place.rglob("*"))
        status, out, err = run(*args)
        assert (status, out) == (2, "")
        assert err.endswith("\n")
        assert err.count("\n") == 1
        assert err.startswith("dhcal")
        for word in words:
            assert word in err
        assert (contents(place), sorted(place.rglob("*"))) == before

    return call


def strict(text):
    """JSON without NaN and infinities, which JSON does not have."""

    def never(name):
        raise AssertionError(f"{name} in JSON")

    return json.loads(text, parse_constant=never)


def done(result):
    status, out, err = result
    assert status == 0, err
    return out


CALIBRATE = ("calibrate", "arm.dh.toml", "data.csv", "-o", "out.urdf")


def edited(old, new, count=1):
    text = csv(4)
    assert old in text
    return text.replace(old, new, count)


def column(name, values):
    head, *rows = csv(len(values)).splitlines()
    return "\n".join([f"{head},{name}", *(f"{row},{value}" for row, value in zip(rows, values, strict=True))])


# --- wrong input -----------------------------------------------------------------------------------

LINES = csv(4).splitlines()
QUATERNION = "qw,qx,qy,qz"
ROTATION = "rx[rad],ry[rad],rz[rad]"
SIGMA = "sigma_x[mm],sigma_y[mm],sigma_z[mm]"
DATA = {
    "empty": ("", ["data.csv: is empty", "x[mm]"]),
    "only comments": ("# nothing\n\n", ["data.csv: is empty"]),
    "header only": (HEADER + "\n", ["data.csv: no rows", "line 1"]),
    "not UTF-8": (b"\xff\xfe" + csv(4).encode("utf-16-le"), ["data.csv: byte 0 is not UTF-8", "save"]),
    "unknown column": (column("weather", [1, 2]), ["data.csv:1:", "'weather'", "remove it", "joint_1"]),
    "mistyped": (edited("joint_2[", "joint_two["), ["data.csv:1:", "did you mean 'joint_2'?"]),
    "a joint too many": (column("joint_4[deg]", [1, 2]), ["data.csv:1:", "'joint_4'", "remove it"]),
    "no header": ("\n".join(LINES[1:]) + "\n", ["data.csv:1: numbers where the header must be", "x[mm]"]),
    "underscore": (
        column("sigma_x[mm],sigma_y[mm],sigma_z[mm]", ["1,1,1", "1,1,1_0"]),
        ["data.csv:3:", "'sigma_z'", "'1_0' is not a finite number"],
    ),
    "near miss": (edited("joint_2[", "joint2["), ["data.csv:1:", "'joint2'", "did you mean 'joint_2'?"]),
    "foreign joint": (edited("joint_2[", "wrist_yaw["), ["data.csv:1:", "'wrist_yaw'", "joint_2"]),
    "no unit": (edited("x[mm]", "x"), ["data.csv:1:", "'x' has no unit", "x[mm]"]),
    "empty unit": (edited("x[mm]", "x[]"), ["data.csv:1:", "'x' has no unit", "x[mm]"]),
    "unknown unit": (edited("x[mm]", "x[inch]"), ["data.csv:1:", "'x' has unit 'inch'", "x[mm]"]),
    "other unit": (edited("x[mm]", "x[deg]"), ["data.csv:1:", "'x' has unit 'deg'", "x[mm]"]),
    "other unit at a joint": (
        edited("joint_1[deg]", "joint_1[mm]"),
        ["'joint_1' has unit 'mm'", "joint_1[deg]"],
    ),
    "unit of a quaternion": (
        column("qw[mm],qx,qy,qz", ["1,0,0,0"]),
        ["data.csv:1:", "'qw'", "without a unit"],
    ),
    "broken header": (edited("x[mm]", "x[mm"), ["data.csv:1:", "'x[mm'", "name[unit]"]),
    "semicolons": (csv(4).replace(",", ";"), ["data.csv:1:", "commas"]),
    "comma at the end": (csv(4).replace("\n", ",\n"), ["data.csv:1:", "header ''"]),
    "same column twice": (edited("y[mm]", "x[m]"), ["data.csv:1:", "'x' appears twice", "remove one"]),
    "joint missing": (
        "\n".join(line[line.index(",") + 1 :] for line in LINES),
        ["data.csv:1:", "'joint_1'", "[deg]"],
    ),
    "no readings": (
        "\n".join(",".join(line.split(",")[:3]) for line in LINES),
        ["data.csv:1:", "x[mm],y[mm],z[mm]"],
    ),
    "point beside a position": (column("point", ["a", "b"]), ["data.csv:1:", "'point' does not go with"]),
    "row too short": ("\n".join([*LINES[:3], "1,2,3"]), ["data.csv:4:", "3 values", "6 columns"]),
    "row too long": (
        "\n".join([*LINES[:3], "1,2,3,4,5,6,7"]),
        ["data.csv:4:", "7 values", "6 columns", "point"],
    ),
    "stray quote": ("\n".join([*LINES[:3], '"1,2,3,4,5,6']), ["data.csv:4:", "1 values", "6 columns"]),
    **{
        f"cell {cell!r}": ("\n".join([*LINES[:3], f"# note\n1,2,3,4,{cell},6"]), ["data.csv:5:", "'y'", word])
        for cell, word in [
            *(("nan", "not a finite"), ("inf", "not a finite"), ("-Infinity", "not a finite")),
            *(("", "is empty"), (" ", "is empty"), ("high", "'high' is not"), ("1e999", "not a finite")),
            *(("1e12", "beyond"), ("1 2", "'1 2' is not"), ("0x10", "not a finite")),
        ]
    },
    "half a quaternion": (column("qw,qx", ["1,0"]), ["data.csv:1:", "qw, qx without 'qy'", QUATERNION]),
    "quaternion too long": (
        column(QUATERNION, ["1,0,0,0", "1,0,0,0.1"]),
        ["data.csv:3:", "norm is 1.005", "1"],
    ),
    "quaternion of zeros": (column(QUATERNION, ["0,0,0,0"]), ["data.csv:2:", "norm is 0"]),
    "endless quaternion": (column(QUATERNION, ["1e200,0,0,0"]), ["data.csv:2:", "norm is inf"]),
    "two rotations": (column(f"{QUATERNION},{ROTATION}", ["1,0,0,0,0,0,0"]), ["data.csv:1:", "keep one"]),
    "sigma zero": (column(SIGMA, ["1,1,1", "1,0,1"]), ["data.csv:3:", "'sigma_y'", "above zero"]),
    "sigma negative": (column(SIGMA, ["1,1,-1"]), ["data.csv:2:", "'sigma_z'", "above zero"]),
    "one sigma": (column("sigma_x[mm]", [1]), ["data.csv:1:", "sigma_x without 'sigma_y'"]),
    "sigma of no rotation": (
        column("sigma_rx[rad],sigma_ry[rad],sigma_rz[rad]", ["1,1,1"]),
        ["data.csv:1:", "'sigma_rx' does not go with"],
    ),
    "sigma of half a pose": (
        column(f"{ROTATION},{SIGMA}", ["0,0,0,1,1,1"]),
        ["data.csv:1:", "without 'sigma_rx'", "or none"],
    ),
    "wrong set": (column("set", ["fit", "train"]), ["data.csv:3:", "'set'", "'train'", "fit or holdout"]),
    "all held out": (column("set", ["holdout", "holdout"]), ["data.csv: every row is held out"]),
}


@pytest.mark.parametrize("case", DATA)
def test_wrong_measurements(refused, case):
    text, words = DATA[case]
    Path("data.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(words, *CALIBRATE, "--json", "-")
    if case != "all held out":
        refused(words, "validate", "arm.urdf", "data.csv", "--json", "r.json")


ARGUMENTS = {
    "no command": ([], ["COMMAND", "--help"]),
    "unknown command": (["calibrat"], ["'calibrat'", "calibrate", "--help"]),
    "unknown option": ([*CALIBRATE, "--speed", "9"], ["--speed", "--help"]),
    "no output": (["calibrate", "arm.dh.toml", "data.csv"], ["-o", "required", "dhcal calibrate --help"]),
    "no data": (["calibrate", "arm.dh.toml", "-o", "out.urdf"], ["DATA", "required"]),
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
    "nothing left": ([*CALIBRATE, "--holdout", "0.99"], ["every row is held out", "leave some rows"]),
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
    "convert URDF to URDF": (["convert", "arm.urdf", "two.urdf"], ["two.urdf", ".dh.toml", ".dh.csv"]),
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
def test_wrong_arguments(refused, case):
    args, words = ARGUMENTS[case]
    refused(words, *args)


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
def test_wrong_priors(refused, text, words):
    Path("priors.toml").write_text(text)
    refused(words, *CALIBRATE, "--priors", "priors.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a1 = 0.1\n", ["bounds.toml", "a1 = 0.1", "such as"]),
        ("a1 = [0.2, 0.1]\n", ["bounds.toml", "a1 = [0.2, 0.1]", "m or rad"]),
        ("a9 = [0.1, 0.2]\n", ["'a9'", "no such parameter", "a1"]),
        ("a1 = [5.0, 6.0]\n", ["'a1'", "must contain the nominal"]),
    ],
)
def test_wrong_bounds(refused, text, words):
    Path("bounds.toml").write_text(text)
    refused(words, *CALIBRATE, "--bounds", "bounds.toml")


def test_outputs_do_not_overwrite_what_else_is_read(refused):
    Path("held.csv").write_text(csv(5, 1))
    Path("out.calibration.toml").write_text("a1 = 0.1\n")
    refused(["held.csv: is an input"], *CALIBRATE, "--holdout", "held.csv", "--json", "held.csv")
    refused(["out.calibration.toml: is an input"], *CALIBRATE, "--priors", "out.calibration.toml")
    os.link("arm.urdf", "link.urdf")
    refused(["link.urdf: is an input"], "calibrate", "arm.urdf", "data.csv", "-o", "link.urdf")


@pytest.mark.parametrize("module", ["calibrate", "validate", "check"])
def test_a_wrong_robot_is_one_line_for_every_command(refused, module):
    Path("bad.dh.toml").write_text(Path("arm.dh.toml").read_text().replace('convention = "standard"', ""))
    Path("bad.urdf").write_text("<robot name='r'><link name='a'/>")
    for robot, word in (("bad.dh.toml", "convention"), ("bad.urdf", "bad.urdf:1: broken XML")):
        args = {
            "calibrate": ["calibrate", robot, "data.csv", "-o", "out.urdf"],
            "validate": ["validate", robot, "data.csv"],
            "check": ["check", robot],
        }
        refused([robot, word], *args[module])


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_forbidden_folder(refused, place):
    (place / "shut").mkdir(mode=0o500)
    refused(["shut/out.urdf", "Permission denied"], *CALIBRATE[:-1], "shut/out.urdf")


def test_a_full_disk_leaves_nothing(refused, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.mkstemp", full)
    refused(["out.urdf", "No space left"], *CALIBRATE, "--json", "r.json")


def test_warnings_wait_until_all_is_well(refused):
    Path("data.csv").write_text(csv(20, wrong=[3]))
    refused(["cannot free"], *CALIBRATE, "--free", "d9")


def test_an_interrupt_leaves_nothing(run, place, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    before = contents(place)
    monkeypatch.setattr(model_selection, "extend", stop)
    assert run(*CALIBRATE, "--json", "-") == (130, "", "dhcal: interrupted; nothing written\n")
    assert contents(place) == before


def test_too_much_is_one_line(refused, monkeypatch):
    def endless(*_):
        raise MemoryError

    monkeypatch.setattr(sampling, "joint_range", endless)
    refused(["not enough memory", "fewer"], "simulate", "arm.urdf", "-m", "1000000000000", "-o", "s.csv")


# --- calibrate and validate ------------------------------------------------------------------------


def test_the_json_of_a_calibration(run, place):
    out = done(
        run(*CALIBRATE, "--holdout", "0.25", "--json", "-", "--parameters", "dh", "--fix", "theta1,d2")
    )
    found = strict(out)
    assert found.keys() >= KEYS
    assert found["converged"] is True
    assert (found["samples"], found["samples_holdout"]) == (15, 5)
    assert found["parameters_total"] == 10
    assert found["rank"] <= 10
    assert found["outliers"] == []
    for key in ("before", "after", "holdout_before", "holdout_after"):
        assert found[key].keys() == {"position_rms_m", "position_max_m"}
    for row in found["parameters"]:
        assert row.keys() == {
            "name",
            "unit",
            "nominal",
            "value",
            "std",
            "observability",
            "posterior_to_prior_std",
            "fixed",
        }
        assert 0 <= row["observability"] <= 1
    nominal = {row["name"]: (row["nominal"], row["unit"]) for row in found["parameters"]}
    assert nominal == {
        **{f"theta{i}": (0.0, "rad") for i in (1, 2, 3)},
        **{f"d{i}": (d, "m") for i, d in ((1, 0.433), (2, 0.0), (3, 0.0))},
        **{f"a{i}": (a, "m") for i, a in ((1, 0.0), (2, 0.4), (3, 0.345))},
        **{f"alpha{i}": (alpha, "rad") for i, alpha in ((1, np.pi / 2), (2, 0.0), (3, 0.0))},
    }
    fixed = {row["name"]: (row["value"], row["std"]) for row in found["parameters"] if row["fixed"]}
    assert fixed == {"theta1": (0.0, 0.0), "d2": (0.0, 0.0)}
    assert any("alpha3" in text for text in found["unobservable"])
    assert found["files"] == {"urdf": "out.urdf", "sidecar": "out.calibration.toml"}
    assert found["inputs"] == {
        name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in ("arm.dh.toml", "data.csv")
    }
    assert found["versions"].keys() >= {"dhcal-pin", "pin", "numpy"}
    assert set(os.listdir(place)) == {*found["inputs"], *found["files"].values(), "arm.urdf"}


def test_before_is_the_error_that_the_formula_gives(run, place):
    found = strict(done(run(*CALIBRATE, "--json", "-")))
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    off = np.linalg.norm(tip(rows[:, :3]) - rows[:, 3:], axis=1) / 1e3
    assert found["before"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    assert found["before"]["position_max_m"] == pytest.approx(off.max(), rel=1e-9)
    assert found["after"]["position_rms_m"] < found["before"]["position_rms_m"]


def test_json_to_a_file_is_that_on_stdout(run, place):
    on_stdout = strict(done(run(*CALIBRATE, "--json", "-")))
    assert done(run(*CALIBRATE, "--json", place / "r.json")) == ""
    in_file = strict(Path("r.json").read_text())
    assert in_file.pop("files") == on_stdout.pop("files") | {"json": str(place / "r.json")}
    assert in_file == on_stdout


def test_too_few_measurements_are_no_nan(run, place):
    Path("data.csv").write_text(csv(1))
    for method in ("lm", "gn"):
        found = strict(done(run(*CALIBRATE, "--json", "-", "--method", method)))
        assert found["samples"] == 1
        assert found["rank"] == 3


def test_the_nominal_robot_is_never_touched(run, place):
    before = contents(place)
    done(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf"))
    after = contents(place)
    assert {name: after[name] for name in before} == before
    assert set(after) - set(before) == {"out.urdf", "out.calibration.toml"}


def test_in_place_is_a_word_of_its_own(run, place):
    before = Path("arm.urdf").read_bytes()
    done(run("calibrate", "arm.urdf", "data.csv", "-o", "arm.urdf", "--in-place"))
    assert Path("arm.urdf").read_bytes() != before
    assert Path("arm.calibration.toml").exists()
    done(run("calibrate", "arm.urdf", "data.csv", "-o", "arm.urdf", "--in-place"))


def test_an_existing_output_is_replaced_at_once(run, place):
    Path("out.urdf").write_text("old")
    with open("out.urdf") as reader:
        done(run(*CALIBRATE))
        assert reader.read() == "old"
    assert read_urdf("out.urdf").name == "arm"


def test_only_origins_change(run, place):
    done(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf"))
    trees = [ET.parse(name).getroot() for name in ("arm.urdf", "out.urdf")]
    assert ET.tostring(trees[0]) != ET.tostring(trees[1])
    for tree in trees:
        for origin in tree.findall("joint/origin"):
            origin.attrib.clear()
    assert ET.tostring(trees[0]) == ET.tostring(trees[1])


def test_a_sidecar_of_an_earlier_run_does_not_stay(run, place):
    """A table's base and tool are in the URDF; those that lie beside it would be read with it."""
    Path("out.calibration.toml").write_text("[base]\nxyz_m = [1.0, 0.0, 0.0]\n")
    found = strict(done(run(*CALIBRATE, "--json", "-")))
    again = strict(done(run("validate", "out.urdf", "data.csv", "--json", "-")))
    assert again["after"]["position_rms_m"] == pytest.approx(found["after"]["position_rms_m"], rel=1e-9)
    assert found["files"] == {"urdf": "out.urdf", "sidecar": "out.calibration.toml"}


def test_a_sidecar_is_an_input(run, place):
    Path("arm.calibration.toml").write_text("[base]\nxyz_m = [0.5, 0.0, 0.0]\n")
    found = strict(done(run("validate", "arm.urdf", "data.csv", "--json", "-")))
    assert set(found["inputs"]) == {"arm.urdf", "data.csv", "arm.calibration.toml"}
    assert found["after"]["position_rms_m"] == pytest.approx(0.5, abs=0.01)
    Path("other.toml").write_text("[base]\nxyz_m = [0.0, 0.0, 0.25]\n")
    args = ("validate", "arm.urdf", "data.csv", "--sidecar", "other.toml", "--json", "-")
    assert strict(done(run(*args)))["after"]["position_rms_m"] == pytest.approx(0.25, abs=0.01)


def test_the_json_of_a_validation(run, place):
    found = strict(done(run("validate", "arm.urdf", "data.csv", "--json", "-")))
    assert found.keys() >= KEYS
    assert found["samples"] == 20
    assert found["before"] == found["after"]
    assert found["parameters"] == []
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    off = np.linalg.norm(tip(rows[:, :3]) - rows[:, 3:], axis=1) / 1e3
    assert found["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)


def test_validate_finds_where_the_instrument_stands(run, place):
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    # The tracker is turned by 90° about z and stands two metres away.
    moved = np.stack([-rows[:, 4] + 2000, rows[:, 3], rows[:, 5] - 300], -1)
    np.savetxt("far.csv", np.concatenate([rows[:, :3], moved], 1), "%.9f", ",", header=HEADER, comments="")
    here = strict(done(run("validate", "arm.urdf", "data.csv", "--fit-frames", "--json", "-")))
    status, out, err = run("validate", "arm.urdf", "far.csv", "--fit-frames", "--json", "-")
    assert status == 0
    there = strict(out)
    assert there["before"]["position_rms_m"] > 1
    # Weak priors on the frames differ between the two places by less than this.
    assert there["after"]["position_rms_m"] == pytest.approx(here["after"]["position_rms_m"], rel=1e-4)
    assert "base and tool as given" in err


# --- what is fitted and what is held out -----------------------------------------------------------


def test_a_share_is_held_out_by_seed(run, place):
    def judged(seed, share="0.3"):
        return strict(done(run(*CALIBRATE, "--holdout", share, "--seed", seed, "--json", "-")))

    first = judged(1)
    assert (first["samples"], first["samples_holdout"]) == (14, 6)
    assert judged(1) == first
    assert judged(2)["holdout_before"] != first["holdout_before"]
    none = judged(1, "0")
    assert (none["samples"], none["samples_holdout"], none["holdout_after"]) == (20, 0, {})


def test_a_correction_that_nothing_warrants_is_pointed_out(run, place):
    """An arm that is as its model says gains nothing but noise; one that is wrong gets no such remark."""
    for truth, worse in ((), True), (("--truth", URDF / "sim_6dof_actual.dh.toml"), False):
        arm = URDF / "sim_6dof.dh.toml"
        done(run("simulate", arm, *truth, "-m", "30", "--noise", "0.1mm,0.01deg", "-o", "exact.csv"))
        _, _, err = run("calibrate", arm, "exact.csv", "-o", "found.urdf")
        *_, remark, _, last = err.splitlines()
        assert (
            "the calibrated robot is worse than the nominal one on 30 cross-validated samples"
            in remark.lower()
        ) is worse
        assert last.startswith("RMS position error on 30 cross-validated samples")


def test_validate_names_impossible_rows_and_counts_them(run, place):
    """Table 5 as printed: its rows 7 and 8 make 473 mm of 25.5 mm, and that is not left without a word."""
    table = str(URDF / "experiment_table5.csv")
    status, out, err = run("validate", URDF / "experiment.dh.toml", table, "--json", "-")
    rows = np.loadtxt(table, delimiter=",", comments=("#", "j"))
    off = np.linalg.norm(tip(rows[:, :3]) - rows[:, 3:6], axis=1) / 1e3
    found = strict(out)
    assert (status, found["samples"]) == (0, 8)
    assert found["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    assert [text.split(": ")[1] for text in found["warnings"]] == ["row 7", "row 8"]
    assert "warning: row 7: its joint positions lead 1095 mm away" in err
    assert run("validate", URDF / "experiment.dh.toml", table, "--fit-frames")[2].count("warning: row") == 0


def test_a_file_is_held_out(run, place):
    Path("held.csv").write_text(csv(7, 1))
    found = strict(done(run(*CALIBRATE, "--holdout", "held.csv", "--json", "-")))
    assert (found["samples"], found["samples_holdout"]) == (20, 7)
    assert set(found["inputs"]) == {"arm.dh.toml", "data.csv", "held.csv"}
    alone = strict(done(run("validate", "arm.urdf", "held.csv", "--json", "-")))
    assert found["holdout_before"]["position_rms_m"] == pytest.approx(
        alone["after"]["position_rms_m"], rel=1e-9
    )
    assert found["holdout_before"] != found["before"]


def test_the_set_column_holds_out(run, place):
    words = ["holdout" if row % 4 == 0 else "fit" for row in range(20)]
    Path("data.csv").write_text(column("set", words))
    found = strict(done(run(*CALIBRATE, "--json", "-")))
    assert (found["samples"], found["samples_holdout"]) == (15, 5)
    both = strict(done(run(*CALIBRATE, "--json", "-", "--holdout", "0.2")))
    assert (both["samples"], both["samples_holdout"]) == (12, 8)
    assert strict(done(run("validate", "arm.urdf", "data.csv", "--json", "-")))["samples"] == 20


def test_a_file_may_be_all_held_out_beside_another(run, place):
    Path("held.csv").write_text(column("set", ["holdout"] * 6))
    found = strict(done(run(*CALIBRATE[:3], "held.csv", *CALIBRATE[3:], "--json", "-")))
    assert (found["samples"], found["samples_holdout"]) == (20, 6)


def test_impossible_rows_of_one_file_stay_in_the_others(run, place):
    Path("one.csv").write_text(csv(12, 1, wrong=[3]))
    Path("two.csv").write_text(csv(10, 2, wrong=[5, 9]))
    Path("three.csv").write_text(csv(8, 3))
    status, out, err = run(
        *("calibrate", "arm.dh.toml", "one.csv", "two.csv", "three.csv", "-o", "out.urdf", "--json", "-")
    )
    found = strict(out)
    assert status == 0
    assert found["samples"] == (12 - 1) + (10 - 2) + 8
    assert found["outliers"] == [3, 5, 9]
    assert found["outliers_by_file"] == {"one.csv": [3], "two.csv": [5, 9]}
    assert found["before"]["position_max_m"] < 0.01
    for text in ("one.csv: row 3", "two.csv: row 5", "two.csv: row 9"):
        assert f"{text} is excluded" in err


def test_impossible_rows_of_a_held_out_file_are_named(run, place):
    Path("held.csv").write_text(csv(9, 1, wrong=[4]))
    found = strict(done(run(*CALIBRATE, "--holdout", "held.csv", "--json", "-")))
    assert (found["samples"], found["samples_holdout"], found["outliers"]) == (20, 8, [4])


def test_poses_and_positions_go_together(run, place):
    sim = URDF / "sim_6dof.dh.toml"
    for kind, seed in (("pose", 1), ("position", 2)):
        args = ("--truth", URDF / "sim_6dof_actual.dh.toml", "-m", "15", "--kind", kind, "--seed", seed)
        done(run("simulate", sim, *args, "-o", f"{kind}.csv"))
    args = ("calibrate", sim, "pose.csv", "position.csv", "-o", "out.urdf", "--priors", "none", "--json", "-")
    found = strict(done(run(*args)))
    assert found["samples"] == 30
    assert found["after"].keys() == ACCURACY
    assert found["after"]["position_rms_m"] < 1e-9
    assert found["after"]["orientation_rms_rad"] < 1e-9


# --- simulate, calibrate, validate -----------------------------------------------------------------


def test_a_wrong_arm_is_found_without_noise(run, place):
    sim, actual = URDF / "sim_6dof.dh.toml", URDF / "sim_6dof_actual.dh.toml"
    done(run("simulate", sim, "--truth", actual, "-m", "20", "-o", "fit.csv"))
    done(run("simulate", sim, "--truth", actual, "-m", "30", "--seed", "7", "-o", "other.csv"))
    found = strict(done(run("calibrate", sim, "fit.csv", "-o", "o.urdf", "--priors", "none", "--json", "-")))
    assert found["after"]["position_rms_m"] < 1e-9
    assert found["before"]["position_rms_m"] > 1e-2
    other = strict(done(run("validate", "o.urdf", "other.csv", "--json", "-")))
    assert other["after"]["position_rms_m"] < 1e-9
    assert other["after"]["orientation_rms_rad"] < 1e-9
    truth = read_dh(actual)
    values = {row["name"]: row["value"] for row in found["parameters"]}
    for key in ("theta", "d", "a", "alpha"):
        np.testing.assert_allclose([values[f"{key}{i}"] for i in range(1, 7)], getattr(truth, key), atol=1e-8)


def test_the_same_seed_gives_the_same_bytes(run, place):
    args = ("simulate", "arm.urdf", "-m", "6", "--noise", "0.1mm,0.01deg")
    for name, seed in (("a.csv", 3), ("b.csv", 3), ("c.csv", 4)):
        done(run(*args, "--seed", seed, "-o", name))
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()
    assert Path("a.csv").read_text().splitlines()[2:] != Path("c.csv").read_text().splitlines()[2:]


def test_simulated_positions_are_the_formula_s(run, place):
    done(run("simulate", "arm.urdf", "-m", "50", "--kind", "position", "-o", "s.csv"))
    readings = read_measurement_file("s.csv", Chain.from_urdf("arm.urdf")).data
    np.testing.assert_allclose(readings.positions() * 1e3, tip(np.degrees(readings.q)), atol=1e-10)


def test_simulated_noise_has_the_size_asked_for(run, place):
    done(run("simulate", "arm.urdf", "-m", "3000", "--noise", "0.2mm,1mrad", "-o", "s.csv"))
    readings = read_measurement_file("s.csv", Chain.from_urdf("arm.urdf")).data
    off = readings.positions() * 1e3 - tip(np.degrees(readings.q))
    np.testing.assert_allclose(off.std(0), 0.2, rtol=0.05)
    assert readings.has_stated_sigma
    errors = readings.errors(Chain.from_urdf("arm.urdf").forward_kinematics(readings.q), np.empty(0))[
        "orientation"
    ]
    np.testing.assert_allclose(errors.std(0), 1e-3, rtol=0.05)


@pytest.mark.parametrize(
    ("lower", "upper"), [(-30.0, 45.0), (190.0, 300.0), (-400.0, -200.0), (-10.0, 600.0)]
)
def test_simulated_joints_keep_their_limits(run, place, lower, upper):
    table = Path("arm.dh.toml").read_text()
    first = table.index("[[joint]]", table.index("[[joint]]") + 1)
    Path("tight.dh.toml").write_text(f"{table[:first]}lower = {lower}\nupper = {upper}\n{table[first:]}")
    done(run("simulate", "tight.dh.toml", "-m", "200", "-o", "s.csv"))
    q = np.degrees(read_measurement_file("s.csv", read_robot("tight.dh.toml")).data.q)
    assert lower <= q[:, 0].min() < q[:, 0].max() <= upper
    assert np.ptp(q[:, 0]) > 0.5 * min(upper - lower, 180)
    assert np.abs(q[:, 1:]).max() <= 180


# --- convert ---------------------------------------------------------------------------------------


def poses_agree(a, b, atol=1e-12):
    one, two = read_robot(a), read_robot(b)
    q = np.random.default_rng(0).uniform(-3, 3, (50, one.n_joints))
    np.testing.assert_allclose(one.poses(q), two.poses(q), atol=atol)


@pytest.mark.parametrize("name", ["sim_6dof_actual", "experiment_published"])
def test_a_table_through_all_formats_is_the_same(run, place, name):
    start = URDF / f"{name}.dh.toml"
    way = [start, "a.dh.csv", "b.dh.toml", "c.urdf", "d.dh.csv", "e.urdf", "f.dh.toml"]
    for source, target in itertools.pairwise(way):
        done(run("convert", source, target))
        poses_agree(start, target)
    table = read_dh(start)
    for target in way[1:3]:
        again = read_dh(target)
        for key in ("theta", "d", "a", "alpha"):
            assert getattr(again, key).tolist() == getattr(table, key).tolist()
    for target in ("d.dh.csv", "f.dh.toml"):
        again = read_dh(target)
        for key in ("theta", "d", "a", "alpha"):
            np.testing.assert_allclose(getattr(again, key), getattr(table, key), atol=1e-12)


def test_base_and_tool_survive(run, place):
    turned = Path("arm.dh.toml").read_text().replace(
        "[units]",
        "base = {xyz_m = [0.1, 0.2, 0.3], rotvec_rad = [0.4, -0.5, 0.6]}\n"
        "tool = {xyz_m = [0.01, -0.02, 0.03], rotvec_rad = [0.0, 2.0, 1.0]}\n[units]",
    )  # fmt: skip
    Path("turned.dh.toml").write_text(turned)
    way = ["turned.dh.toml", "t.urdf", "u.dh.csv", "v.dh.toml", "w.urdf", "x.dh.toml", "y.dh.csv"]
    for source, target in itertools.pairwise(way):
        done(run("convert", source, target))
        poses_agree("turned.dh.toml", target)
    np.testing.assert_allclose(
        read_dh("u.dh.csv").poses(np.zeros((1, 3))), read_dh("y.dh.csv").poses(np.zeros((1, 3)))
    )


@pytest.mark.parametrize("target", ["m.dh.toml", "m.dh.csv"])
@pytest.mark.parametrize("source", ["arm.dh.toml", "arm.urdf"])
def test_another_convention(run, place, source, target):
    done(run("convert", source, target, "--convention", "modified"))
    assert read_dh(target).convention == "modified"
    poses_agree("arm.urdf", target)
    done(run("convert", target, "s.dh.toml", "--convention", "standard"))
    assert read_dh("s.dh.toml").convention == "standard"
    poses_agree("arm.urdf", "s.dh.toml")


def test_a_convention_that_is_there_already_changes_nothing(run, place):
    table = read_dh("arm.dh.toml")
    done(run("convert", "arm.dh.toml", "s.dh.csv", "--convention", "standard"))
    assert read_dh("s.dh.csv").alpha.tolist() == table.alpha.tolist()


def test_a_sidecar_beside_the_new_urdf_is_pointed_out(run, place):
    Path("new.calibration.toml").write_text("[base]\nxyz_m = [1.0, 0.0, 0.0]\n")
    assert "note: new.calibration.toml" in run("convert", "arm.dh.toml", "new.urdf")[2]
    assert re.search(r"note: .*new\.calibration\.toml", run("convert", "new.urdf", "new.dh.csv")[2])


# --- check, demo -----------------------------------------------------------------------------------


def test_check_agrees(run, place):
    status, out, _ = run("check", URDF / "sim_6dof.dh.toml", "--json", "-")
    found = strict(out)
    assert (status, found["agree"]) == (0, True)
    assert len(found["routes"]) == 6
    assert all(route["agrees"] and route["difference"] <= route["tolerance"] for route in found["routes"])


def test_check_finds_the_misprint_of_15(run, place, monkeypatch):
    """k1 as printed has sine and cosine of alpha in each other's place, with the wrong sign."""

    def printed(table, q):
        right = factors.error_factors(table, q)
        n = table.n_joints
        s, c, a = np.sin(table.alpha), np.cos(table.alpha), table.a
        gap = np.stack([0 * a, a * (s - c), a * (s - c)], -1)
        for i in range(n):
            tail = np.eye(4)
            for link in table.rows(q).transpose(1, 0, 2, 3)[i + 1 :]:
                tail = tail @ link
            right[:, :3, i] += np.einsum(
                "...ji,j->...i", np.broadcast_to(tail, (len(q), 4, 4))[:, :3, :3], gap[i]
            )
        return right

    monkeypatch.setattr(jacobian_check, "error_factors", printed)
    status, out, err = run("check", URDF / "sim_6dof.dh.toml", "--json", "-")
    found = strict(out)
    assert (status, found["agree"]) == (1, False)
    assert not any(route["agrees"] for route in found["routes"] if route["columns"])
    assert "DISAGREES" in err


def test_demo(run, place, monkeypatch):
    whole = simulations.simulation_rows
    monkeypatch.setattr(simulations, "simulation_rows", lambda: whole(seeds=2))
    opened = []
    monkeypatch.setattr(console, "open_page", opened.append)
    assert strict(done(run("demo", "--out", "shown", "--json", "-", "--open")))["outliers"] == [7, 8]
    # Of all that it writes the report is what explains itself, and it holds the scene.
    assert opened == [os.path.join("shown", "report.html")]
    assert Path(opened[0]).read_text().count("application/json") == 1
    assert sorted(os.listdir("shown")) == [
        *("experiment.urdf", "experiment_calibrated.urdf", "report.html"),
        *("result.json", "scene.html", "summary.md"),
    ]
    found = strict(Path("shown/result.json").read_text())
    assert found.keys() >= KEYS
    assert found["outliers"] == [7, 8]
    assert found["samples"] == 6
    assert set(found["inputs"]) == {"experiment.dh.toml", "experiment_table5.csv"}
    # Table 5 without its two corrupt rows, against the plane two-link formula.
    rows = np.loadtxt(URDF / "experiment_table5.csv", delimiter=",", comments=("#", "j"))[:6]
    off = np.linalg.norm(tip(rows[:, :3]) - rows[:, 3:6], axis=1) / 1e3
    assert found["before"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    summary = Path("shown/summary.md").read_text()
    assert "Row 7 of Table 5 is excluded" in summary
    assert f"{1e3 * found['after']['position_rms_m']:.3f}" in summary
    assert "21→24/24" in summary
    assert "except alpha3" in summary
    left_out, other = found["comparisons"][0]["after"], found["experiment_m"]["least_squares_left_out"]
    assert left_out["position_rms_m"] == pytest.approx(other, rel=1e-3)
    poses_agree("shown/experiment.urdf", URDF / "experiment.dh.toml")


# --- the command itself ----------------------------------------------------------------------------

COMMANDS = tuple(command.name for command in main.COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example_that_parses(run, name):
    status, out, err = run(name, "--help")
    assert (status, err) == (0, "")
    example = out.split("example:\n")[1].strip()
    args = main.build_parser().parse_args(example.split()[1:])
    assert args.command == name


def test_help_and_version(run):
    status, out, _ = run("--help")
    assert status == 0
    assert {line.split()[0] for line in out.splitlines() if re.match(r"    \w", line)} == set(COMMANDS)
    assert run("--version")[1].startswith("dhcal 0.")


@pytest.mark.parametrize("args", [["--help"], ["calibrate"], ["calibrate", "--seed", "x"], ["--version"]])
def test_help_and_argument_errors_load_nothing_heavy(args):
    script = (
        "import sys\n"
        "from dhcal_pin.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "print(*sorted({'numpy', 'scipy', 'pinocchio', 'rich'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script, *args], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == ""


def test_the_installed_command(place):
    command = [Path(sys.executable).with_name("dhcal"), *CALIBRATE, "--json", "-"]
    good = subprocess.run(command, capture_output=True, text=True, check=False)
    assert good.returncode == 0
    assert strict(good.stdout)["samples"] == 20
    assert "wrote urdf: out.urdf" in good.stderr
    command[3] = "no.csv"
    bad = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (bad.returncode, bad.stdout) == (2, "")
    assert bad.stderr.count("\n") == 1
    assert "no.csv" in bad.stderr


def test_unknowns_that_cannot_take_up_what_was_measured_are_told(run, tmp_path, monkeypatch):
    """Parallel axes 2 and 3, tilted by a milliradian: modified DH needs metres of offset for that."""
    monkeypatch.chdir(tmp_path)
    rows = [
        (0, 675, 0, 180),
        (0, 0, 350, 90),
        (-90, 0, 1150, 0),
        (0, -1000, -41, 90),
        (0, 0, 0, -90),
        (0, -240, 0, 90),
    ]
    keys = ("theta", "d", "a", "alpha")
    joints = [
        f'[[joint]]\nname = "A{i}"\ntype = "revolute"\n'
        + "".join(f"{k} = {v}.0\n" for k, v in zip(keys, row, strict=True))
        for i, row in enumerate(rows, 1)
    ]
    Path("arm.dh.toml").write_text(
        'convention = "modified"\n[units]\nlength = "mm"\nangle = "deg"\n' + "".join(joints)
    )
    rng = np.random.default_rng(0)
    arm = Chain.from_dh(read_dh("arm.dh.toml"))
    q = rng.uniform(-2, 2, (40, 6))
    pose = np.tile(np.eye(4), (40, 1, 1))
    for i, (theta, d, a, alpha) in enumerate(rows):
        tilt = Rotation.from_rotvec([0, 2e-3, 0] if i == 2 else [0, 0, 0]).as_matrix()
        fixed = Rotation.from_euler("x", alpha, degrees=True).as_matrix()
        spun = Rotation.from_rotvec((q[:, i, None] + np.deg2rad(theta)) * [0, 0, 1]).as_matrix()
        step = np.tile(np.eye(4), (40, 1, 1))
        step[:, :3, :3] = fixed @ tilt @ spun
        step[:, :3, 3] = [a * 1e-3, 0, 0] + step[:, :3, 2] * d * 1e-3
        pose = pose @ step
    point = pose[:, :3, 3] + 0.1 * pose[:, :3, 0] + [3, 1, 0] + rng.normal(0, 1e-4, (40, 3))
    Path("data.csv").write_text(measurement_text(Position(q, point), arm))
    for sets, told in (
        ("modified-dh,base,tool", True),
        ("minimal,base,tool", False),
        ("base,tool", False),
    ):
        status, _, err = run("calibrate", "arm.dh.toml", "data.csv", "--parameters", sets, "-o", "out.urdf")
        assert status == 0
        assert ("arm.dh.toml: warning: --parameters minimal,base,tool reduces" in err) == told
    # Priors of parameters that the wider set does not have are no error of the user.
    Path("priors.toml").write_text('"theta*" = 0.01\n"base.*" = 2.0\n')
    sets = ("--parameters", "modified-dh,base,tool", "--priors", "priors.toml")
    status, _, err = run("calibrate", "arm.dh.toml", "data.csv", *sets, "-o", "out.urdf")
    assert status == 0, err
    assert "arm.dh.toml: warning: --parameters minimal,base,tool reduces" in err
