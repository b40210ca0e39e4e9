"""Recordings of ROS as measurement files: the stops give the calibration of the same stops as CSV."""

import re
from pathlib import Path

import numpy as np
import pytest
from command_line import error_of, json_of, stderr_of, stdout_of, unfolded
from recordings import JOINTS, POSES, Recording, write_bag
from robots import URDF, paper, with_small_errors
from rosbags.rosbag1 import ReaderError
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.io import measurement_text, read_measurements
from dhcal_pin.measurements import Pose, Position
from dhcal_pin.robot import Chain

NOMINAL = URDF / "sim_6dof.dh.toml"


@pytest.fixture(scope="module")
def arm():
    """Arm with errors, in front of a tracker."""
    base = se3.exp6(np.array([2.0, -1, 0.5, 0.1, 0.2, 2]))
    true = with_small_errors(Chain.from_dh(paper("sim_6dof")), np.random.default_rng(0))
    return true.with_base_and_tool(base, np.eye(4))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def stops(arm, m=40):
    return np.random.default_rng(3).uniform(-1.5, 1.5, (m, arm.n_joints))


def parameters_of(run, path):
    """Identified parameters of a calibration of the nominal arm."""
    args = (
        "calibrate",
        NOMINAL,
        path,
        "-o",
        "out.urdf",
        "--parameters",
        "dh,base,tool",
        "--extend",
        "none",
        "--json",
        "-",
    )
    document = json_of(run(*args))
    return np.array([row["value"] for row in document["parameters"]])


def calibrated_positions(run, path):
    """Positions of the calibrated tool at other configurations [m]."""
    parameters_of(run, path)
    from dhcal_pin.io import read_robot

    return read_robot("out.urdf").poses(stops(read_robot("out.urdf"), 20) + 0.1)[:, :3, 3]


@pytest.mark.parametrize(
    ("name", "offset"),
    some_slow([("arm.bag", 0.0), ("arm.bag", 0.05), ("arm_ros2", -0.05), ("arm.mcap", 0.05)], {1, 2, 3}),
)
def test_a_recording_gives_the_calibration_of_its_stops(run, folder, arm, name, offset):
    """Joints at 100 Hz, poses at 30 Hz, 20 stops, clocks that differ by 50 ms, a moving arm in between."""
    q = stops(arm, 20)
    Path("stops.csv").write_text(measurement_text(Pose(q, arm.poses(q)), arm))
    expected = calibrated_positions(run, "stops.csv")
    write_bag(folder / name, Recording(arm, q, offset=offset))
    status, out, err = run("convert", name, "data.csv", "--pose-topic", POSES)
    assert (status, out) == (0, ""), err
    assert f"20 stops of {JOINTS} and {POSES} (frame tracker)" in err
    data = read_measurements("data.csv", arm)
    assert isinstance(data, Pose)
    np.testing.assert_allclose(data.q, q, atol=1e-9)
    np.testing.assert_allclose(data.poses, arm.poses(q), atol=1e-9)
    np.testing.assert_allclose(calibrated_positions(run, "data.csv"), expected, atol=1e-6)


