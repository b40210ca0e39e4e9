"""Frames of cameras in the calibrated URDF: base and tool poses of the robot are in the sidecar."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from rig_files import draw_views
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.cameras import Board, Camera, Rig
from dhcal_pin.io.rig_file import rig_text
from dhcal_pin.measurements import mount_rig, project_board

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes", "inside_only")

NOISE = 0.05
BASE = se3.transform(se3.exp3([0, 0, 0.3]), [0.1, 0, 0.02])
TOOL = se3.transform(se3.exp3([0.1, 0.2, 0]), [0, 0.01, 0.05])
LENS = np.array([762.0, 765, 402, 298, 0, 0, 0, 0, 0])
BOARD = Board("table", "world", "checkerboard", columns=7, rows=6, square=0.04)
TURNED = se3.exp3([np.pi, 0, 0])
RIGS = {
    "tip": (
        Camera("wrist", "tip", 800, 600, LENS, pose=se3.transform(se3.exp3([0, 0, 0.8]), [0.03, 0.05, 0.02])),
        replace(BOARD, pose=se3.transform(TURNED, [0.75, 0.1, 0.02])),
    ),
    "world": (
        Camera("wrist", "world", 800, 600, LENS, pose=se3.transform(TURNED, [0.6, 0.1, 1.3])),
        replace(BOARD, link="tip", pose=se3.transform(np.eye(3), [-0.08, -0.05, 0.05])),
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("link", "options"),
    some_slow(
        [("tip", ()), ("world", ("--world-joint",)), ("tip", ("--world-joint",)), ("world", ())], {0, 1}
    ),
)
def test_frames_are_where_the_images_were_taken(run, robot_folder, link, options):
    """The link in the URDF and the transform of easy_handeye give the true pose in the measuring frame."""
    dh.write_urdf(replace(dh.read_robot("example:ur10", tip="tool0"), base=BASE, tool=TOOL), "moved.urdf")
    arm = dh.read_robot("moved.urdf", tip="tool0")
    camera, board = RIGS[link]
    rng = np.random.default_rng(4)
    rig = mount_rig(Rig({"wrist": camera}, {"table": board}), arm)
    q = draw_views(arm, rig, rng, 60_000)[:15]
    pixels, _ = project_board(rig, 0, 0, rig.board_in_camera(0, 0, arm.poses(q)))
    pixels += NOISE * rng.standard_normal(pixels.shape)
    lines = [",".join(f"{joint}[rad]" for joint in arm.joint_names) + ",u[px],v[px],corner"]
    for joints, image in zip(q.tolist(), pixels.tolist(), strict=True):
        lines += [",".join(map(repr, [*joints, *uv, i])) for i, uv in enumerate(image)]
    Path("images.csv").write_text("\n".join(lines))
    fixed = replace(camera, pose=None, intrinsics="fixed")
    Path("rig.toml").write_text(rig_text([fixed], [replace(board, pose=None)]))
    status, _, err = run(
        *("calibrate", "moved.urdf", "images.csv", "--rig", "rig.toml", "--tip", "tool0", *options),
        *("--parameters", "camera,board", "--camera-frame", "eye", "--camera-files", "cam", "-o", "out.urdf"),
    )
    assert status == 0, err
    found = dh.read_robot("out.urdf", tip="tool0")
    content = yaml.safe_load(Path("cam_wrist.handeye.yaml").read_text())
    parameters, values = content["parameters"], content["transformation"]
    assert parameters["tracking_base_frame"] == "eye"
    parent = parameters["robot_effector_frame" if parameters["eye_on_hand"] else "robot_base_frame"]
    rotation = se3.quaternion_to_matrix([values[key] for key in ("qw", "qx", "qy", "qz")])
    published = se3.transform(rotation, [values[key] for key in ("x", "y", "z")])
    in_urdf = found.fixed_pose(parent, "eye")
    assert in_urdf is not None
    np.testing.assert_allclose(published, in_urdf, atol=1e-9)
    if link == "tip":
        assert parent == "tool0"
        poses, truth = replace(found, tool=np.eye(4)).poses(q) @ published, arm.poses(q) @ camera.pose
    else:
        assert parent == "world"
        poses, truth = found.base @ published, camera.pose
    assert np.abs(poses - truth).max() < 5e-4
