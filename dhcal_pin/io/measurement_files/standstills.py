"""Standstills of a recorded arm: one measurement for each stop, from joint positions and poses over time.

Two series with clocks of their own are recorded while the arm moves from stop to stop: joint positions, and
the measured position or pose of the tool. A series stands still at a sample if none of its components changes
by more than a tolerance within ±0.1 s. The tolerance is a multiple of the changes in the quietest tenth of
the recording, that is, of the noise.

The offset of the clocks is the shift that makes the arm and the measured point move and stand still at the
same times: it has the largest correlation of the two flags "moves". A stop is an interval in which both
series stand still. Its inner part is averaged, so that neither a small error of the offset nor a vibration
after the motion matters.

Shapes: k joint samples, n joints, p pose samples, m stops.
"""

from __future__ import annotations

import numpy as np

from ... import se3
from ..._frozen import frozen
from ..._typing import Array
from ...exceptions import FileFormatError
from ...formatting import format_count
from ...measurements.base import Measurement
from ...measurements.pose import Pose
from ...measurements.position import Position
from ...robot.chain import Chain
from ..tabular import csv_text
from .writing import joint_columns, value_columns

# Half of the window in which a series must not change to stand still [s].
_HALF_WINDOW_S = 0.1
# Tolerance of a change: this multiple of the changes in the quietest tenth, within these limits [rad], [m].
_NOISE_FACTOR = 4.0
_JOINT_TOLERANCE, _POSITION_TOLERANCE = (1e-4, 5e-3), (2e-5, 5e-3)
# Largest offset of the clocks that is searched, and the step of the search [s].
_MAX_OFFSET_S, _STEP_S = 10.0, 0.01
# Longest recording [s].
_MAX_DURATION_S = 1e5
# Smallest correlation of the flags "moves" of both series at the best offset.
_MIN_CORRELATION = 0.3
# Shortest inner part of a stop [s], and the part of a stop that is left out at each end: share and limit [s].
_MIN_STOP_S = 0.1
_MARGIN_SHARE, _MAX_MARGIN_S = 0.15, 0.5
# Standstills of equal joint positions with a shorter time between them are one stop [s].
_MAX_INTERRUPTION_S = 1.0


@frozen(eq=False)
class JointSeries:
    """Recorded joint positions."""

    names: tuple[str, ...]
    times: Array  # Times, ascending, shape (k,) [s]; (k, 2) before a clock is chosen: header, recording
    q: Array  # Joint positions, shape (k, n) [rad or m]


@frozen(eq=False)
class PoseSeries:
    """Recorded positions or poses of the tool."""

    times: Array  # Times, ascending, shape (p,) [s]; (p, 2) before a clock is chosen, as of the joints
    positions: Array  # Positions, shape (p, 3) [m]
    rotations: Array | None  # Rotations, shape (p, 3, 3); None for a series of positions
    frame: str  # Name of the frame that they are measured in


@frozen(eq=False)
class Stops:
    """Mean joint positions and poses of each stop."""

    times: Array  # Middle of each stop in the clock of the joints, shape (m,) [s]
    q: Array  # Joint positions, shape (m, n) [rad or m]
    positions: Array  # Positions, shape (m, 3) [m]
    rotations: Array | None  # Rotations, shape (m, 3, 3); None for a series of positions
    clock_offset: float  # Clock of the poses minus that of the joints [s]
    n_without_poses: int  # Number of standstills of the joints without a pose, which are left out


def find_stops(joints: JointSeries, poses: PoseSeries) -> Stops:
    """Find the stops of a recording and average the samples of each."""
    is_still = _stands_still(joints.times, joints.q, _JOINT_TOLERANCE)
    is_measured_still = _stands_still(poses.times, poses.positions, _POSITION_TOLERANCE)
    if not is_still.any():
        raise FileFormatError("the joints never stand still; stop the arm at each pose for a second")
    offset = _clock_offset(joints.times, ~is_still, poses.times, ~is_measured_still)
    pose_times = poses.times - offset
    rows: list[tuple[float, Array, Array, Array | None]] = []
    n_without = 0
    for start, end in _standstills(joints, is_still):
        margin = min(_MARGIN_SHARE * (end - start), _MAX_MARGIN_S)
        inside = (pose_times >= start + margin) & (pose_times <= end - margin) & is_measured_still
        if not inside.any():
            n_without += 1
            continue
        during = (joints.times >= start + margin) & (joints.times <= end - margin)
        rotation = None
        if poses.rotations is not None:
            rotation = se3.nearest_rotation(poses.rotations[inside].mean(0))
        rows.append(
            (0.5 * (start + end), joints.q[during].mean(0), poses.positions[inside].mean(0), rotation)
        )
    if not rows:
        raise FileFormatError(
            "no pose was recorded while the arm stood still; check that both are of the same motion"
        )
    times, q, positions, rotations = zip(*rows, strict=True)
    return Stops(
        times=np.array(times),
        q=np.stack(q),
        positions=np.stack(positions),
        rotations=None if poses.rotations is None else np.stack(rotations),
        clock_offset=offset,
        n_without_poses=n_without,
    )


