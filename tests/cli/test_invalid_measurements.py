"""Invalid measurement files: one line that names file, line and column."""

from pathlib import Path

import pytest
from command_line import CALIBRATE, HEADER, edited_csv, positions_csv, with_column

LINES = positions_csv(4).splitlines()


QUATERNION = "qw,qx,qy,qz"


ROTATION = "rx[rad],ry[rad],rz[rad]"


SIGMA = "sigma_x[mm],sigma_y[mm],sigma_z[mm]"


DATA = {
    "empty": ("", ["data.csv: is empty", "x[mm]"]),
    "only comments": ("# nothing\n\n", ["data.csv: is empty"]),
    "a web page": (
        "\n<!DOCTYPE html>\n<html></html>\n",
        ["data.csv:2: is HTML, not a table; expected", "x[mm]"],
    ),
    "a robot": ("<?xml version='1.0'?>\n<robot/>\n", ["data.csv:1: is XML, not a table"]),
    "a result": ('{\n  "verdict": {},\n  "samples": 9\n}\n', ["data.csv:1: is JSON, not a table"]),
    "a list": ('[{"x": 1},\n {"x": 2}]\n', ["data.csv:1: is JSON, not a table"]),
    "a sidecar": ("# base and tool\n[base]\nxyz_m = [0, 0, 0]\n", ["data.csv:2: is TOML, not a table"]),
    "a DH file": ('convention = "standard"\n[units]\nlength = "mm"\n', ["data.csv:1: is TOML, not a table"]),
    "titles in brackets": (
        "[General]\nname = x\n" + positions_csv(4),
        ["data.csv:1: no names of columns in this line; they seem to be in line 3"],
    ),
    "header only": (HEADER + "\n", ["data.csv: no rows", "line 1"]),
    "UTF-16": (
        b"\xff\xfe" + positions_csv(4).encode("utf-16-le"),
        ["data.csv:1: the file is UTF-16, not UTF-8; save the file as UTF-8"],
    ),
    "UTF-16 without a mark": (
        positions_csv(4).encode("utf-16-le"),
        ["data.csv:1: a zero byte, as in UTF-16; save the file as UTF-8"],
    ),
    "zero byte": (
        positions_csv(4).encode() + b"\0\n",
        ["data.csv:6: a zero byte, as in UTF-16; save the file as UTF-8"],
    ),
    "Latin-1": (
        positions_csv(4).encode() + b"# 20 \xb0C\n20 \xb0C\n",
        ["data.csv:7: byte 0xb0 is not UTF-8; save the file as UTF-8"],
    ),
    "unknown column": (
        with_column("weather", [1, 2]),
        ["data.csv:1:", "'weather'", "remove it", "joint_1"],
    ),
    "mistyped": (edited_csv("joint_2[", "joint_two["), ["data.csv:1:", "did you mean 'joint_2'?"]),
    "a joint too many": (with_column("joint_4[deg]", [1, 2]), ["data.csv:1:", "'joint_4'", "remove it"]),
    "no header": ("\n".join(LINES[1:]) + "\n", ["data.csv:1: numbers where the header must be", "x[mm]"]),
    "underscore": (
        with_column("sigma_x[mm],sigma_y[mm],sigma_z[mm]", ["1,1,1", "1,1,1_0"]),
        ["data.csv:3:", "'sigma_z'", "'1_0' is not a finite number"],
    ),
    "near miss": (edited_csv("joint_2[", "joint2["), ["data.csv:1:", "'joint2'", "did you mean 'joint_2'?"]),
    "foreign joint": (edited_csv("joint_2[", "wrist_yaw["), ["data.csv:1:", "'wrist_yaw'", "joint_2"]),
    "no unit": (edited_csv("x[mm]", "x"), ["data.csv:1:", "'x' has no unit", "x[mm]"]),
    "no units": (
        edited_csv("x[mm],y[mm],z[mm]", "x,y,z[mm]"),
        ["data.csv:1:", "'x' has no unit", "x[mm]", "without a unit, too: 'y'"],
    ),
    "empty unit": (edited_csv("x[mm]", "x[]"), ["data.csv:1:", "'x' has no unit", "x[mm]"]),
    "unknown unit": (edited_csv("x[mm]", "x[inch]"), ["data.csv:1:", "'x' has unit 'inch'", "x[mm]"]),
    "other unit": (edited_csv("x[mm]", "x[deg]"), ["data.csv:1:", "'x' has unit 'deg'", "x[mm]"]),
    "other unit at a joint": (
        edited_csv("joint_1[deg]", "joint_1[mm]"),
        ["'joint_1' has unit 'mm'", "joint_1[deg]"],
    ),
    "unit of a quaternion": (
        with_column("qw[mm],qx,qy,qz", ["1,0,0,0"]),
        ["data.csv:1:", "'qw'", "without a unit"],
    ),
    "broken header": (edited_csv("x[mm]", "x[mm"), ["data.csv:1:", "'x[mm'", "name[unit]"]),
    "same column twice": (edited_csv("y[mm]", "x[m]"), ["data.csv:1:", "'x' appears twice", "remove one"]),
    "joint missing": (
        "\n".join(line[line.index(",") + 1 :] for line in LINES),
        ["data.csv:1:", "'joint_1'", "[deg]"],
    ),
    "no readings": (
        "\n".join(",".join(line.split(",")[:3]) for line in LINES),
        ["data.csv:1:", "x[mm],y[mm],z[mm]"],
    ),
    "point beside a position": (
        with_column("point", ["a", "b"]),
        ["data.csv:1:", "'point' does not go with"],
    ),
    "half a pair of points": (
        "joint_1[deg],joint_2[deg],joint_3[deg],point_b,distance[mm]\n1,2,3,a,100\n",
        [
            "data.csv:1:",
            "'point_b' does not go with distance",
            "one of kind point_distance needs point_a, too",
        ],
    ),
    "row too short": ("\n".join([*LINES[:3], "1,2,3"]), ["data.csv:4:", "3 values", "6 columns"]),
    "row too long": (
        "\n".join([*LINES[:3], "1,2,3,4,5,6,7"]),
        ["data.csv:4:", "7 values", "6 columns", "point"],
    ),
    "stray quote": ("\n".join([*LINES[:3], '"1,2,3,4,5,6']), ["data.csv:4:", "1 value for", "6 columns"]),
    **{
        f"cell {cell!r}": ("\n".join([*LINES[:3], f"# note\n1,2,3,4,{cell},6"]), ["data.csv:5:", "'y'", word])
        for cell, word in [
            *(("nan", "not a finite"), ("inf", "not a finite"), ("-Infinity", "not a finite")),
            *(("", "is empty"), (" ", "is empty"), ("high", "'high' is not"), ("1e999", "not a finite")),
            *(("1e12", "beyond"), ("1 2", "'1 2' is not"), ("0x10", "not a finite")),
        ]
    },
    "half a quaternion": (
        with_column("qw,qx", ["1,0"]),
        ["data.csv:1:", "qw, qx without 'qy'", QUATERNION],
    ),
    "quaternion too long": (
        with_column(QUATERNION, ["1,0,0,0", "1,0,0,0.1"]),
        ["data.csv:3:", "norm is 1.005", "1"],
    ),
    "quaternion of zeros": (with_column(QUATERNION, ["0,0,0,0"]), ["data.csv:2:", "norm is 0"]),
    "endless quaternion": (with_column(QUATERNION, ["1e200,0,0,0"]), ["data.csv:2:", "norm is inf"]),
    "two rotations": (
        with_column(f"{QUATERNION},{ROTATION}", ["1,0,0,0,0,0,0"]),
        ["data.csv:1:", "keep one"],
    ),
    "sigma zero": (with_column(SIGMA, ["1,1,1", "1,0,1"]), ["data.csv:3:", "'sigma_y'", "above zero"]),
    "sigma negative": (with_column(SIGMA, ["1,1,-1"]), ["data.csv:2:", "'sigma_z'", "above zero"]),
    "one sigma": (with_column("sigma_x[mm]", [1]), ["data.csv:1:", "sigma_x without 'sigma_y'"]),
    "sigma of no rotation": (
        with_column("sigma_rx[rad],sigma_ry[rad],sigma_rz[rad]", ["1,1,1"]),
        ["data.csv:1:", "'sigma_rx' does not go with"],
    ),
    "sigma of half a pose": (
        with_column(f"{ROTATION},{SIGMA}", ["0,0,0,1,1,1"]),
        ["data.csv:1:", "without 'sigma_rx'", "or none"],
    ),
    "wrong set": (
        with_column("set", ["fit", "train"]),
        ["data.csv:3:", "'set'", "'train'", "fit or holdout"],
    ),
    "all held out": (with_column("set", ["holdout", "holdout"]), ["data.csv: every row is held out"]),
}


@pytest.mark.parametrize("case", DATA)
def test_invalid_measurements_are_refused(assert_refused, case):
    text, words = DATA[case]
    Path("data.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert_refused(words, *CALIBRATE, "--json", "-")
    if case != "all held out":
        assert_refused(words, "validate", "arm.urdf", "data.csv", "--json", "r.json")
