"""Rig files, a camera and a board, and joint positions that have the board in view."""

import numpy as np

from dhcal_pin import se3
from dhcal_pin.cameras import Board, Camera
from dhcal_pin.measurements import ViewLimits, is_board_in_view
from dhcal_pin.robot.sampling import joint_range

CAMERA_TABLE = """[camera.wrist]
link = "tip"
width = 1280
height = 720
fx = 640.0
fy = 641.0
cx = 639.5
cy = 359.5
"""
BOARD_TABLE = """[board.table]
link = "world"
type = "charuco"
columns = 7
rows = 5
square_mm = 30.0
marker_mm = 22.0
dictionary = "DICT_5X5_100"
"""

# A camera with distortion on the wrist, and a board that stands in front of the arm.
CAMERA = Camera(
    "wrist", "tip", 800, 600, np.array([762.0, 765, 402, 298, -0.12, 0.06, 0.001, -0.0005, 0]),
    pose=se3.transform(se3.exp3([0.02, -0.03, 0.8]), [0.03, 0.05, 0.02]),
)  # fmt: skip
BOARD = Board(
    "table", "world", "charuco", columns=5, rows=4, square=0.04, marker=0.03, dictionary="DICT_5X5_100",
    pose=se3.transform(se3.exp3([np.pi, 0, 0]) @ se3.exp3([0.02, 0.03, 0.5]), [0.75, 0.1, 0.02]),
)  # fmt: skip


def draw_views(arm, rig, rng, n_trials):
    """Draw joint positions above the base at which the camera sees the board from 0.3 to 0.8 m."""
    q = rng.uniform(*joint_range(arm), (n_trials, arm.n_joints))
    tools = arm.poses(q)
    return q[is_board_in_view(rig, 0, 0, tools, ViewLimits(0.3, 0.8)) & (tools[:, 2, 3] > 0.1)]