@pytest.mark.parametrize("offset", [-7.0, -0.31, 0.4, 3.0])
def test_large_offsets_of_the_clocks_are_estimated(run, folder, arm, offset):
    """Stops of different length make the shift unique."""
    write_bag(folder / "arm.bag", Recording(arm, stops(arm, 12), offset=offset))
    _, _, err = run("convert", "arm.bag", "data.csv", "--pose-topic", POSES)
    found = float(err.split(f"the clock of {POSES} is ")[1].split(" s")[0])
    assert found == pytest.approx(offset, abs=0.05)
    data = read_measurements("data.csv", arm)
    np.testing.assert_allclose(data.positions(), arm.poses(data.q)[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize("kind", ["PointStamped", "TransformStamped", "TFMessage"])
def test_other_messages(run, folder, arm, kind):
    write_bag(folder / "arm", Recording(arm, stops(arm, 6), kind=kind))
    topic = f"{POSES}:reflector" if kind == "TFMessage" else POSES
    stdout_of(run("convert", "arm", "data.csv", "--pose-topic", topic))
    data = read_measurements("data.csv", arm)
    assert isinstance(data, Position if kind == "PointStamped" else Pose)
    np.testing.assert_allclose(data.q, stops(arm, 6), atol=1e-9)
    np.testing.assert_allclose(data.positions(), arm.poses(data.q)[:, :3, 3], atol=1e-9)


def test_noise_of_encoders_and_tracker_is_averaged(run, folder, arm):
    recording = Recording(arm, stops(arm, 20), joint_noise=2e-5, pose_noise=2e-4, offset=0.05)
    write_bag(folder / "arm.bag", recording)
    run("convert", "arm.bag", "data.csv", "--pose-topic", POSES)
    data = read_measurements("data.csv", arm)
    assert len(data.rows) == 20
    # Of 1.5 s at least 0.7 s are averaged: 20 poses and 70 joint samples.
    assert np.abs(data.q - stops(arm, 20)).max() < 5 * 2e-5 / np.sqrt(70)
    errors = data.positions() - arm.poses(stops(arm, 20))[:, :3, 3]
    assert np.std(errors) < 1.3 * 2e-4 / np.sqrt(20)


def test_short_stops_and_single_measurements(run, folder, arm):
    """Half a second at each stop; and one measurement in six seconds, in the middle of each stop."""
    write_bag(folder / "short.bag", Recording(arm, stops(arm, 15), stop=0.5, move=0.7, offset=0.05))
    run("convert", "short.bag", "short.csv", "--pose-topic", POSES)
    slow = Recording(arm, stops(arm, 8), stop=4.0, move=2.0, pose_rate=1 / 6, start=100.0)
    write_bag(folder / "single.bag", slow)
    status, _, err = run("convert", "single.bag", "single.csv", "--pose-topic", POSES)
    # The first measurement comes 4 ms after the start of a stop, too early for its inner part.
    assert (status, "no pose was recorded while the arm stood still" in err) == (2, True)
    data = read_measurements("short.csv", arm)
    np.testing.assert_allclose(data.q, stops(arm, 15), atol=1e-9)
    np.testing.assert_allclose(data.positions(), arm.poses(data.q)[:, :3, 3], atol=1e-9)


def test_messages_without_stamps_or_positions(run, folder, arm):
    """Headers of the poses that are never set, and positions that are NaN while the target is lost."""
    write_bag(folder / "arm.bag", Recording(arm, stops(arm, 6), stamps=False, lost=(4.0, 5.0)))
    err = stderr_of(run("convert", "arm.bag", "data.csv", "--pose-topic", POSES))
    assert "the times of the recording are used" in unfolded(err)
    data = read_measurements("data.csv", arm)
    np.testing.assert_allclose(data.q, stops(arm, 6), atol=1e-9)
    np.testing.assert_allclose(data.positions(), arm.poses(data.q)[:, :3, 3], atol=1e-9)


def test_without_a_topic_the_candidates_are_listed(run, folder, arm):
    write_bag(folder / "arm.bag", Recording(arm, stops(arm, 3)))
    for options in ((), ("--pose-topic", "/other")):
        err = error_of(run("convert", "arm.bag", "data.csv", *options))
        assert "--pose-topic" in err
        assert f"candidates: {POSES} (PoseStamped, 243 messages)" in err
    write_bag(folder / "tf", Recording(arm, stops(arm, 3), kind="TFMessage"))
    err = run("convert", "tf", "data.csv")[2]
    assert f"candidates: {POSES}:table (in tracker), {POSES}:reflector (in tracker)" in err
    assert not Path("data.csv").exists()
    err = error_of(run("convert", "arm.bag", "data.csv", "--pose-topic", POSES, "--joint-topic", POSES))
    assert f"--joint-topic {POSES}: no topic of joint positions; candidates: {JOINTS}" in err


def test_joints_of_a_gripper_and_of_the_robot(run, folder, arm):
    """Messages of other joints between those of the arm; the robot names the ones that are written."""
    recording = Recording(arm, stops(arm, 5), extra={"finger": 0.02})
    write_bag(folder / "arm.bag", recording)
    run("convert", "arm.bag", "all.csv", "--pose-topic", POSES)
    assert "finger[rad]" in Path("all.csv").read_text()
    args = ("convert", "arm.bag", "arm.csv", "--pose-topic", POSES, "--robot", NOMINAL)
    assert stdout_of(run(*args)) == ""
    assert "finger" not in Path("arm.csv").read_text()
    np.testing.assert_allclose(read_measurements("arm.csv", arm).q, stops(arm, 5), atol=1e-9)
    args = ("convert", "arm.bag", "x.csv", "--pose-topic", POSES, "--robot", URDF / "ur10.dh.toml")
    assert f"{JOINTS} has no joint 'shoulder_pan_joint'; its joints are joint_1" in run(*args)[2]


def test_invalid_recordings(run, folder):
    cases = {
        "broken.bag": (b"#ROSBAG V2.0\nnothing", "not a readable recording"),
        "broken.mcap": (b"\x89MCAP", "not a readable recording"),
        "broken.db3": (b"SQLite", "not a readable recording"),
    }
    for name, (content, words) in cases.items():
        Path(name).write_bytes(content)
        err = error_of(run("convert", name, "data.csv", "--pose-topic", POSES))
        assert f"{name}: {words}" in err
        assert not re.search(r"\(['\"]|\.;", err)
    for arguments, words in (
        (("none.bag", "data.csv"), "none.bag: cannot read it"),
        (("broken.bag", "data.urdf"), "data.urdf: a recording becomes a measurement file; expected .csv"),
        (("broken.bag", "data.csv", "--convention", "standard"), "--convention: a recording has none"),
        ((NOMINAL, "out.urdf", "--pose-topic", "/x"), "is no recording"),
        ((NOMINAL, "out.urdf", "--robot", NOMINAL), "--robot: only for a recording"),
    ):
        err = error_of(run("convert", *arguments))
        assert words in err


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        (
            "Bag index looks damaged: ('Could not read uint32.',)",
            "Bag index looks damaged: Could not read uint32",
        ),
        ("Rosbag2 version 91 not supported; please report issue.", "Rosbag2 version 91 not supported"),
        (f"Could not parse: {'x' * 2000}", f"Could not parse: {'x' * 83}..."),
    ],
)
def test_reasons_of_the_library_become_short_sentences(run, folder, arm, monkeypatch, reason, said):
    write_bag(folder / "arm.bag", Recording(arm, stops(arm, 5)))

    def fail(*args, **options):
        raise ReaderError(reason)

    monkeypatch.setattr("rosbags.highlevel.AnyReader.open", fail)
    err = run("convert", "arm.bag", "x.csv", "--pose-topic", POSES)[2]
    assert err == f"dhcal: arm.bag: not a readable recording: {said}; copy it again, or record it again\n"


