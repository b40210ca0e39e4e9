"""From image files to a calibrated URDF: rendered images by a camera on the wrist of a wrong arm."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import stderr_of, stdout_of, unfolded
from rig_files import BOARD as SMALL_BOARD
from rig_files import CAMERA, draw_views

import dhcal_pin as dh
from dhcal_pin.cameras import Rig
from dhcal_pin.detection import ImageQuality, render_images
from dhcal_pin.io.rig_file import rig_text

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")

cv2 = pytest.importorskip("cv2")

N_IMAGES = 26
# More corners, as errors of the arm by 0.05 mm are to be found.
BOARD = replace(SMALL_BOARD, columns=9, rows=7, square=0.03, marker=0.022)


@pytest.fixture
def simulated(robot_folder):
    """Render images with an arm that is wrong by millimetres, and write them with all other inputs.

    Returns the nominal arm, the true one, and joint positions in view that have no image.
    """
    arm = dh.read_robot("example:ur10", tip="tool0")
    rng = np.random.default_rng(0)
    rig = dh.mount_rig(Rig({"wrist": CAMERA}, {"table": BOARD}), arm)
    q = draw_views(arm, rig, rng, 300_000)
    errors = dh.select_parameters(arm, "placement")
    scale = np.array([1e-3 if p.unit == "m" else 2e-3 for p in errors.parameters])
    truth = errors.at(scale * rng.normal(size=len(scale)))
    measured = q[:N_IMAGES]
    poses = rig.board_in_camera(0, 0, truth.poses(measured))
    images = render_images(CAMERA, [[(BOARD, pose)] for pose in poses], rng, ImageQuality(0.7, 2.0, 3))
    Path("images").mkdir()
    rows = ["image," + ",".join(f"{name}[deg]" for name in arm.joint_names)]
    for i, (image, position) in enumerate(zip(images, np.degrees(measured), strict=True)):
        # A finger of the gripper covers a part of every third image.
        if i % 3 == 0:
            cv2.fillPoly(image, [np.array([[330, 600], [400, 330], [470, 600]])], 60)
        cv2.imwrite(f"images/{i:02d}.png", image)
        rows.append(f"{i:02d}.png," + ",".join(map(repr, position.tolist())))
    Path("joints.csv").write_text("\n".join(rows))
    guess = replace(CAMERA, pose=None, values=np.array([720.0, 720, 399.5, 299.5, 0, 0, 0, 0, 0]))
    Path("rig.toml").write_text(rig_text([guess], [replace(BOARD, pose=None)]))
    return arm, truth, q[N_IMAGES:]


def distances(points):
    """Return the distances between all pairs of points (m, 3)."""
    first, second = np.triu_indices(len(points), 1)
    return np.linalg.norm(points[first] - points[second], axis=1)


def test_from_photographs_to_a_calibrated_urdf(run, simulated):
    """The camera's positions in space, by the written URDF, are right to 0.05 mm where the board is seen."""
    arm, truth, q = simulated
    stdout_of(run("detect", "images", "--rig", "rig.toml", "--joints", "joints.csv", "-o", "corners.csv"))
    err = stderr_of(
        run(
            *("calibrate", "example:ur10", "corners.csv", "--rig", "rig.toml", "--tip", "tool0"),
            *("-o", "arm.urdf", "--camera-frame", "camera_link"),
        )
    )
    camera = CAMERA.pose
    exact = distances((truth.poses(q) @ camera)[:, :3, 3])
    nominal = distances((arm.poses(q) @ camera)[:, :3, 3])
    found = distances(dh.read_robot("arm.urdf", tip="camera_link").poses(q)[:, :3, 3])
    assert len(q) > 50
    assert np.sqrt(np.mean((nominal - exact) ** 2)) > 2e-3
    assert np.sqrt(np.mean((found - exact) ** 2)) < 0.05e-3
    assert "px" in unfolded(err)
    assert "ignored" not in err
