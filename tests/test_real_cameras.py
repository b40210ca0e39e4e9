"""Calibrations from images of real robots."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from robots import DATA, missing
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin import se3
from dhcal_pin.calibration.cameras import gate
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.cameras import Board, Camera, Rig
from dhcal_pin.cli import main
from dhcal_pin.io.rig_file import read_rig
from dhcal_pin.ros_packages import resolve_robot_path

pytestmark = pytest.mark.usefixtures("own_loss", "uneventful", "untried", "ordered_axes")

# Corners of a virtual board: 3 x 3 points, 80 mm apart [m].
GRID = 0.08 * np.array([[x, y, 0.0] for y in (-1, 0, 1) for x in (-1, 0, 1)])
LENS = np.array([640.0, 640, 640, 360, 0, 0, 0, 0, 0])


def mounted_rig(arm, lens, intrinsics):
    """Return a camera on the wrist and the virtual board, whose poses are not known."""
    camera = Camera("wrist", "tip", 1280, 720, lens, intrinsics=intrinsics)
    board = Board("board", "world", "points", listed_points=GRID)
    return dh.mount_rig(Rig({"wrist": camera}, {"board": board}), arm)


@pytest.fixture(scope="module")
def franka():
    """Return the nominal arm and its images, rebuilt from the poses of the camera in the board."""
    arm = dh.read_robot("example:panda", tip="panda_link8")
    path = DATA / "fr3_d405/camera_in_board.csv"
    if not path.exists():
        missing(f"measurements at {path}")
    poses = dh.read_measurements(path, arm)
    # The board lies below the middle of the camera positions, near the image centre.
    centre = poses.poses[:, :3, 3].mean(0) * [1, 1, 0]
    rig = mounted_rig(arm, LENS, "fixed")
    board_in_camera = se3.inverse(poses.poses) @ se3.transform(np.eye(3), centre)
    local = np.einsum("mij,cj->mci", board_in_camera[:, :3, :3], GRID) + board_in_camera[:, None, :3, 3]
    pixels = 640 * local[..., :2] / local[..., 2:] + [640, 360]
    count = len(GRID)
    corner = np.tile(np.arange(count), len(local))
    corners = dh.CameraCorners(np.repeat(poses.q, count, 0), pixels.reshape(-1, 2), corner, rig)
    return arm, corners, board_in_camera[:, :3, 3]


def held_out_errors(fit, images, positions, held_out):
    """Return RMS errors of held-out images (2, 2), with the nominal and with the calibrated arm.

    They are distances of corners [px] and of the board centre [mm] from their predictions. The centre has
    measured positions in the camera (images, 3) [m].
    """
    corners = images.take(np.repeat(held_out, len(GRID)))
    cases = ((fit.nominal_refitted, fit.nominal_instruments), (fit.chain, fit.instruments))
    out = []
    for chain, known in cases:
        pixels = compute_errors(chain, [corners], known)[0]["pixels"]
        rig = fit.data[0].solved_rig(known)
        cameras = chain.poses(corners.q[:: len(GRID)]) @ rig.cameras[0].pose
        predicted = (se3.inverse(cameras) @ rig.boards[0].pose)[:, :3, 3]
        distances = (pixels, 1e3 * (predicted - positions[held_out]))
        out.append([np.sqrt(np.mean(np.sum(distance**2, 1))) for distance in distances])
    return np.array(out)


@pytest.mark.parametrize(
    ("repeats", "seed"), [(3, 0), *(pytest.param(20, k, marks=pytest.mark.slow) for k in range(3))]
)
def test_franka_with_a_camera_on_the_wrist(franka, repeats, seed):
    """Half of the images are held out, several times; the arm itself is wrong by several millimetres."""
    arm, images, positions = franka
    rng, count = np.random.default_rng(seed), images.n_images
    errors = []
    for _ in range(repeats):
        fitted = np.isin(np.arange(count), rng.permutation(count)[: count // 2])
        fit = dh.calibrate(arm, images.take(np.repeat(fitted, len(GRID))), extend="none", loss="linear")
        assert fit.camera_stages[-1].is_kept
        errors.append(held_out_errors(fit, images, positions, ~fitted))
    nominal, calibrated = np.median(errors, 0)
    assert np.all(nominal > [10, 6])
    assert np.all(calibrated <= [0.58, 0.55])


@pytest.mark.parametrize(
    "focal_and_centre",
    some_slow([((640, 640, 640, 360),), ((655, 630, 655, 350),), ((np.nan,) * 4,)], ()),
    ids=["stated", "wrong", "unknown"],
)
def test_franka_with_a_lens_that_is_estimated(franka, focal_and_centre):
    """An estimated lens, stated rightly, stated wrongly or unknown, costs little accuracy in other images."""
    arm, images, _ = franka
    estimated = images.with_rig(mounted_rig(arm, np.concatenate([focal_and_centre, LENS[4:]]), "prior"))
    is_inside = np.all((images.values >= 0) & (images.values < [1280, 720]), 1)
    rng, count = np.random.default_rng(0), images.n_images
    errors = []
    for _ in range(2):
        is_fitted = np.isin(np.arange(count), rng.permutation(count)[: count // 2])
        is_fitted = np.repeat(is_fitted, len(GRID))
        for each in (images, estimated):
            fit = dh.calibrate(arm, each.take(is_fitted & is_inside), extend="none", loss="linear")
            assert fit.camera_stages[-1].is_kept
            held_out = each.take(~is_fitted & is_inside)
            pixels = compute_errors(fit.chain, [held_out], fit.instruments)[0]["pixels"]
            errors.append(np.sqrt(np.mean(np.sum(pixels**2, 1))))
    exact, found = np.median(np.reshape(errors, (2, 2)), 0)
    assert found < 1.15 * exact


def one_side(images, sign):
    """Return which images are on one side of joint space, along the first principal axis of scaled joints."""
    q = images.q[:: len(GRID)]
    q = (q - q.mean(0)) / q.std(0)
    return sign * (q @ np.linalg.svd(q, full_matrices=False)[2][0]) <= 0


@pytest.mark.parametrize("sign", some_slow([1, -1], {0}))
def test_franka_on_the_other_side_of_joint_space(franka, sign):
    arm, images, positions = franka
    fitted = one_side(images, sign)
    fit = dh.calibrate(arm, images.take(np.repeat(fitted, len(GRID))), extend="none", loss="linear")
    assert fit.camera_stages[-1].is_kept
    nominal, calibrated = held_out_errors(fit, images, positions, ~fitted)
    assert np.all(nominal > [12, 7])
    assert np.all(calibrated <= [1.20, 0.95])


@pytest.mark.slow
def test_noise_that_grows_near_the_board_improves_other_images(franka, monkeypatch):
    """Images are taken from 0.2 to 0.5 m, and the arm errs by millimetres rather than by pixels."""
    arm, images, positions = franka
    errors = []
    for _ in range(2):
        for sign in (1, -1):
            fitted = one_side(images, sign)
            fit = dh.calibrate(arm, images.take(np.repeat(fitted, len(GRID))), extend="none", loss="linear")
            errors.append(held_out_errors(fit, images, positions, ~fitted)[1])
        # The second time the noise is the same in all images.
        monkeypatch.setattr(gate, "fit_with_corner_noise", lambda fit, max_iterations: fit)
    ratio = np.exp(np.mean(np.log(errors[:2]) - np.log(errors[2:]), 0))
    assert np.all(ratio < [0.95, 1])


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
    some_slow(
        [
            *(("left", "offset", 16.8), ("left", "minimal", 16.4)),
            *(("right", "offset", 12.8), ("right", "minimal", 12.8)),
        ],
        {2},
    ),
)
def test_talos_looks_at_its_hands(side, parameters, limit, unsuspected_once):
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


CHARUCO_RIG = """[camera.fixed]
link = "world"
width = 1600
height = 1200
fx = 1352.02747
fy = 1356.14287
cx = 789.67065
cy = 627.2995
[board.target]
link = "tip"
type = "charuco"
columns = 5
rows = 7
square_mm = 36.195
marker_mm = 18.256
dictionary = "DICT_6X6_250"
"""


@pytest.fixture
def flange_images(tmp_path, monkeypatch):
    """Detect a board on a flange of known poses; return flange, image coordinates and folder of the data."""
    pytest.importorskip("cv2")
    folder = DATA / "charuco_images"
    if not folder.exists():
        missing(f"images at {folder}")
    monkeypatch.chdir(tmp_path)
    rows = ["image,x[m],y[m],z[m],qw,qx,qy,qz"]
    for path in sorted((folder / "poses").glob("*.yaml")):
        pose = yaml.safe_load(path.read_text())
        rows.append(",".join([path.stem, *(repr(pose[k]) for k in ("x", "y", "z", "qw", "qx", "qy", "qz"))]))
    Path("poses.csv").write_text("\n".join(rows))
    Path("rig.toml").write_text(CHARUCO_RIG)
    detect = ["detect", str(folder / "images"), "--rig", "rig.toml", "--joints", "poses.csv"]
    assert main.main([*detect, "-o", "corners.csv"]) == 0
    flange = dh.read_robot("flange.urdf")
    rig = dh.mount_rig(read_rig("rig.toml"), flange)
    return flange, dh.read_measurements("corners.csv", flange, rig=rig), folder


def lens_of_images(images):
    """Return the lens that OpenCV finds from the images alone, without the poses of the flange."""
    import cv2

    board, camera = images.rig.boards[0], images.rig.cameras[0]
    views = [images.take(images.image == i) for i in range(images.n_images)]
    views = [view for view in views if len(view.rows) >= 6]
    points = [board.points[view.corner].astype(np.float32) for view in views]
    pixels = [view.values.astype(np.float32) for view in views]
    fx, fy, cx, cy = camera.values[:4]
    start = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    size = (camera.width, camera.height)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    _, matrix, distortion, *_ = cv2.calibrateCamera(points, pixels, size, start, None, flags=flags)
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]])


def test_flange_poses_without_a_robot(flange_images):
    """A bundle of the two frames with a fixed lens leaves 1.53 px in images that are left out one by one."""
    flange, images, folder = flange_images
    assert (len(images.rows), images.n_images) == (309, 16)
    camera = replace(images.rig.cameras[0], values=lens_of_images(images), intrinsics="fixed")
    images = images.with_rig(replace(images.rig, cameras=(camera,)))
    squares = []
    for i in range(0, images.n_images, 3):
        fit = dh.calibrate(
            flange, images.take(images.image != i), "camera,board", priors="none", loss="linear"
        )
        errors = compute_errors(fit.chain, [images.take(images.image == i)], fit.instruments)[0]
        squares.append(np.sum(errors["pixels"] ** 2, 1))
    rms = np.sqrt(np.mean(np.concatenate(squares)))
    assert 0.5 < rms <= 1.53
    # The first guess of the data's authors comes from another calibration of the same camera.
    guess = yaml.safe_load((folder / "cal_data.yaml").read_text())["camera_mount_to_camera_guess"]
    fit = dh.calibrate(flange, images, "camera,board", priors="none", loss="linear")
    assert fit.rig is not None
    found = fit.rig.cameras[0].pose
    assert found is not None
    x, y, z, w = (guess[key] for key in ("qx", "qy", "qz", "qw"))
    stated = se3.quaternion_to_matrix(np.array([w, x, y, z]))
    np.testing.assert_allclose(found[:3, 3], [guess[key] for key in "xyz"], atol=0.015)
    assert np.linalg.norm(se3.log3(stated.T @ found[:3, :3])) < np.radians(1.5)
