"""Command calibrate with the column `image`: screen, report, JSON and residuals name the photographs."""

import csv
from pathlib import Path

import numpy as np
import pytest
from command_line import json_of, unfolded
from rig_files import BOARD, CAMERA, draw_views

import dhcal_pin as dh
from dhcal_pin.cameras import Rig
from dhcal_pin.io.rig_file import rig_text
from dhcal_pin.measurements import mount_rig, project_board

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes", "inside_only")

# Images whose corners are those of another image; the last four are held out.
WRONG, N_IMAGES, N_HELD_OUT = (2, 5, 11, 15), 20, 4


@pytest.fixture
def corners(robot_folder):
    """Write images and rig; return the lines of the measurement file without their names, and the names."""
    arm = dh.read_robot("example:ur10", tip="tool0")
    rng = np.random.default_rng(4)
    rig = mount_rig(Rig({"wrist": CAMERA}, {"table": BOARD}), arm)
    q = draw_views(arm, rig, rng, 150_000)[:N_IMAGES]
    pixels, _ = project_board(rig, 0, 0, rig.board_in_camera(0, 0, arm.poses(q)))
    pixels += 0.1 * rng.standard_normal(pixels.shape)
    pixels[list(WRONG)] = pixels[np.roll(WRONG, 1)]
    lines, names = (
        [",".join(f"{joint}[rad]" for joint in arm.joint_names) + ",u[px],v[px],corner,set"],
        ["image"],
    )
    for number, (joints, image) in enumerate(zip(q.tolist(), pixels.tolist(), strict=True)):
        part = "fit" if number < N_IMAGES - N_HELD_OUT else "holdout"
        lines += [",".join([*map(repr, [*joints, *uv]), str(i), part]) for i, uv in enumerate(image)]
        names += [f"{number:04}.png"] * len(image)
    Path("rig.toml").write_text(rig_text([CAMERA], [BOARD]))
    return lines, names


def calibrate(run, *outputs):
    """Calibrate the poses; return what the screen says, and the JSON."""
    result = run(
        *("calibrate", "example:ur10", "corners.csv", "--rig", "rig.toml", "--tip", "tool0", "--force"),
        *("--parameters", "camera,board", "-o", "arm.urdf", *outputs),
        *("--residuals", "residuals.csv", "--json", "-"),
    )
    return unfolded(result[2]), json_of(result)


def test_photographs_are_named(run, corners, undrawn):
    named = [f"{line},{name}" for line, name in zip(*corners, strict=True)]
    Path("corners.csv").write_text("\n".join(named))
    screen, result = calibrate(run, "--report", "report.html")
    n = len(corners[0]) - 1
    n_held = n * N_HELD_OUT // N_IMAGES
    assert f"{n} rows, camera, {N_IMAGES} images" in screen
    assert (
        f"{n - n_held} corners of {N_IMAGES - N_HELD_OUT} images fitted, {n_held} of {N_HELD_OUT} held out"
        in screen
    )
    assert "ignored" not in screen
    assert result["hand_eye"]["wrong_image_names"] == [f"{number:04}.png" for number in WRONG]
    listed = "0002.png, 0005.png, 0011.png and 1 more"
    assert f"left out ({listed}): check" in screen
    (outliers,) = [text for text in result["verdict"]["reasons"] if "are outliers" in text]
    assert f"among them all corners of 4 images ({listed}). Check the measurements" in outliers
    assert f"among them all corners of 4 images ({listed}), excluded from the fit" in screen
    assert "Image 0002.png: " in Path("report.html").read_text()
    with open("residuals.csv", newline="") as file:
        images = [row["image"] for row in csv.DictReader(file)]
    assert images == corners[1][1:]


@pytest.mark.slow
def test_without_the_column_images_are_counted(run, corners):
    """The smaller twin is `test_images_with_wrong_joint_values_are_counted`."""
    Path("corners.csv").write_text("\n".join(corners[0]))
    screen, result = calibrate(run)
    (outliers,) = [text for text in result["verdict"]["reasons"] if "are outliers" in text]
    assert "among them all corners of 4 images. Check the measurements" in outliers
    assert "png" not in screen
    assert result["hand_eye"]["wrong_images"] == 4
    assert result["hand_eye"]["wrong_image_names"] == []
    assert "image" not in Path("residuals.csv").read_text().splitlines()[0].split(",")
