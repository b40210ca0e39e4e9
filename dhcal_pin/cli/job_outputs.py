"""Files of the calibrated robot that a calibration job writes, by the ending of --output.

Functions import what they need when they are called, because help pages load no NumPy.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from ..exceptions import InvalidArgumentError
from .output_table import numbered

if TYPE_CHECKING:
    from .._typing import PathLike
    from ..calibration.result import Result
    from ..io.camera_files import CameraFrame
    from ..io.servo_file import ServoFile
    from ..robot.chain import Chain


# Ending of the corrected servo file.
SERVO_ENDING = ".servos.toml"


class RobotOutput(NamedTuple):
    """Format of the calibrated robot."""

    help: str  # What the file is, for the help of --output
    # Function that makes the files of the robot by path, from the value of --output and all options of the
    # job by name, with the corrected servos as `servo_file`.
    files: Callable[[Result, str, Mapping[str, Any]], dict[PathLike, str | bytes]]
    # Function that refuses what the format cannot hold before the calibration, from the nominal robot, the
    # value of --output and all options of the job by name.
    require: Callable[[Chain, str, Mapping[str, Any]], None] = lambda chain, output, options: None


def _require_mjcf(chain: Chain, output: str, options: Mapping[str, Any]) -> None:
    """Require an MJCF whose origins can be written, and no option that adds frames."""
    from ..io.robot import with_written_origins  # lazy import, as the following: they load Pinocchio
    from ..robot.formats.mjcf import Mjcf
    from ..robot.formats.mjcf_edit import require_writable

    for name in ("world_joint", "tool_frame", "camera_frame", "camera_files"):
        if options[name]:
            flag = name.replace("_", "-")
            raise InvalidArgumentError(f"--{flag}: not available for {output}, an MJCF; expected a .urdf")
    with_written_origins(chain.urdf, {}, output)
    assert isinstance(chain.urdf, Mjcf)
    require_writable(chain.urdf, chain.moving_joints)


def urdf_with_sidecar(fit: Result, output: str, options: Mapping[str, Any]) -> dict[PathLike, str | bytes]:
    """Make the calibrated URDF and its sidecar; base and tool are moved into the URDF on request."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ..io.robot import findings_of, urdf_files
    from ..report.provenance import file_digests
    from ..robot import urdf_edit

    chain, has_world, camera_frame = fit.chain, options["world_joint"], options["camera_frame"]
    # A base in the URDF must not be applied a second time by the sidecar.
    written = replace(chain, base=np.eye(4)) if has_world else chain
    if has_world and chain.transmission is not None and chain.transmission.has_compliance:
        raise InvalidArgumentError(
            "--world-joint: not available with errors that depend on gravity, whose torques assume that "
            "z of the robot's root link points up; omit it"
        )

    def frames(data: bytes) -> list[CameraFrame]:
        return _camera_frames(fit, output, data, has_world, camera_frame)

    def edit(data: bytes) -> bytes:
        if has_world:
            data = urdf_edit.with_world(data, chain.base)
        if options["tool_frame"]:
            data = urdf_edit.with_tool_frame(data, chain.tip, options["tool_frame"], chain.tool)
        for frame in frames(data) if camera_frame else ():
            data = urdf_edit.with_fixed_frame(data, frame.parent, frame.name, frame.pose, "--camera-frame")
        return data

    digests = list(file_digests(options["data"]).values())
    contents = urdf_files(written, output, findings_of(fit, digests), edit)
    if options["camera_files"]:
        from ..io.camera_files import camera_files  # lazy import: only for cameras

        data = contents[output]
        assert isinstance(data, bytes)
        for frame in frames(data):
            prefix = f"{options['camera_files']}_{frame.camera.name}"
            contents |= camera_files(frame, prefix, fit.hand_eye_std)
    return contents


def _camera_frames(
    fit: Result, output: str, urdf: bytes, has_world: bool, camera_frame: str | None
) -> list[CameraFrame]:
    """Return the frames of the cameras in the calibrated URDF, with the measuring frame in it on request."""
    import numpy as np  # lazy import, as the following: they are slow to load

    from ..io.camera_files import camera_frames
    from ..io.origins_file import joint_origins
    from ..robot.chain import Chain
    from ..robot.urdf import parse_urdf

    if fit.rig is None:
        raise InvalidArgumentError("no camera has a known pose: no image was fitted; leave out its outputs")
    root, base = ("world", np.eye(4)) if has_world else (fit.chain.root, fit.chain.base)
    written = Chain.from_urdf(parse_urdf(urdf, output), fit.chain.tip, root)
    _, tool = joint_origins(fit.chain)
    return camera_frames(fit.rig, replace(written, base=base, tool=tool), camera_frame)


