"""Stops of recorded series: motion without stops, interruptions, drop-outs, unrelated series."""

import numpy as np
import pytest

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.measurement_files.standstills import JointSeries, PoseSeries, find_stops

# Start of the motion that leads to each stop, and of the stop [s]; their lengths differ.
MOVES = np.cumsum([0.0, 2.1, 2.7, 3.3, 2.2, 2.9])
LEVELS = np.array([0.0, 0.4, -0.7, 0.9, 0.2, -0.3])


def level(times):
    """Joint position over time: half a second of motion at constant speed before each stop."""
    corners = np.stack([MOVES, MOVES + 0.5], -1).ravel()
    return np.interp(times, corners, np.stack([np.roll(LEVELS, 1), LEVELS], -1).ravel())


def series(offset=0.0, pose_rate=30.0, end=18.0, start=0.0):
    times = np.arange(0, end, 0.01)
    q = np.stack([level(times), 0 * times], -1)
    pose_times = np.arange(0.003, end, 1 / pose_rate)
    positions = np.stack([np.cos(level(pose_times)), np.sin(level(pose_times)), 0 * pose_times], -1)
    joints = JointSeries(("a", "b"), start + times, q)
    return joints, PoseSeries(start + pose_times + offset, positions, None, "world")


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("offset", [0.0, 0.05, -2.0])
def test_stops_are_found(offset, start):
    stops = find_stops(*series(offset, start=start))
    np.testing.assert_allclose(stops.q[:, 0], LEVELS, atol=1e-12)
    np.testing.assert_allclose(stops.positions[:, 0], np.cos(LEVELS), atol=1e-12)
    assert stops.clock_offset == pytest.approx(offset, abs=0.03)


def test_a_moving_arm_has_no_stops():
    times = np.arange(0, 20, 0.01)
    joints = JointSeries(("a",), times, np.sin(times)[:, None])
    poses = PoseSeries(times, np.stack([np.sin(times)] * 3, -1), None, "")
    with pytest.raises(DhcalError, match="never stand still"):
        find_stops(joints, poses)


def test_a_point_that_does_not_move_with_the_joints_is_an_error():
    joints, poses = series()
    rng = np.random.default_rng(0)
    wandering = np.searchsorted(np.cumsum(rng.uniform(1.0, 3.0, 8)), poses.times)
    wandering = wandering + 0.3 * np.mod(poses.times, 0.5) * (np.mod(poses.times, 3) < 1)
    other = PoseSeries(poses.times, np.stack([wandering] * 3, -1), None, "")
    still = PoseSeries(poses.times, np.ones((len(poses.times), 3)), None, "")
    with pytest.raises(DhcalError, match=r"does not move when the joints do"):
        find_stops(joints, other)
    # A point that never moves cannot tell the offset; the calibration refuses such data.
    assert find_stops(joints, still).clock_offset == 0


def test_drop_outs_of_the_instrument_leave_stops_out():
    joints, poses = series()
    seen = (poses.times < MOVES[2]) | (poses.times > MOVES[3])
    stops = find_stops(joints, PoseSeries(poses.times[seen], poses.positions[seen], None, ""))
    assert stops.n_without_poses == 1
    np.testing.assert_allclose(stops.q[:, 0], np.delete(LEVELS, 2), atol=1e-12)


def test_one_faulty_joint_message_does_not_divide_a_stop():
    joints, poses = series()
    q = joints.q.copy()
    q[np.searchsorted(joints.times, MOVES[1] + 1.5), 1] = 0.5
    stops = find_stops(JointSeries(joints.names, joints.times, q), poses)
    assert len(stops.q) == len(LEVELS)
