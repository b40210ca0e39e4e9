"""Files of a calibrated camera for other programs, all of them YAML.

- `.camera_info.yaml`: intrinsics as ROS keeps them (camera_calibration_parsers);
- `.opencv.yaml`: camera matrix and distortion for `cv::FileStorage`;
- `.handeye.yaml`: pose of the camera in its link as easy_handeye keeps it.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from .._typing import Array, PathLike
from ..cameras.rig import Camera

# Names of the distortion models in ROS by lens model.
_ROS_MODELS = {"pinhole": "plumb_bob", "fisheye": "equidistant"}


def camera_files(camera: Camera, prefix: str, parent: str) -> dict[PathLike, str | bytes]:
    """Return the contents of the files of a camera.

    Args:
        camera: Camera with its estimated pose and lens.
        prefix: Begin of the paths.
        parent: Link of the robot that carries the camera.

    Returns:
        Contents by path.
    """
    return {
        f"{prefix}.camera_info.yaml": camera_info_text(camera),
        f"{prefix}.opencv.yaml": opencv_text(camera),
        f"{prefix}.handeye.yaml": hand_eye_text(camera, parent),
    }


def _matrix(camera: Camera) -> Array:
    """Return the camera matrix, (3, 3) [px]."""
    fx, fy, cx, cy = camera.values[:4].tolist()
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _numbers(values: Array) -> str:
    """Write numbers as a YAML list that reads back exactly."""
    return f"[{', '.join(repr(float(value)) for value in values.ravel())}]"


def _ros_matrix(name: str, values: Array) -> list[str]:
    rows, columns = np.atleast_2d(values).shape
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {_numbers(values)}"]


def camera_info_text(camera: Camera) -> str:
    """Return the intrinsics of a camera as a ROS camera_info YAML.

    Args:
        camera: Camera.

    Returns:
        Text of the file.
    """
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
    """Return the intrinsics of a camera as a YAML of OpenCV.

    Args:
        camera: Camera.

    Returns:
        Text of the file.
    """
    lines = ["%YAML:1.0", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    for name, values in (
        ("camera_matrix", _matrix(camera)),
        ("distortion_coefficients", camera.values[None, 4:]),
    ):
        rows, columns = values.shape
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
        lines.append(f"   data: {_numbers(values)}")
    return "\n".join(lines) + "\n"


def hand_eye_text(camera: Camera, parent: str) -> str:
    """Return the pose of a camera in its link as easy_handeye keeps it.

    Args:
        camera: Camera with its estimated pose.
        parent: Link of the robot that carries the camera.

    Returns:
        Text of the file: translation [m] and unit quaternion.
    """
    assert camera.pose is not None
    quaternion = pin.Quaternion(camera.pose[:3, :3]).coeffs()
    lines = ["parameters:", f"  eye_on_hand: {str(camera.link != 'world').lower()}"]
    lines += [f"  robot_effector_frame: {parent}", f"  tracking_base_frame: {camera.name}"]
    lines.append("transformation:")
    lines += [f"  {name}: {float(v)!r}" for name, v in zip("xyz", camera.pose[:3, 3], strict=True)]
    names = ("qx", "qy", "qz", "qw")
    lines += [f"  {name}: {float(v)!r}" for name, v in zip(names, quaternion, strict=True)]
    return "\n".join(lines) + "\n"
