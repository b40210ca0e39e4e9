"""Measurements of a small robot, and helpers for tests of the command line."""

import json
import re
import unicodedata
from pathlib import Path

import numpy as np

from dhcal_pin.io import read_robot

KEYS = {
    *("converged", "iterations", "samples", "samples_holdout", "rank", "parameters_total", "condition"),
    *("before", "after", "holdout_before", "holdout_after", "parameters", "unobservable", "outliers"),
    *("cross_validated_before", "cross_validated_after", "holdout_region_before", "holdout_region_after"),
    *("files", "versions", "inputs"),
}
ACCURACY = {"position_rms_m", "position_max_m", "orientation_rms_rad"}
HEADER = "joint_1[deg],joint_2[deg],joint_3[deg],x[mm],y[mm],z[mm]"
# Command that the folder of the fixture `robot_folder` is made for.
CALIBRATE = ("calibrate", "arm.dh.toml", "data.csv", "-o", "out.urdf")
# Column map of a file of another maker, with the same columns under other names.
COLUMN_MAP = """
[joints]
order = ["A1", "A2", "A3"]
unit = "deg"
[columns]
x = {from = "X", unit = "mm"}
y = {from = "Y", unit = "mm"}
z = {from = "Z", unit = "mm"}
"""
# Height of the shoulder and lengths of the links [mm]: of the paper's robot as designed, and of the robot
# with errors that is measured here.
DESIGNED, ACTUAL = (433, 400, 345), (436, 403, 343)


def assert_harmless(text):
    """Require a text without characters that a terminal acts on, but the ends of lines."""
    assert {unicodedata.category(char) for char in text} & {"Cf", "Cs", "Zl", "Zp"} == set(), text
    assert {char for char in text if unicodedata.category(char) == "Cc"} <= {"\n"}, text


def unfolded(screen):
    """Text of a screen without line breaks, to look for a sentence."""
    return " ".join(screen.split())


def tool_positions(degrees, lengths=DESIGNED):
    """Tool positions [mm] of a robot with a vertical axis and two links in a plane."""
    q1, q2, q3 = np.radians(degrees).T
    height, upper, fore = lengths
    out = upper * np.cos(q2) + fore * np.cos(q2 + q3)
    up = height + upper * np.sin(q2) + fore * np.sin(q2 + q3)
    return np.stack([out * np.cos(q1), out * np.sin(q1), up], -1)


def positions_csv(count, seed=0, wrong=(), error=1.0):
    """Positions of the robot with errors, with noise of `error` mm; some rows (from 1) are off by 1 m."""
    rng = np.random.default_rng(seed)
    degrees = rng.uniform(-80, 80, (count, 3))
    positions = tool_positions(degrees, ACTUAL) + error * rng.normal(size=(count, 3))
    positions[[row - 1 for row in wrong]] += 1000
    rows = np.concatenate([degrees, positions], 1).tolist()
    return "\n".join([HEADER, *(",".join(map(repr, row)) for row in rows)]) + "\n"


def folder_contents(folder):
    """Content of each file of a folder and its subfolders, by name."""
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def rows_of(path):
    lines = [line for line in Path(path).read_text().splitlines() if not line.startswith("#")]
    return [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]


def parse_json(text):
    """Parse JSON; NaN and infinity, which are not part of JSON, are errors."""

    def refuse(name):
        raise AssertionError(f"{name} in JSON")

    return json.loads(text, parse_constant=refuse)


def assert_shows(text, lines):
    """Assert that a page shows lines of a program; numbers may differ, and … stands for any text."""
    number = re.compile(r"\d+(\.\d+)?(e[-+]?\d+)?")
    shown = [re.escape(number.sub("#", line)).replace("…", ".*") for line in text.splitlines()]
    assert len(shown) == len(lines)
    for pattern, line in zip(shown, lines, strict=True):
        assert re.fullmatch(pattern, number.sub("#", line))


def stdout_of(result):
    """Standard output of a command that must succeed."""
    status, out, err = result
    assert status == 0, err
    return out


def stderr_of(result):
    """Standard error of a command that must succeed."""
    status, _, err = result
    assert status == 0, err
    return err


def error_of(result):
    """Message of a command that must refuse its input: one line, and nothing on standard output."""
    status, out, err = result
    assert (status, out, err.count("\n")) == (2, "", 1), err
    return err


def json_of(result):
    """JSON on standard output of a command that must succeed."""
    return parse_json(stdout_of(result))


def edited_csv(old, new, count=1):
    """A measurement file in which a text is replaced."""
    text = positions_csv(4)
    assert old in text
    return text.replace(old, new, count)


def with_column(name, values):
    """A measurement file with one more column, or several in one text."""
    head, *rows = positions_csv(len(values)).splitlines()
    return "\n".join([f"{head},{name}", *(f"{row},{value}" for row, value in zip(rows, values, strict=True))])


def ur_kinematics(values):
    """A UR kinematics file with these six values of each joint."""
    pairs = list(zip("x y z roll pitch yaw".split(), values, strict=True))
    lines = ["kinematics:"]
    for name in ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"):
        lines += [f"  {name}:", *(f"    {key}: {value}" for key, value in pairs)]
    return "\n".join([*lines, "  hash: calib_1", ""])


def assert_same_poses(a, b, atol=1e-12):
    """Assert that two robot files describe the same robot."""
    one, two = read_robot(a), read_robot(b)
    q = np.random.default_rng(0).uniform(-3, 3, (50, one.n_joints))
    np.testing.assert_allclose(one.poses(q), two.poses(q), atol=atol)
