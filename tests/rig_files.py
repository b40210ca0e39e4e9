"""Rig files, and joint positions that have a board in view."""

from __future__ import annotations

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


def draw_views(arm, rig, rng, n_trials):
    """Draw joint positions above the base at which the camera sees the board from 0.3 to 0.8 m.

    Args:
        arm: Robot.
        rig: One camera and one board on it, with their poses.
        rng: Random generator.
        n_trials: Number of joint positions that are drawn.

    Returns:
        Those with the board in view [rad], shape (m, n).
    """
    q = rng.uniform(*joint_range(arm), (n_trials, arm.n_joints))
    tools = arm.poses(q)
    return q[is_board_in_view(rig, 0, 0, tools, ViewLimits(0.3, 0.8)) & (tools[:, 2, 3] > 0.1)]
