"""Recordings of ROS 1, ROS 2 and MCAP, read with rosbags (`pip install 'dhcal-pin[bags]'`).

The joint positions come from a topic of `sensor_msgs/JointState`, the measured positions or poses from a
topic of one of `POSE_TYPES`. Times are those in the headers of the messages; if the headers of the two topics
have no time in common, the times at which the messages were recorded. The stops of the arm become the rows of
a measurement file, see `standstills`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ... import se3
from ..._typing import Array, PathLike
from ...exceptions import DhcalError, FileFormatError, InvalidArgumentError
from ...robot.chain import Chain
from ..tabular import require_usable_names
from .standstills import JointSeries, PoseSeries, describe_stops, find_stops, have_common_times, stops_text

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

# Endings of recordings that are one file; ROS 2 writes folders.
ENDINGS = (".bag", ".mcap", ".db3")
_JOINT_STATE = "sensor_msgs/msg/JointState"
# Topic that is read if there are several of joint positions.
_USUAL_JOINT_TOPIC = "/joint_states"
# Separator between a topic of transforms and the child frame.
_FRAME_SEPARATOR = ":"
# Longest reason of rosbags that a message quotes [characters].
_MAX_REASON_CHARS = 100
# Messages of a topic of transforms that are searched for frames.
_N_TRANSFORM_MESSAGES = 500
# Smallest norm of a quaternion that is a rotation.
_MIN_NORM = 0.5
_NANO = 1e-9


class _PoseSample(NamedTuple):
    """Position, quaternion (x, y, z, w) if there is one, and frame of a message."""

    header: Any
    position: Any
    quaternion: Any


# Function that takes position and rotation from a message of each type.
POSE_TYPES: Mapping[str, Callable[[Any], _PoseSample]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: _PoseSample(m.header, m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _PoseSample(
        m.header, m.pose.pose.position, m.pose.pose.orientation
    ),
    "geometry_msgs/msg/PointStamped": lambda m: _PoseSample(m.header, m.point, None),
    "geometry_msgs/msg/TransformStamped": lambda m: _PoseSample(
        m.header, m.transform.translation, m.transform.rotation
    ),
    "nav_msgs/msg/Odometry": lambda m: _PoseSample(m.header, m.pose.pose.position, m.pose.pose.orientation),
}
# Types of messages with several transforms.
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def is_bag(path: PathLike) -> bool:
    """Return whether a path is that of a recording: by its ending, or a folder of ROS 2."""
    return os.fspath(path).lower().endswith(ENDINGS) or os.path.exists(os.path.join(path, "metadata.yaml"))


def convert_bag(
    path: PathLike, pose_topic: str | None, joint_topic: str | None, chain: Chain | None
) -> tuple[str, list[str]]:
    """Make the text of a measurement file from the stops of a recording; return it, and notes."""
    source = os.fspath(path)
    with _open_bag(source) as reader:
        joint_topic = _choose_joint_topic(reader, source, joint_topic)
        if pose_topic is None or not _has_pose_topic(reader, pose_topic):
            problem = "name the topic of the measured poses with --pose-topic"
            if pose_topic is not None:
                problem = f"--pose-topic {pose_topic}: no topic of positions or poses"
            candidates = ", ".join(_pose_candidates(reader)) or "none"
            raise InvalidArgumentError(f"{source}: {problem}; candidates: {candidates}")
        joints = _read_joints(reader, source, joint_topic, chain)
        poses = _read_poses(reader, source, pose_topic)
    notes: list[str] = []
    # Column of the times that are used.
    clock = 0
    if not have_common_times(joints.times[:, 0], poses.times[:, 0]):
        clock = 1
        notes.append("the stamps of the topics have no time in common; the times of the recording are used")
    try:
        stops = find_stops(*_in_order(joints, poses, clock))
    except DhcalError as error:
        raise FileFormatError(f"{source}: {joint_topic}, {pose_topic}: {error}") from None
    notes = describe_stops(stops, joint_topic, pose_topic, f" (frame {poses.frame or 'unknown'})", notes)
    return stops_text(stops, joints.names, chain, [f"{source}: {notes[0]}", *notes[1:]]), notes


def read_bag_joints(path: PathLike, joint_topic: str | None) -> JointSeries:
    """Read all joint positions of a recording."""
    source = os.fspath(path)
    with _open_bag(source) as reader:
        return _read_joints(reader, source, _choose_joint_topic(reader, source, joint_topic), None)


# --- reading ---------------------------------------------------------------------------------------


@contextmanager
def _open_bag(source: str) -> Iterator[AnyReader]:
    """Open a recording; errors of its content become errors that name it."""
    try:
        from rosbags.highlevel import AnyReader  # lazy import: an optional package
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise FileFormatError(
            f"{source}: reading recordings needs rosbags; install it with pip install 'dhcal-pin[bags]'"
        ) from None
    if not os.path.exists(source):
        raise FileFormatError(
            f"{source}: cannot read it: no such file or folder; give the path of a recording"
        )
    try:
        with AnyReader([Path(source)], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except DhcalError:
        raise
    # A damaged recording raises errors of many types, such as those of its decompressor or database.
    except Exception as error:
        # Only those of rosbags itself are meant for users.
        reason = str(error) if type(error).__module__.startswith("rosbags") else "it is damaged"
        if "metadata" in reason:
            raise FileFormatError(
                f"{source}: its metadata.yaml is damaged; make it again with ros2 bag reindex {source}"
            ) from error
        raise FileFormatError(
            f"{source}: not a readable recording: {_sentence(reason)}; copy it again, or record it again"
        ) from error


def _sentence(reason: str) -> str:
    """Return the first part of a message of rosbags, without the tuple of another error and the full stop."""
    text = re.sub(r"""\(["'](.*?)["'],\)""", r"\1", reason).partition(";")[0].partition("\n")[0].rstrip(".")
    return text if len(text) <= _MAX_REASON_CHARS else f"{text[:_MAX_REASON_CHARS]}..."


def _choose_joint_topic(reader: AnyReader, source: str, wanted: str | None) -> str:
    """Return the topic of the joint positions."""
    topics = [name for name, info in reader.topics.items() if info.msgtype == _JOINT_STATE]
    if wanted is not None and wanted in topics:
        return wanted
    if wanted is None and (len(topics) == 1 or _USUAL_JOINT_TOPIC in topics):
        return topics[0] if len(topics) == 1 else _USUAL_JOINT_TOPIC
    problem = "name the topic of the joint positions with --joint-topic"
    if wanted is not None:
        problem = f"--joint-topic {wanted}: no topic of joint positions"
    raise InvalidArgumentError(f"{source}: {problem}; candidates: {', '.join(topics) or 'none'}")


def _has_pose_topic(reader: AnyReader, spec: str) -> bool:
    """Return whether a recording has a topic of poses, or of transforms if the child frame is given."""
    topic, _, frame = spec.partition(_FRAME_SEPARATOR)
    info = reader.topics.get(topic)
    if info is None:
        return False
    return info.msgtype in _TRANSFORMS if frame else info.msgtype in POSE_TYPES


def _pose_candidates(reader: AnyReader) -> list[str]:
    """Describe the topics that poses can be read from."""
    out = []
    for name, info in reader.topics.items():
        if info.msgtype in POSE_TYPES:
            kind = os.path.basename(info.msgtype or "")
            out.append(f"{name} ({kind}, {info.msgcount} messages)")
        if info.msgtype in _TRANSFORMS:
            frames: dict[str, str] = {}
            for number, (_, message) in enumerate(_messages(reader, name)):
                frames |= {each.child_frame_id: each.header.frame_id for each in message.transforms}
                if number > _N_TRANSFORM_MESSAGES:
                    break
            out += [f"{name}{_FRAME_SEPARATOR}{child} (in {frame})" for child, frame in frames.items()]
    return out


def _messages(reader: AnyReader, topic: str) -> Iterator[tuple[float, Any]]:
    """Yield the messages of a topic with the times at which they were recorded [s]."""
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, timestamp, data in reader.messages(connections):
        yield timestamp * _NANO, reader.deserialize(data, connection.msgtype)


def _stamp(header: Any) -> float:
    """Return the time in a header [s]."""
    return header.stamp.sec + header.stamp.nanosec * _NANO


def _read_joints(reader: AnyReader, source: str, topic: str, chain: Chain | None) -> JointSeries:
    """Read the joint positions, of the robot's joints only if it is known."""
    times, rows = [], []
    current: dict[str, float] = {}
    wanted = tuple(chain.joint_names) if chain is not None else None
    names = wanted
    for recorded, message in _messages(reader, topic):
        # Drivers may publish the joints of arm and gripper in messages of their own.
        current |= dict(zip(message.name, np.asarray(message.position, float).tolist(), strict=False))
        if wanted is None:
            names = tuple(current)
        if names and all(name in current for name in names):
            times.append((_stamp(message.header), recorded))
            rows.append([current[name] for name in names])
    if not rows or names is None:
        problem = "has no joint positions"
        if missing := [name for name in wanted or () if name not in current]:
            named = f"its joints are {', '.join(current)}" if current else "it names no joints"
            problem = f"has no joint {missing[0]!r}; {named}"
        raise FileFormatError(f"{source}: {topic} {problem}")
    require_usable_names(names, f"{source}: {topic}")
    # The first messages may lack the joints of another driver.
    complete = [i for i, row in enumerate(rows) if len(row) == len(names) and np.isfinite(row).all()]
    if not complete:
        raise FileFormatError(f"{source}: {topic} has no finite joint positions")
    return JointSeries(names, np.array([times[i] for i in complete]), np.array([rows[i] for i in complete]))


def _read_poses(reader: AnyReader, source: str, spec: str) -> PoseSeries:
    """Read positions or poses."""
    topic, _, child = spec.partition(_FRAME_SEPARATOR)
    # The property makes a new dictionary of all topics each time.
    message_type = reader.topics[topic].msgtype or ""
    times, positions, quaternions, frame = [], [], [], ""
    for recorded, message in _messages(reader, topic):
        for sample in _samples_of(message_type, message, child):
            point, quaternion = sample.position, sample.quaternion
            # Some trackers send NaN while they do not see the target.
            if not np.isfinite((point.x, point.y, point.z)).all():
                continue
            times.append((_stamp(sample.header), recorded))
            positions.append((point.x, point.y, point.z))
            if quaternion is not None:
                quaternions.append((quaternion.w, quaternion.x, quaternion.y, quaternion.z))
            frame = sample.header.frame_id
    if not positions:
        raise FileFormatError(f"{source}: {spec} has no finite positions")
    rotations = _rotations(np.array(quaternions), f"{source}: {spec}") if quaternions else None
    return PoseSeries(np.array(times), np.array(positions, float), rotations, frame)


def _samples_of(message_type: str, message: Any, child: str) -> Iterator[_PoseSample]:
    """Yield the poses of a message; of a list of transforms those of one child frame."""
    if message_type in _TRANSFORMS:
        for transform in message.transforms:
            if transform.child_frame_id == child:
                yield POSE_TYPES["geometry_msgs/msg/TransformStamped"](transform)
    else:
        yield POSE_TYPES[message_type](message)


def _rotations(quaternions: Array, where: str) -> Array:
    """Convert quaternions (w, x, y, z), shape (p, 4), to rotation matrices, shape (p, 3, 3)."""
    norms = np.linalg.norm(quaternions, axis=1)
    if not (norms > _MIN_NORM).all():
        raise FileFormatError(f"{where}: has a quaternion of norm {norms.min():.3g}; expected 1")
    return se3.quaternion_to_matrix(quaternions / norms[:, None])


def _in_order(joints: JointSeries, poses: PoseSeries, clock: int) -> tuple[JointSeries, PoseSeries]:
    """Return the series in the order of one clock, without repeated times."""
    joint_times, i = np.unique(joints.times[:, clock], return_index=True)
    pose_times, j = np.unique(poses.times[:, clock], return_index=True)
    rotations = None if poses.rotations is None else poses.rotations[j]
    return (
        JointSeries(joints.names, joint_times, joints.q[i]),
        PoseSeries(pose_times, poses.positions[j], rotations, poses.frame),
    )
