"""Calibrations from images of real robots."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from robots import DATA, missing

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration.cameras import gate
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.cameras import Board, Camera, Rig
from dhcal_pin.ros_packages import resolve_robot_path

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


def held_out_errors(fit, held_out):
    """Return errors on held-out images, with the nominal and with the calibrated arm.

    Returns:
        RMS of an image coordinate [px], of the distance in the image [px], and of the distance of the corners
        from their lines of sight [mm]; shape (2, 3).
    """
    cases = ((fit.nominal_refitted, fit.nominal_instruments), (fit.chain, fit.instruments))
    out = []
    for chain, known in cases:
        errors = compute_errors(chain, [held_out], known)[0]
        pixels, board = (np.sqrt(np.mean(np.sum(errors[key] ** 2, 1))) for key in ("pixels", "board"))
        out.append([pixels / np.sqrt(2), pixels, 1e3 * board])
    return np.array(out)


@pytest.mark.parametrize("repeats", [6, pytest.param(20, marks=pytest.mark.slow)])
def test_franka_with_a_camera_on_the_wrist(franka, repeats):
    """Half of the images are held out, several times; the arm itself is wrong by several millimetres."""
    arm, images = franka
    rng, count = np.random.default_rng(0), images.n_images
    errors = []
    for _ in range(repeats):
        fitted = np.isin(images.image, rng.permutation(count)[: count // 2])
        fit = dh.calibrate(arm, images.take(fitted), extend="none", loss="linear")
        assert fit.camera_stages[-1].is_kept
        errors.append(held_out_errors(fit, images.take(~fitted)))
    nominal, calibrated = np.median(errors, 0)
    assert nominal[0] > 5
    assert calibrated[0] <= 0.58
    # In both image coordinates together, twice the variance.
    assert calibrated[1] <= 0.61
    assert calibrated[2] <= 0.55


def one_side(images, sign):
    """Return which samples are on one side of joint space, along the axis of its greatest extent."""
    q = images.q - images.q.mean(0)
    side = q @ np.linalg.svd(q, full_matrices=False)[2][0]
    return sign * side <= np.median(sign * side)


@pytest.mark.parametrize("sign", [1, -1])
def test_franka_on_the_other_side_of_joint_space(franka, sign):
    arm, images = franka
    fitted = one_side(images, sign)
    fit = dh.calibrate(arm, images.take(fitted), extend="none", loss="linear")
    assert fit.camera_stages[-1].is_kept
    pixels, _, distance = held_out_errors(fit, images.take(~fitted))[1]
    assert pixels <= 1.20
    assert distance <= 0.95


def test_noise_that_grows_near_the_board_improves_other_images(franka, monkeypatch):
    """Images are taken from 0.2 to 0.5 m, and the arm errs by millimetres rather than by pixels."""
    arm, images = franka
    errors = []
    for _ in range(2):
        for sign in (1, -1):
            fitted = one_side(images, sign)
            fit = dh.calibrate(arm, images.take(fitted), extend="none", loss="linear")
            errors.append(held_out_errors(fit, images.take(~fitted))[1])
        # The second time the noise is the same in all images.
        monkeypatch.setattr(gate, "fit_with_corner_noise", lambda fit, max_iterations: fit)
    ratio = np.exp(np.mean(np.log(errors[:2]) - np.log(errors[2:]), 0))
    assert np.all(ratio < 0.95)


def read_tags(path, side, chain):
    """Return joint values (m, n) and poses (m, 4, 4) of the tag of one hand in the camera."""
    with path.open(newline="") as file:
        (_, *names), *rows = csv.reader(file)
    count = len(names)
    rows = [row for row in rows if row[1 + count] == side]
    joints = np.array([row[1 : 1 + count] for row in rows], float)
    tags = np.array([row[2 + count : 9 + count] for row in rows], float)
    q = joints[:, [names.index(name) for name in chain.joint_names]]
    x, y, z, w = tags[:, 3:].T
    rotations = se3.quaternion_to_matrix(np.stack([w, x, y, z], 1))
    return q, se3.transform(rotations, tags[:, :3])


@pytest.mark.parametrize(
    ("side", "parameters", "limit"),
    [
        ("left", "offset", 16.8),
        ("left", "minimal", 16.4),
        ("right", "offset", 12.8),
        ("right", "minimal", 12.8),
    ],
)
def test_talos_looks_at_its_hands(side, parameters, limit):
    """Neither end of the path is the root; half of the poses are held out, 20 times. Limits in mm."""
    path = DATA / "talos_apriltag/measurements-pyrene-20200901-2.csv"
    if not path.exists():
        missing(f"measurements at {path}")
    robot = resolve_robot_path("example:talos_full_v2")
    chain = dh.Chain.from_urdf(robot, tip=f"gripper_{side}_base_link", root="head_2_link")
    data = dh.Pose(*read_tags(path, f"{side}_gripper", chain))
    assert len(data.rows) == {"left": 26, "right": 53}[side]
    rng, rms = np.random.default_rng(0), []
    for _ in range(20):
        order = rng.permutation(len(data.rows))
        fitted, held_out = data.take(order[: len(order) // 2]), data.take(order[len(order) // 2 :])
        fit = dh.calibrate(chain, fitted, f"{parameters},base,tool", extend="none", loss="linear")
        cases = ((fit.nominal_refitted, fit.nominal_instruments), (fit.chain, fit.instruments))
        rms.append([1e3 * dh.accuracy(arm, held_out, known)["position_rms_m"] for arm, known in cases])
    nominal, calibrated = np.median(rms, 0)
    assert nominal > 19
    assert calibrated <= limit
