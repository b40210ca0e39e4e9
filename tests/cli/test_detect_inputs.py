"""`dhcal detect` with joint values from a recording, several boards, and pictures of the corners."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import error_of, rows_of, stderr_of, unfolded
from recordings import Recording, write_bag
from robots import paper

from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera
from dhcal_pin.cli import main
from dhcal_pin.detection import (
    BoardDetection,
    DetectedImage,
    Layout,
    camera_with_intrinsics,
    overlay_files,
    read_image,
    render_images,
    reproject_corners,
)
from dhcal_pin.io.measurement_files.image_times import image_time
from dhcal_pin.io.rig_file import rig_text
from dhcal_pin.io.tabular import csv_text
from dhcal_pin.robot import Chain

cv2 = pytest.importorskip("cv2")

CAMERA = Camera("fixed", "world", 320, 240, np.array([300.0, 300, 160, 120, 0, 0, 0, 0, 0]))
BOARDS = [
    Board("left", "tip", "checkerboard", columns=5, rows=4, square=0.03),
    Board("right", "tip", "charuco", columns=4, rows=3, square=0.05, marker=0.036, dictionary="DICT_4X4_50"),
]
POSES = [se3.translation([-0.16, -0.05, 0.4]), se3.translation([0.01, -0.07, 0.45])]
START = 1.7e9


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(rig_text([CAMERA], BOARDS))
    Path("images").mkdir()
    return tmp_path


def render(*names_and_boards):
    """Write images of some boards."""
    views = [[(BOARDS[i], POSES[i]) for i in boards] for _, boards in names_and_boards]
    images = render_images(CAMERA, views, np.random.default_rng(0))
    for (name, _), image in zip(names_and_boards, images, strict=True):
        cv2.imwrite(f"images/{name}", image)


def detect(*args):
    return "detect", "images", "--rig", "rig.toml", *args, "-o", "corners.csv"


def test_several_boards_and_pictures_of_their_corners(run, folder):
    """An image with one of two boards is used; one without any is named. Pictures have colours at corners."""
    render(("both.png", [0, 1]), ("one.png", [0]), ("none.png", []))
    err = stderr_of(run(*detect("--overlay", "pictures", "--jobs", "2")))
    text = unfolded(err)
    assert "board left: 24 corners in 2 of 3 images" in text
    assert "board right: 6 corners in 1 of 3 images" in text
    assert "none.png: not used, no board found" in text
    assert "images/one.png: not used" not in text
    assert sorted(path.name for path in Path("pictures").iterdir()) == ["both.png", "none.png", "one.png"]
    picture = cv2.imread("pictures/both.png").astype(int)
    is_colored = np.ptp(picture, axis=2) > 60
    for row in rows_of("corners.csv"):
        if row["image"] == "both.png":
            u, v = round(float(row["u[px]"])), round(float(row["v[px]"]))
            assert is_colored[v - 5 : v + 6, u - 5 : u + 6].any()
    # The images themselves are not changed.
    np.testing.assert_array_equal(np.ptp(cv2.imread("images/both.png"), axis=2), 0)
    assert read_image("images/both.png").shape == (240, 320)


@pytest.mark.parametrize("has_intrinsics", [True, False])
def test_reprojected_corners_are_those_of_the_true_pose(folder, has_intrinsics):
    """Crosses are at the corners of the true pose, also at a corner that was not found."""
    board = BOARDS[0]
    poses = [
        POSES[0] @ se3.exp6(np.array([0.0, 0, 0, *turn]))
        for turn in ([0.4, 0, 0], [0, 0.5, 0], [-0.3, 0.3, 0])
    ]
    known = CAMERA if has_intrinsics else replace(CAMERA, values=np.array([np.nan] * 4 + [0.0] * 5))
    exact, images = [], []
    for number, pose in enumerate(poses):
        local = board.points @ pose[:3, :3].T + pose[:3, 3]
        exact.append(CAMERA.lens.project(local.T, CAMERA.values)[0].T)
        cv2.imwrite(f"images/{number}.png", np.full((240, 320), 128, np.uint8))
        corner = np.delete(np.arange(len(exact[-1])), 3)
        images.append(DetectedImage(f"images/{number}.png", corner, exact[-1][corner]))
    detection = BoardDetection(board, Layout(), images)
    camera = camera_with_intrinsics(known, [detection])
    assert camera is not None
    for image, pixels in zip(images, exact, strict=True):
        found = reproject_corners(camera, board, image)
        assert found is not None
        np.testing.assert_allclose(found.pixels, pixels, atol=1e-3)
        assert found.rms < 1e-3
    pictures = overlay_files("pictures", camera, [detection])
    picture = cv2.imdecode(np.frombuffer(pictures["pictures/0.png"], np.uint8), cv2.IMREAD_COLOR)
    for u, v in np.round(exact[0]).astype(int):
        assert is_cross(picture)[v - 2 : v + 3, u - 2 : u + 3].any()


@pytest.mark.parametrize(
    ("model", "distortion"),
    [("pinhole", [-0.3, 0.1, 0.001, -0.002, 0]), ("fisheye", [-0.05, 0.02, 0.01, 0])],
)
def test_unknown_lenses_are_estimated_with_distortion(model, distortion):
    """Crosses are at the true corners, although the first corners of an image are 15 px off."""
    true = replace(CAMERA, values=np.array([300.0, 302, 158, 122, *distortion]), lens=LENSES[model])
    board, rng = BOARDS[0], np.random.default_rng(2)
    middle = se3.translation(-board.points.mean(0))
    images, exact = [], []
    for number in range(12):
        turn = se3.exp3([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3)])
        place = [*rng.uniform([-0.08, -0.05], [0.08, 0.05]), rng.uniform(0.25, 0.35)]
        pose = se3.transform(turn, place) @ middle
        local = board.points @ pose[:3, :3].T + pose[:3, 3]
        exact.append(true.lens.project(local.T, true.values)[0].T)
        pixels = exact[-1] + 0.05 * rng.standard_normal(exact[-1].shape)
        if number == 0:
            pixels[:2] += 15.0
        images.append(DetectedImage(f"{number}.png", np.arange(len(pixels)), pixels))
    unknown = replace(true, values=np.full(len(true.values), np.nan))
    camera = camera_with_intrinsics(unknown, [BoardDetection(board, Layout(), images)])
    assert camera is not None
    for image, pixels in zip(images, exact, strict=True):
        found = reproject_corners(camera, board, image)
        assert found is not None
        np.testing.assert_allclose(found.pixels, pixels, atol=0.2)


def test_pictures_without_a_lens_say_so(run, folder):
    """Two images do not determine a lens: there are circles, and no crosses."""
    values = np.full(len(CAMERA.values), np.nan)
    Path("rig.toml").write_text(rig_text([replace(CAMERA, values=values)], BOARDS[:1]))
    render(("0.png", [0]), ("1.png", [0]))
    err = stderr_of(run(*detect("--overlay", "pictures")))
    assert "--overlay pictures: the pictures have no reprojected corners" in unfolded(err)
    assert "the images do not determine the lens of camera fixed; state fx, fy, cx, cy" in unfolded(err)
    assert not is_cross(cv2.imread("pictures/0.png")).any()
    Path("rig.toml").write_text(rig_text([CAMERA], BOARDS[:1]))
    assert "reprojected" not in run(*detect("--overlay", "pictures"))[2]
    assert is_cross(cv2.imread("pictures/0.png")).any()


def is_cross(picture):
    """Return which pixels (height, width) have the colour of reprojected corners."""
    picture = picture.astype(int)
    return (picture[..., 0] > 150) & (picture[..., 2] < 110)


def test_a_wrong_corner_stands_out_from_the_reprojected_ones(folder):
    board = BOARDS[0]
    local = board.points @ POSES[0][:3, :3].T + POSES[0][:3, 3]
    pixels = CAMERA.lens.project(local.T, CAMERA.values)[0].T
    wrong = pixels.copy()
    wrong[5] += [20.0, 0]
    found = reproject_corners(CAMERA, board, DetectedImage("1.png", np.arange(len(wrong)), wrong))
    assert found is not None
    np.testing.assert_allclose(found.pixels, pixels, atol=1e-3)
    assert found.rms == pytest.approx(20 / np.sqrt(len(wrong)), rel=1e-3)


@pytest.mark.parametrize("name", ["arm.bag", "arm_ros2"])
def test_joint_values_of_a_recording_by_the_times_of_the_images(run, folder, name):
    arm = Chain.from_dh(paper("sim_6dof"))
    stops = np.random.default_rng(3).uniform(-1, 1, (3, 6))
    recording = Recording(arm, stops, start=START)
    write_bag(folder / name, recording)
    # At the first and the second stop, in two notations, and during the motion between them.
    render(
        ("1700000000.75.png", [0]), ("1700000003450000000.png", [0]), ("left_1700000002_100000000.png", [0])
    )
    err = stderr_of(run(*detect("--joints", name)))
    assert "the robot moved at the time of left_1700000002_100000000.png" in unfolded(err)
    rows = rows_of("corners.csv")
    for image, q in (("1700000000.75.png", stops[0]), ("1700000003450000000.png", stops[1])):
        (values,) = {
            tuple(row[f"{j}[rad]"] for j in arm.joint_names) for row in rows if row["image"] == image
        }
        np.testing.assert_allclose(np.array(values, float), q, atol=1e-6)
    moving = recording.joint_positions(np.array([2.1]))[0]
    values = next(row for row in rows if row["image"].startswith("left_"))
    found = [float(values[f"{j}[rad]"]) for j in arm.joint_names]
    np.testing.assert_allclose(found, moving, atol=1e-3)


@pytest.mark.parametrize(
    ("image", "words"),
    [("first.png", ["first.png", "no time in the name"]), ("1600000000.5.png", ["is not in arm.bag"])],
)
def test_images_without_joint_values_in_the_recording_are_refused(run, folder, image, words):
    arm = Chain.from_dh(paper("sim_6dof"))
    write_bag(folder / "arm.bag", Recording(arm, np.zeros((1, 6)), start=START))
    render((image, [0]))
    err = error_of(run(*detect("--joints", "arm.bag")))
    assert all(word in err for word in words)
    assert not Path("corners.csv").exists()


def test_topic_of_joints_needs_a_recording(run, folder):
    render(("1.png", [0]))
    Path("joints.csv").write_text(csv_text({"image": ["1.png"], "a[rad]": [0.5]}))
    err = error_of(run(*detect("--joints", "joints.csv", "--joint-topic", "/joint_states")))
    assert "--joint-topic: needs --joints with a recording" in err


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("1700000000.png", 1.7e9),
        ("1700000000.25.jpg", 1700000000.25),
        ("cam0_1700000000_250000000.png", 1700000000.25),
        ("1700000000250000000.png", 1700000000.25),
        ("1700000000250000.png", 1700000000.25),
        ("1700000000250.png", 1700000000.25),
        ("image_12.png", None),
    ],
)
def test_times_in_names(name, time):
    assert image_time(name) == (None if time is None else pytest.approx(time, abs=1e-6))


def test_the_log_of_opencv_is_silent(folder, capfd):
    """OpenCV logs a line per search for a board whose markers nearly fill their squares."""
    render(("one.png", [1]), ("two.png", [1]))
    wide = replace(BOARDS[1], marker=0.049)
    Path("rig.toml").write_text(rig_text([CAMERA], [wide]))
    level = cv2.utils.logging.getLogLevel()
    assert level > cv2.utils.logging.LOG_LEVEL_SILENT
    assert main.main([*detect()]) == 0
    err = capfd.readouterr().err
    assert "in 2 of 2 images" in err
    assert "WARN" not in err
    assert cv2.utils.logging.getLogLevel() == level


@pytest.mark.parametrize("joints", [[], ["--joints", "joints.csv"]])
def test_images_that_do_not_exist_are_named(assert_refused, folder, joints):
    Path("joints.csv").write_text("image,joint_1[deg]\none,1\n")
    Path("rig.toml").write_text(rig_text([CAMERA], BOARDS))
    words = ["nothere: no such file or folder"]
    assert_refused(words, "detect", "nothere", "--rig", "rig.toml", *joints, "-o", "corners.csv")


def test_corners_are_written_as_csv(assert_refused, folder):
    render(("one.png", [1]))
    Path("rig.toml").write_text(rig_text([CAMERA], BOARDS))
    words = ["corners.parquet: unknown ending; write image coordinates as .csv"]
    assert_refused(words, "detect", "images", "--rig", "rig.toml", "-o", "corners.parquet")
