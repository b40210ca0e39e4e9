"""Joint positions and measured values over time, in two tables, become one measurement per stop."""

import numpy as np
import pytest
from command_line import error_of, stderr_of
from robots import nominal_arm

from dhcal_pin import se3
from dhcal_pin.io import read_measurements
from dhcal_pin.measurements import Pose, Position

COUNT, JOINT_STEP, POSE_STEP = 12, 0.008, 0.01
MAP = """[columns]
time = {from = "Time (Seconds)", unit = "s"}
x = {from = "X", unit = "mm"}
y = {from = "Y", unit = "mm"}
z = {from = "Z", unit = "mm"}
"""


def motion(seed=0):
    """Return configurations, and the times and joint positions of an arm that stops at each of them."""
    rng = np.random.default_rng(seed)
    stops = rng.uniform(-2, 2, (COUNT, 6))
    corners, values, now = [], [], 0.0
    for q in stops:
        for duration in (rng.uniform(1.0, 1.8), rng.uniform(0.8, 1.6)):
            corners.append(now)
            values.append(q)
            now += duration
    times = np.arange(0.0, corners[-1], JOINT_STEP)
    q = np.stack([np.interp(times, corners, column) for column in np.transpose(values)], 1)
    return stops, times, q


def write(path, headers, columns, separator=","):
    """Write a table; cells that are no number are empty."""
    rows = [["" if np.isnan(cell) else f"{cell:.6f}" for cell in row] for row in np.column_stack(columns)]
    path.write_text("\n".join(separator.join(row) for row in [headers, *rows]) + "\n")


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def record(place, offset=0.0, start=0.0, kind: type = Position, joint_start=0.0):
    """Write joints.csv and poses.csv with a clock of its own; return the stops and the arm."""
    arm, (stops, times, q) = nominal_arm("ur10"), motion()
    names = [f"{name}[deg]" for name in arm.joint_names]
    write(place / "joints.csv", ["time[s]", *names], (joint_start + times, np.rad2deg(q)))
    pose_times = np.arange(0.0, times[-1], POSE_STEP)
    poses = arm.poses(np.stack([np.interp(pose_times, times, column) for column in q.T], 1))
    rng = np.random.default_rng(1)
    xyz = 1e3 * (poses[:, :3, 3] + 2e-5 * rng.standard_normal((len(pose_times), 3)))
    shown = start + pose_times + offset
    if kind is Position:
        # The instrument loses its target now and then.
        xyz[rng.random(len(xyz)) < 0.02] = np.nan
        write(place / "poses.csv", ["Time (Seconds)", "X", "Y", "Z"], (shown, xyz), ";")
    else:
        quaternion = se3.rotvec_to_quaternion(se3.log3(poses[:, :3, :3]))
        headers = ["time[ms]", "x[mm]", "y[mm]", "z[mm]", "qw", "qx", "qy", "qz"]
        write(place / "poses.csv", headers, (1e3 * shown, xyz, quaternion))
    (place / "map.toml").write_text(MAP)
    return stops, arm


CONVERT = "convert joints.csv data.csv --poses poses.csv --columns map.toml --robot example:ur10".split()


@pytest.mark.parametrize(("offset", "start"), [(0.0, 0.0), (0.35, 0.0), (-3.2, 1.7e9), (0.2, -1.7e9)])
def test_stops_of_two_tables_are_joined(place, run, offset, start):
    """The tables share a clock, or differ by seconds, or have no time in common."""
    stops, arm = record(place, offset, max(start, 0.0), joint_start=max(start, -start))
    said = stderr_of(run(*CONVERT))
    data = read_measurements("data.csv", arm)
    assert isinstance(data, Position)
    np.testing.assert_allclose(data.q, stops, atol=1e-6)
    np.testing.assert_allclose(data.positions(), arm.poses(stops)[:, :3, 3], atol=3e-5)
    assert ("have no time in common" in said) == (start < 0)
    assert "rows left out, the first in line" in said
    found = float(said.partition("the clock of poses.csv is ")[2].partition(" s off")[0])
    assert found == pytest.approx(offset if start >= 0 else 0.0, abs=0.03)


def test_poses_are_joined_with_their_rotations(place, run):
    stops, arm = record(place, 0.1, kind=Pose)
    run(*[word for word in CONVERT if word not in ("--columns", "map.toml")])
    data = read_measurements("data.csv", arm)
    assert isinstance(data, Pose)
    np.testing.assert_allclose(data.q, stops, atol=1e-6)
    turns = se3.log3(data.rotations() @ np.swapaxes(arm.poses(stops)[:, :3, :3], 1, 2))
    assert np.abs(turns).max() < 1e-4


def test_joints_that_were_written_once_per_stop_are_stops(place, run):
    """An average over all rows would be of different configurations."""
    stops, arm = record(place)
    _, times, q = motion()
    is_still = np.append(np.abs(np.diff(q, axis=0)).max(1) == 0, False)
    begins = np.flatnonzero(np.diff(is_still.astype(int), prepend=0) == 1)
    middle = [times[begin] + 0.5 for begin in begins]
    headers = ["time[s]", *(f"{name}[deg]" for name in arm.joint_names)]
    write(place / "joints.csv", headers, (middle, np.rad2deg(q[begins])))
    run(*CONVERT)
    data = read_measurements("data.csv", arm)
    np.testing.assert_allclose(data.q, stops[: len(data.q)], atol=1e-6)
    np.testing.assert_allclose(data.positions(), arm.poses(data.q)[:, :3, 3], atol=3e-5)


def changed(place, name, old, new):
    (place / name).write_text((place / name).read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("joints.csv", "time[s]", "time", "joints.csv:1: no column `time[s]`"),
        (
            "joints.csv",
            "0.080000,",
            "0.001000,",
            "joints.csv:12: column 'time': 0.071 s before the row above",
        ),
        ("joints.csv", "elbow_joint", "elbow", "'elbow[deg]'"),
        ("map.toml", '"X"', '"A"', "poses.csv:1: no column 'A', which map.toml names"),
    ],
)
def test_wrong_tables_are_one_line(place, run, name, old, new, words):
    record(place)
    changed(place, name, old, new)
    assert words in error_of(run(*CONVERT))
    assert not (place / "data.csv").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("convert joints.csv data.csv --poses poses.csv", "--poses: needs --robot"),
        ("convert joints.csv data.txt --poses poses.csv --robot example:ur10", "expected .csv"),
        (
            "convert joints.csv a.csv --poses poses.csv --robot example:ur10 --joint-topic /j",
            "have no topics",
        ),
    ],
)
def test_wrong_options_are_refused(place, run, words, expected):
    record(place)
    assert expected in error_of(run(*words.split()))


def test_a_file_of_joint_positions_alone_leads_to_the_command(place, run):
    record(place)
    said = error_of(run("calibrate", "example:ur10", "joints.csv", "-o", "arm.urdf"))
    assert "dhcal convert JOINTS.csv OUT.csv --poses FILE.csv --robot ROBOT" in said