def test_the_time_of_a_pose_does_not_grow_with_the_recording(run, folder, arm, monkeypatch):
    """`AnyReader.topics` goes through all messages; for each message it would take a third of the time."""
    from rosbags.highlevel import AnyReader

    count, topics = [], AnyReader.topics.fget
    assert topics is not None
    monkeypatch.setattr(AnyReader, "topics", property(lambda self: count.append(1) or topics(self)))
    write_bag(folder / "arm.bag", Recording(arm, stops(arm, 5)))
    stdout_of(run("convert", "arm.bag", "data.csv", "--pose-topic", POSES))
    assert 0 < len(count) < 10


@pytest.mark.parametrize(("old", "new"), [("message_count:", "message_count;"), ("starting_time", "start")])
def test_a_damaged_description_of_a_recording_can_be_made_again(run, folder, arm, old, new):
    metadata = write_bag(folder / "arm_ros2", Recording(arm, stops(arm, 2))) / "metadata.yaml"
    assert old in metadata.read_text()
    metadata.write_text(metadata.read_text().replace(old, new))
    err = error_of(run("convert", "arm_ros2", "data.csv", "--pose-topic", POSES))
    assert "metadata.yaml is damaged; make it again with ros2 bag reindex arm_ros2" in err


def test_rosbags_is_optional(run, folder, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    Path("arm.bag").write_bytes(b"")
    assert "pip install 'dhcal-pin[bags]'" in run("convert", "arm.bag", "data.csv")[2]
