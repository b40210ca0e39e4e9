"""Files of a calibrated camera for other programs, all of them YAML.

- `.camera_info.yaml`: intrinsics as ROS keeps them (camera_calibration_parsers);
- `.opencv.yaml`: camera matrix and distortion for `cv::FileStorage`;
- `.handeye.yaml`: pose of the camera in a link of the robot, for the publisher of easy_handeye 0.4 (ROS 1).
"""

from __future__ import annotations

import json

import numpy as np
import pinocchio as pin

from .. import se3
from .._frozen import frozen
from .._typing import Array, PathLike
from ..cameras.rig import TIP, Camera
from ..formatting import Quantity
from ..measurements.mounting import MountedRig
from ..robot.chain import Chain
from .tabular import yaml_number

# Names of the distortion models in ROS by lens model.
_ROS_MODELS = {"pinhole": "plumb_bob", "fisheye": "equidistant"}


@frozen(eq=False)
class CameraFrame:
    """Frame of a calibrated camera on a robot."""

    camera: Camera  # Camera with its estimated lens
    name: str
    moves: bool  # Whether it moves with the tip; otherwise it stands still with the root
    base: str  # Link that stands still: the one that carries the camera, or the root
    effector: str  # Link that moves with the tip: the one that carries the camera, or the tip
    board: str  # Name of a board at the other end
    pose: Array  # Pose of the camera in the link that carries it, shape (4, 4) [m]

    @property
    def parent(self) -> str:
        """Link of the robot that carries the camera."""
        return self.effector if self.moves else self.base


def camera_frames(rig: MountedRig, chain: Chain, name: str | None) -> list[CameraFrame]:
    """Find the frame of each camera in a URDF."""
    frames = []
    for i, camera in enumerate(rig.cameras):
        moves = rig.camera_mounts[i].moves
        stated = camera.link if camera.link in chain.urdf.links else chain.root
        parent = chain.tip if camera.link == TIP else stated
        # The rig states poses in the measuring frame or in the tool frame, the URDF in links: the base and
        # the tool of the chain are between.
        end, pose = (chain.tip, chain.tool) if moves else (chain.root, se3.inverse(chain.base))
        end_in_parent = chain.fixed_pose(parent, end)
        assert end_in_parent is not None
        boards = zip(rig.boards, rig.board_mounts, strict=True)
        frames.append(
            CameraFrame(
                camera,
                _frame_name(rig, camera, name),
                moves,
                base=chain.root if moves else parent,
                effector=parent if moves else chain.tip,
                board=min(boards, key=lambda pair: pair[1].moves == moves)[0].name,
                pose=end_in_parent @ pose @ rig.camera_in_end(i),
            )
        )
    return frames


def _frame_name(rig: MountedRig, camera: Camera, name: str | None) -> str:
    if name is None:
        return camera.name
    return name if len(rig.cameras) == 1 else f"{name}_{camera.name}"


def camera_files(
    frame: CameraFrame, prefix: str, position_std: float | None = None
) -> dict[PathLike, str | bytes]:
    """Return the contents of the files of a camera, with the standard deviation of its position [m]."""
    return {
        f"{prefix}.camera_info.yaml": camera_info_text(frame.camera),
        f"{prefix}.opencv.yaml": opencv_text(frame.camera),
        f"{prefix}.handeye.yaml": hand_eye_text(frame, position_std),
    }


def _matrix(camera: Camera) -> Array:
    """Return the camera matrix, (3, 3) [px]."""
    fx, fy, cx, cy = camera.values[:4].tolist()
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _numbers(values: Array) -> str:
    """Write numbers as a YAML list."""
    return f"[{', '.join(map(yaml_number, values.ravel()))}]"


def _ros_matrix(name: str, values: Array) -> list[str]:
    rows, columns = np.atleast_2d(values).shape
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {_numbers(values)}"]


def camera_info_text(camera: Camera) -> str:
    """Return the intrinsics of a camera as a ROS camera_info YAML."""
    matrix = _matrix(camera)
    lines = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f"camera_name: {camera.name}",
        *_ros_matrix("camera_matrix", matrix),
        f"distortion_model: {_ROS_MODELS[camera.lens.name]}",
        *_ros_matrix("distortion_coefficients", camera.values[4:]),
        *_ros_matrix("rectification_matrix", np.eye(3)),
        *_ros_matrix("projection_matrix", np.hstack([matrix, np.zeros((3, 1))])),
    ]
    return "\n".join(lines) + "\n"


def opencv_text(camera: Camera) -> str:
    """Return the intrinsics of a camera as a YAML of OpenCV."""
    lines = ["%YAML:1.0", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    for name, values in (
        ("camera_matrix", _matrix(camera)),
        ("distortion_coefficients", camera.values[None, 4:]),
    ):
        rows, columns = values.shape
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
        lines.append(f"   data: {_numbers(values)}")
    return "\n".join(lines) + "\n"


def hand_eye_text(frame: CameraFrame, position_std: float | None = None) -> str:
    """Return the pose of a camera in its link as easy_handeye 0.4 keeps it."""
    ending = "eye_on_hand" if frame.moves else "eye_on_base"
    # The publisher sends the pose of `tracking_base_frame` in `robot_effector_frame` if `eye_on_hand` is
    # true, otherwise in `robot_base_frame`. It also stores all frames in the parameter server of ROS, under
    # `namespace`, and stops at one without a name.
    parameters = {
        "namespace": f"/{frame.camera.name}_{ending}/",
        "eye_on_hand": frame.moves,
        "robot_base_frame": frame.base,
        "robot_effector_frame": frame.effector,
        "tracking_base_frame": frame.name,
        "tracking_marker_frame": frame.board,
    }
    values = [*frame.pose[:3, 3], *pin.Quaternion(frame.pose[:3, :3]).coeffs()]
    # The publisher stops at keys that it does not know: the standard deviation [m] is a comment.
    comment = []
    if position_std is not None and np.isfinite(position_std):
        std = Quantity.error(position_std, "m")
        comment = [f"# standard deviation of the position relative to the arm: {std}"]
    lines = [*comment, "parameters:", *(f"  {key}: {json.dumps(value)}" for key, value in parameters.items())]
    lines.append("transformation:")
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    lines += [f"  {name}: {yaml_number(value)}" for name, value in zip(names, values, strict=True)]
    return "\n".join(lines) + "\n"