def have_common_times(first: Array, second: Array) -> bool:
    """Return whether two series of times overlap, and none of them has the same time in all samples."""
    is_set = all(len(times) == 1 or np.ptp(times) > 0 for times in (first, second))
    return is_set and bool(first.min() <= second.max() and second.min() <= first.max())


def describe_stops(stops: Stops, joints: str, poses: str, frame: str, clocks: list[str]) -> list[str]:
    """Describe the stops of recorded joints and poses in a frame, with notes on their clocks."""
    notes = [
        f"{format_count(len(stops.q), 'stop')} of {joints} and {poses}{frame}",
        *clocks,
        f"the clock of {poses} is {stops.clock_offset:+.2f} s off that of {joints}",
    ]
    if stops.n_without_poses:
        notes.append(f"left out {format_count(stops.n_without_poses, 'stop')} without a pose")
    return notes


def stops_text(stops: Stops, names: tuple[str, ...], chain: Chain | None, comments: list[str]) -> str:
    """Return the text of a measurement file with one row per stop."""
    data: Measurement
    if stops.rotations is None:
        data = Position(stops.q, stops.positions)
    else:
        data = Pose(stops.q, se3.transform(stops.rotations, stops.positions))
    if chain is not None:
        joints = joint_columns(stops.q, chain)
    else:
        joints = {f"{name}[rad]": stops.q[:, j].tolist() for j, name in enumerate(names)}
    times = np.round(stops.times - stops.times[0], 3).tolist()
    return csv_text({"time[s]": times, **joints, **value_columns(data)}, comments)


def _stands_still(times: Array, values: Array, limits: tuple[float, float]) -> Array:
    """Return at which samples no component of a series (k, ·) changes within the window, (k,)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d  # lazy import: slow, only for recordings

    # Samples that are further apart than the window are measurements of their own.
    size = 1 if _is_sparse(times) else 2 * int(np.ceil(_HALF_WINDOW_S / np.median(np.diff(times)))) + 1
    changes = maximum_filter1d(values, size, axis=0) - minimum_filter1d(values, size, axis=0)
    change = changes.max(1)
    tolerance = np.clip(_NOISE_FACTOR * np.quantile(change, 0.1), *limits)
    return change <= tolerance


def _is_sparse(times: Array) -> bool:
    """Return whether samples are further apart than the window in which a series must not change."""
    return len(times) < 2 or float(np.median(np.diff(times))) > 2 * _HALF_WINDOW_S


def _clock_offset(joint_times: Array, joints_move: Array, pose_times: Array, poses_move: Array) -> float:
    """Estimate the clock of the poses minus that of the joints [s] from the flags (k,) and (p,) of motion."""
    if not (poses_move.any() and joints_move.any()) or poses_move.all():
        return 0.0
    start = max(joint_times[0], pose_times[0]) - _MAX_OFFSET_S
    end = min(joint_times[-1], pose_times[-1]) + _MAX_OFFSET_S
    if end - start > _MAX_DURATION_S:
        raise FileFormatError(f"lasts {end - start:.0f} s; record less than {_MAX_DURATION_S:g} s")
    grid = np.arange(start, end, _STEP_S)
    joint_flags, pose_flags = (
        _on_grid(grid, times, flags)
        for times, flags in ((joint_times, joints_move), (pose_times, poses_move))
    )
    n_steps = round(_MAX_OFFSET_S / _STEP_S)
    from scipy.signal import correlate  # lazy import: slow, only for bags

    products = correlate(pose_flags, joint_flags, mode="same", method="fft")
    middle = len(grid) // 2
    products = products[middle - n_steps : middle + n_steps + 1]
    correlation = products / (np.linalg.norm(joint_flags) * np.linalg.norm(pose_flags))
    if correlation.max() < _MIN_CORRELATION:
        raise FileFormatError(
            "the measured point does not move when the joints do; check that both are of the same motion"
        )
    # The maximum is flat within one step of the slower series.
    best = np.flatnonzero(correlation >= correlation.max() - 1e-9)
    return float((best.mean() - n_steps) * _STEP_S)


def _on_grid(grid: Array, times: Array, flags: Array) -> Array:
    """Return flags (k,) at the times of a grid, without their mean; 0 outside of the recording."""
    values = np.interp(grid, times, flags.astype(float), left=np.nan, right=np.nan)
    return np.nan_to_num(values - np.nanmean(values))


def _standstills(joints: JointSeries, is_still: Array) -> list[tuple[float, float]]:
    """Return start and end of each standstill of the joints [s]."""
    if _is_sparse(joints.times):
        return [(time - _HALF_WINDOW_S, time + _HALF_WINDOW_S) for time in joints.times.tolist()]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_still.astype(int), [0]])))
    merged: list[tuple[int, int]] = []
    for first, last in (edges.reshape(-1, 2) - [0, 1]).tolist():
        if merged:
            previous = merged[-1]
            is_near = joints.times[first] - joints.times[previous[1]] < _MAX_INTERRUPTION_S
            if is_near and np.abs(joints.q[first] - joints.q[previous[1]]).max() <= _JOINT_TOLERANCE[0]:
                merged[-1] = (previous[0], last)
                continue
        merged.append((first, last))
    spans = [(float(joints.times[first]), float(joints.times[last])) for first, last in merged]
    return [(start, end) for start, end in spans if end - start >= _MIN_STOP_S]
