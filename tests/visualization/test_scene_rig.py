"""Cameras and boards in a scene: viewing pyramids, boards, and lines of sight."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import READY, window_of

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.cameras import Board, Camera, Rig
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.rig_file import rig_text
from dhcal_pin.measurements import CameraCorners, Noise, mount_rig
from dhcal_pin.visualization.rig_lines import rig_lines
from dhcal_pin.visualization.scene import scene_html

ON_TIP = se3.transform(se3.exp3([0.1, -0.2, 0.3]), [0.02, 0.03, 0.04])
IN_WORLD = se3.transform(se3.exp3([3.0, 0.1, 0.2]), [0.8, 0.1, 0.0])
CAMERA = Camera("wrist", "tip", 640, 480, np.array([600.0, 610, 310, 250, -0.1, 0.02, 0, 0, 0]), pose=ON_TIP)
BOARD = Board("table", "world", "checkerboard", columns=6, rows=5, square=0.03, pose=IN_WORLD)
RIG = Rig({"wrist": CAMERA}, {"table": BOARD})


def test_pyramid_ends_at_the_corners_of_the_image(sim_6dof):
    base = se3.exp6([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    content = rig_lines(mount_rig(RIG, sim_6dof), base, 1.0)
    camera, board = content["parts"]
    assert (camera["name"], camera["moves"], board["name"], board["moves"]) == ("wrist", True, "table", False)
    edges = np.array(camera["segments"]).reshape(-1, 2, 3)
    inverse = se3.inverse(ON_TIP)
    local = edges @ inverse[:3, :3].T + inverse[:3, 3]
    np.testing.assert_allclose(local[:4, 0], 0, atol=2e-6)
    pixels = CAMERA.lens.project(local[:4, 1].T, CAMERA.values)[0].T
    np.testing.assert_allclose(
        pixels, [[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]], atol=0.05
    )
    # The board stands in the measuring frame; the page draws in the frame of the base link.
    corners = BOARD.points @ IN_WORLD[:3, :3].T + IN_WORLD[:3, 3]
    ends = np.array(board["segments"]) @ base[:3, :3].T + base[:3, 3]
    np.testing.assert_allclose(ends.min(0), corners.min(0), atol=2e-6)
    np.testing.assert_allclose(ends.max(0), corners.max(0), atol=2e-6)
    (ray,) = content["rays"]
    np.testing.assert_allclose(ray["centre"], ON_TIP[:3, 3], atol=1e-6)
    assert len(ray["corners"]) == 4


def test_poses_that_are_not_known_are_named(sim_6dof):
    rig = Rig({"wrist": CAMERA}, {"table": Board("table", "world", "checkerboard", 6, 5, 0.03)})
    with pytest.raises(DhcalError, match="the pose of 'table' in its link is not known"):
        rig_lines(mount_rig(rig, sim_6dof), np.eye(4), 1.0)


def test_page_moves_the_camera_with_the_tool(sim_6dof, browser: Any, tmp_path):
    """The lines of sight begin at the camera and end at the board, in every configuration."""
    path = tmp_path / "scene.html"
    path.write_text(scene_html(sim_6dof, rig=mount_rig(RIG, sim_6dof), triangles=1000), "utf-8")
    with window_of(browser) as window:
        window.page.goto(path.as_uri())
        window.page.wait_for_function(READY)
        labels = window.page.locator("#layers label").all_inner_texts()
        assert {"Cameras and boards", "Lines of sight"} <= {label.strip() for label in labels}
        q = np.array([0.3, -0.4, 0.5, 0.2, -0.6, 0.1])
        window.call("setJoints", q.tolist())
        numbers = window.page.evaluate(
            "() => Array.from(dhcal.sight.children[0].geometry.attributes.position.array)"
        )
    points = np.reshape(numbers, (-1, 2, 3))
    centre = (sim_6dof.poses(q[None])[0] @ ON_TIP)[:3, 3]
    np.testing.assert_allclose(points[:, 0], np.tile(centre, (4, 1)), atol=1e-5)
    corners = BOARD.points[[0, 4, 19, 15]] @ IN_WORLD[:3, :3].T + IN_WORLD[:3, 3]
    np.testing.assert_allclose(points[:, 1], corners, atol=1e-5)


def parts_of(page: Path) -> list[str]:
    """Return the names of the cameras and boards of a page."""
    (text,) = re.findall(r'"rig":(\{"parts":.*?\]\}),"ellipsoids"', page.read_text("utf-8"))
    return [part["name"] for part in json.loads(text)["parts"]]


def test_view_draws_the_rig_of_a_calibrated_robot_and_that_of_a_file(sim_6dof, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    images = CameraCorners.simulate(sim_6dof, rng.uniform(-2, 2, (15, 6)), Noise(2e-4), rng)
    dh.write_urdf(dh.calibrate(sim_6dof, images, "camera,board", loss="linear"), "calibrated.urdf")
    assert main(["view", "calibrated.urdf", "--html", "scene.html"]) == 0
    assert parts_of(tmp_path / "scene.html") == ["left", "right", "target"]
    Path("rig.toml").write_text(rig_text([CAMERA], [BOARD]))
    assert main(["view", "calibrated.urdf", "--rig", "rig.toml", "--html", "scene.html"]) == 0
    assert parts_of(tmp_path / "scene.html") == ["wrist", "table"]
    capsys.readouterr()
