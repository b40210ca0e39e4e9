"""Cameras and boards: lens models, corners of boards, and first estimates of poses from images.

A rig lists the cameras and boards of a set-up. Lens models map points in front of a camera to pixels. Poses
from images, the poses of cameras and boards on the robot, and focal lengths are found in closed form here, as
a start for the calibration. Files and the detection of boards in images are the concern of other packages.
"""

from .boards import Board
from .hand_eye import solve_hand_eye
from .lens import LENSES, Lens
from .pose_from_points import estimate_pose
from .rig import Camera, Rig

__all__ = [
    "LENSES",
    "Board",
    "Camera",
    "Lens",
    "Rig",
    "estimate_pose",
    "solve_hand_eye",
]