def lerobot_files(fit: Result, output: str, options: Mapping[str, Any]) -> dict[PathLike, str | bytes]:
    """Make LeRobot's calibration with corrected homing offsets, and the URDF for its degrees."""
    servos: ServoFile = options["servo_file"]
    return {output: servos.lerobot_content(), **_urdf_beside(fit, output, options)}


def ros2_control_files(fit: Result, output: str, options: Mapping[str, Any]) -> dict[PathLike, str | bytes]:
    """Make parameters of the joints for drivers of `ros2_control`, and the URDF for their joint values."""
    servos: ServoFile = options["servo_file"]
    return {output: servos.ros2_control_content(), **_urdf_beside(fit, output, options)}


def _urdf_beside(fit: Result, output: str, options: Mapping[str, Any]) -> dict[PathLike, str | bytes]:
    """Make the URDF and its sidecar beside another output."""
    return urdf_with_sidecar(fit, f"{robot_stem(output)}.urdf", options)


# Formats of the calibrated robot by the ending of --output.
ROBOT_FORMATS = {
    ".urdf": RobotOutput("corrected URDF (.urdf)", urdf_with_sidecar),
    ".xml": RobotOutput("corrected MJCF, if ROBOT is an MJCF (.xml)", urdf_with_sidecar, _require_mjcf),
    ".json": RobotOutput("LeRobot's calibration with its URDF (.json, needs --servos)", lerobot_files),
    ".ros2_control.yaml": RobotOutput(
        "joint parameters of ros2_control drivers with their URDF (.ros2_control.yaml, needs --servos)",
        ros2_control_files,
    ),
}
# Endings of the files of a robot, and what they are called in the JSON document.
_FILE_NAMES = {
    ".calibration.toml": "sidecar",
    SERVO_ENDING: "servos",
    ".ros2_control.yaml": "ros2_control",
    ".json": "lerobot",
    ".urdf": "urdf",
}


def require_servos(output: str, servos: ServoFile | None) -> None:
    """Require the servos that the format of an output needs."""
    ending = robot_ending(output)
    if ending in (".json", ".ros2_control.yaml") and servos is None:
        raise InvalidArgumentError(
            f"{output}: needs --servos, the file of the servos; expected it, or a .urdf output"
        )
    if ending == ".json" and servos is not None and not servos.lerobot:
        raise InvalidArgumentError(
            f"{output}: --servos {servos.path} is not from LeRobot; expected its .json, or a .toml with the "
            "key lerobot"
        )


def robot_stem(output: str) -> str:
    """Return the path of --output without the ending of its format."""
    return output[: -len(robot_ending(output))]


def companion_paths(output: str, curves: str | None, has_servos: bool) -> list[str]:
    """List the files that are written beside the named ones; those of a camera are not among them."""
    endings = [".urdf", ".calibration.toml", SERVO_ENDING] if has_servos else [".calibration.toml"]
    paths = [robot_stem(output) + ending for ending in endings]
    paths += [robot_of_table(curves, output)] if curves else []
    return [path for path in paths if path != output]


def robot_of_table(curves: str, output: str) -> str:
    """Return the path of the robot to which the table of --curves belongs."""
    ending = ".xml" if robot_ending(output) == ".xml" else ".urdf"
    return f"{os.path.splitext(curves)[0]}.with_table{ending}"


def name_robot_files(paths: Iterable[str], output: str) -> dict[str, str]:
    """Return the files of a robot by what they are; --output has the name of its format otherwise."""
    other = {output: robot_ending(output)[1:]}
    names = {
        path: next(
            (name for ending, name in _FILE_NAMES.items() if path.lower().endswith(ending)),
            other.get(path, "camera_file"),
        )
        for path in paths
    }
    found: dict[str, str] = {}
    for name in dict.fromkeys(names.values()):
        found |= numbered(name, [path for path, each in names.items() if each == name])
    return found


def robot_ending(path: str) -> str:
    """Return the ending of --output that selects its format."""
    for ending in ROBOT_FORMATS:
        if path.lower().endswith(ending):
            return ending
    text = f"{path}: unknown file extension; expected {' or '.join(ROBOT_FORMATS)}"
    if path.lower().endswith((".dh.csv", ".dh.toml")):
        text += f"; for a DH table write cal.urdf, then `dhcal convert cal.urdf {path}`"
    raise InvalidArgumentError(text)
