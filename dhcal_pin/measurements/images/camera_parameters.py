"""Unknowns of cameras and boards: poses, lenses and corners, with their names, first values and priors."""

from __future__ import annotations

import numpy as np

from ... import se3
from ..._typing import Array
from ...cameras.boards import Board
from ...cameras.rig import DISTORTION_PRIORS, PIXEL_PRIORS, Camera
from ..base import POINT_PRIOR, InstrumentParameter
from ..mounting import MountedRig

# Prior standard deviation of the rotation of a camera or a board [rad]: any.
ROTATION_PRIOR = 10.0
# Prior standard deviation of the corners of a board [m].
BOARD_POINT_PRIOR = 1e-3
# Names of the components of a pose.
POSE_NAMES = ("x", "y", "z", "rx", "ry", "rz")
# Name of the corners of boards among the parameter sets.
POINTS_SET = "points"


def pose_parameters(prefix: str, pose: Array | None) -> list[InstrumentParameter]:
    """Build the six parameters of the pose of a camera or a board."""
    values = np.full(6, np.nan) if pose is None else se3.position_and_rotvec(pose)
    return [
        InstrumentParameter(
            f"{prefix}.{name}",
            "m" if i < 3 else "rad",
            float(value),
            POINT_PRIOR if i < 3 else ROTATION_PRIOR,
        )
        for i, (name, value) in enumerate(zip(POSE_NAMES, values, strict=True))
    ]


def camera_parameters(camera: Camera) -> list[InstrumentParameter]:
    """Build the parameters of a camera: its pose, and its lens unless that is fixed."""
    out = pose_parameters(f"camera_{camera.name}", camera.pose)
    if camera.intrinsics != "fixed":
        for i, (name, value) in enumerate(zip(camera.lens.names, camera.values, strict=True)):
            # Values that are estimated from the same images are no prior knowledge.
            pixel_prior = PIXEL_PRIORS[camera.intrinsics if camera.has_intrinsics else "free"]
            unit, prior = ("px", pixel_prior) if i < 4 else ("1", DISTORTION_PRIORS[camera.intrinsics])
            out.append(InstrumentParameter(f"camera_{camera.name}.{name}", unit, float(value), prior))
    return out


def board_parameters(board: Board) -> list[InstrumentParameter]:
    """Build the parameters of a board: its pose, and its corners if they are not fixed."""
    out = pose_parameters(f"board_{board.name}", board.pose)
    if board.has_free_points:
        out += [
            InstrumentParameter(f"board_{board.name}.p{i}{axis}", "m", float(value), BOARD_POINT_PRIOR)
            for i, point in enumerate(board.points)
            for axis, value in zip("xyz", point, strict=True)
        ]
    return out


def rig_parameters(rig: MountedRig) -> tuple[InstrumentParameter, ...]:
    """Build the parameters of all cameras, then of all boards."""
    cameras = [parameter for camera in rig.cameras for parameter in camera_parameters(camera)]
    return (*cameras, *(parameter for board in rig.boards for parameter in board_parameters(board)))
