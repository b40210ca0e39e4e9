"""Calibrations from images of real robots."""

from __future__ import annotations

import numpy as np
import pytest
from robots import DATA, missing

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.cameras import Board, Camera, Rig

# Corners of a virtual board of 3 x 3 points, 80 mm apart, at the middle of the real board [m].
CORNERS = 0.08 * np.array([[x, y, 0.0] for y in (-1, 0, 1) for x in (-1, 0, 1)]) + [-0.25, 0.25, 0]
LENS = np.array([640.0, 640, 640, 360, 0, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def franka():
    """Return the nominal arm and its images, rebuilt from the poses of the camera in the board."""
    arm = dh.read_robot("example:panda", tip="panda_link8")
    path = DATA / "fr3_d405/camera_in_board.csv"
    if not path.exists():
        missing(f"measurements at {path}")
    poses = dh.read_measurements(path, arm)
    camera = Camera("wrist", "tip", 1280, 720, LENS, intrinsics="fixed")
    board = Board("board", "world", "points", listed_points=CORNERS - CORNERS.mean(0))
    rig = dh.mount_rig(Rig({"wrist": camera}, {"board": board}), arm)
    local = np.einsum("mij,cj->mci", (inverse := se3.inverse(poses.poses))[:, :3, :3], CORNERS)
    local = local + inverse[:, None, :3, 3]
    pixels = 640 * local[..., :2] / local[..., 2:] + [640, 360]
    count = len(CORNERS)
    corner = np.tile(np.arange(count), len(local))
    return arm, dh.CameraCorners(np.repeat(poses.q, count, 0), pixels.reshape(-1, 2), corner, rig)


def image_rms(fit, held_out):
    """Return the RMS of an image coordinate on held-out images, with the nominal and the calibrated arm."""
    cases = ((fit.nominal_refitted, fit.nominal_instruments), (fit.chain, fit.instruments))
    errors = [compute_errors(chain, [held_out], known)[0]["pixels"] for chain, known in cases]
    return [np.sqrt(np.mean(each**2)) for each in errors]


def test_franka_with_a_camera_on_the_wrist(franka):
    """Half of the images are held out, 20 times; the arm itself is wrong by several millimetres."""
    arm, images = franka
    rng, count = np.random.default_rng(0), images.n_images
    rms = []
    for _ in range(20):
        fitted = np.isin(images.image, rng.permutation(count)[: count // 2])
        fit = dh.calibrate(arm, images.take(fitted), extend="none", loss="linear")
        rms.append(image_rms(fit, images.take(~fitted)))
    nominal, calibrated = np.median(rms, 0)
    assert nominal > 5
    assert calibrated <= 0.58


def test_franka_on_the_other_side_of_joint_space(franka):
    arm, images = franka
    q = images.q - images.q.mean(0)
    side = q @ np.linalg.svd(q, full_matrices=False)[2][0]
    rms = []
    for sign in (1, -1):
        fitted = sign * side <= np.median(sign * side)
        fit = dh.calibrate(arm, images.take(fitted), extend="none", loss="linear")
        rms.append(image_rms(fit, images.take(~fitted))[1])
    assert np.sqrt(np.mean(np.square(rms))) <= 1.20
