"""Recordings of a simulated arm that moves from stop to stop, written with rosbags."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dhcal_pin.robot import Chain

JOINTS, POSES = "/joint_states", "/tracker/pose"


@dataclass
class Recording:
    """How an arm moves and how it is recorded."""

    chain: Chain  # Arm that moves; its base and tool are those of the measurement
    q: np.ndarray  # Joint positions of the stops, (m, n)
    stop: float = 1.5  # Duration of each stop [s]
    move: float = 1.2  # Duration of each motion [s]
    offset: float = 0.0  # Clock of the poses minus that of the joints [s]
    joint_rate: float = 100.0  # Messages per second
    pose_rate: float = 30.0  # Messages per second
    joint_noise: float = 0.0  # Standard deviation of the joint positions [rad]
    pose_noise: float = 0.0  # Standard deviation of the positions [m]
    kind: str = "PoseStamped"  # Type of the messages of the poses
    start: float = 1.7e9  # Time of the first message [s]
    # Names and constant values of further joints, in messages of their own.
    extra: dict[str, float] = field(default_factory=dict)
    stamps: bool = True  # Whether the headers of the poses have their times
    # Times since the start between which the measured position is NaN [s].
    lost: tuple[float, float] = (0.0, 0.0)

    @property
    def duration(self) -> float:
        """Duration of the recording [s]."""
        return len(self.q) * (self.stop + self.move)

    def joint_positions(self, times):
        """Return the joint positions at times since the start; motions begin and end at rest."""
        cycle = self.stop + self.move
        index = np.clip((times // cycle).astype(int), 0, len(self.q) - 1)
        share = np.clip((times - index * cycle - self.stop) / self.move, 0, 1)
        smooth = (3 * share**2 - 2 * share**3)[:, None]
        following = np.minimum(index + 1, len(self.q) - 1)
        return (1 - smooth) * self.q[index] + smooth * self.q[following]


def stamp_of(store, seconds):
    whole = int(np.floor(seconds))
    return store.types["builtin_interfaces/msg/Time"](
        sec=whole, nanosec=round((seconds - whole) * 1e9) % 10**9
    )


def header_of(store, seconds, frame):
    header = store.types["std_msgs/msg/Header"]
    more = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    return header(stamp=stamp_of(store, seconds), frame_id=frame, **more)


def pose_message(store, kind, seconds, position, quaternion):
    """Return a message of a type; quaternion x, y, z, w."""
    types = store.types
    header = header_of(store, seconds, "tracker")
    point = types["geometry_msgs/msg/Point"](*position)
    turn = types["geometry_msgs/msg/Quaternion"](*quaternion)
    if kind == "PointStamped":
        return types["geometry_msgs/msg/PointStamped"](header=header, point=point)
    if kind == "PoseStamped":
        pose = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
        return types["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)
    shift = types["geometry_msgs/msg/Vector3"](*position)
    transform = types["geometry_msgs/msg/TransformStamped"](
        header=header,
        child_frame_id="reflector",
        transform=types["geometry_msgs/msg/Transform"](translation=shift, rotation=turn),
    )
    if kind == "TransformStamped":
        return transform
    other = types["geometry_msgs/msg/TransformStamped"](
        header=header, child_frame_id="table", transform=transform.transform
    )
    return types["tf2_msgs/msg/TFMessage"](transforms=[other, transform])


def messages_of(recording: Recording, store):
    """Yield time of the recording [ns], topic, type and message, in the order of time."""
    rng = np.random.default_rng(1)
    out = []
    times = np.arange(0, recording.duration, 1 / recording.joint_rate)
    q = recording.joint_positions(times)
    q = q + recording.joint_noise * rng.standard_normal(q.shape)
    state = store.types["sensor_msgs/msg/JointState"]
    empty = np.empty(0)
    for time, row in zip((recording.start + times).tolist(), q, strict=True):
        message = state(
            header=header_of(store, time, ""), name=list(recording.chain.joint_names), position=row,
            velocity=empty, effort=empty,
        )  # fmt: skip
        out.append((time, JOINTS, "sensor_msgs/msg/JointState", message))
    for name, value in recording.extra.items():
        for time in (recording.start + times[:: int(recording.joint_rate)]).tolist():
            message = state(
                header=header_of(store, time, ""), name=[name], position=np.array([value]),
                velocity=empty, effort=empty,
            )  # fmt: skip
            out.append((time, JOINTS, "sensor_msgs/msg/JointState", message))
    times = np.arange(0.004, recording.duration, 1 / recording.pose_rate)
    poses = recording.chain.poses(recording.joint_positions(times))
    positions = poses[:, :3, 3] + recording.pose_noise * rng.standard_normal((len(times), 3))
    positions[(times >= recording.lost[0]) & (times < recording.lost[1])] = np.nan
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    package = "tf2_msgs" if recording.kind == "TFMessage" else "geometry_msgs"
    for time, position, turn in zip((recording.start + times).tolist(), positions, turns, strict=True):
        stamp = time + recording.offset if recording.stamps else 0.0
        message = pose_message(store, recording.kind, stamp, position, turn)
        out.append((time, POSES, f"{package}/msg/{recording.kind}", message))
    out.sort(key=lambda entry: entry[0])
    for time, topic, kind, message in out:
        yield int(time * 1e9), topic, kind, message


def write_bag(path: Path, recording: Recording) -> Path:
    """Write a recording: of ROS 1 (.bag), as MCAP (.mcap), or otherwise as a folder of ROS 2."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    folder = path.with_suffix("") if path.suffix == ".mcap" else path
    if is_ros1:
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer = Writer2(folder, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for time, topic, kind, message in messages_of(recording, store):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, serialize(message, kind))
    if path.suffix == ".mcap":
        (content,) = folder.glob("*.mcap")
        content.rename(path)
    return path
