"""Boards in photographs and in drawings of known geometry."""

import numpy as np
import pytest
from robots import DATA, missing
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.cameras import Board, Camera
from dhcal_pin.detection import (
    ImageQuality,
    Layout,
    black_rectangles,
    board_pdf,
    detect_corners,
    find_layout,
    read_image,
    render_images,
)
from dhcal_pin.detection.crossings import refine_crossings
from dhcal_pin.detection.video import read_stills
from dhcal_pin.exceptions import DhcalError

cv2 = pytest.importorskip("cv2")

CHARUCO = Board("b", "tip", "charuco", columns=7, rows=5, square=0.036195, marker=0.018256,
                dictionary="DICT_6X6_250")  # fmt: skip
SIZE = 1280, 960


def photographs():
    paths = sorted((DATA / "charuco_images/images").glob("*.jp*g"))
    if not paths:
        missing(f"images at {DATA / 'charuco_images'}")
    return [str(path) for path in paths]


@pytest.mark.parametrize(
    ("columns", "rows", "wanted", "step", "count"), [(5, 7, False, 1, 309), (7, 5, True, 3, 127)]
)
def test_all_corners_of_photographs(columns, rows, wanted, step, count):
    """A board whose rows and columns are exchanged in the rig is found, and its layout is named."""
    board = Board("b", "tip", "charuco", columns=columns, rows=rows, square=0.036195, marker=0.018256,
                  dictionary="DICT_6X6_250")  # fmt: skip
    paths = photographs()[::step]
    layout = find_layout(board, [read_image(path) for path in paths[:3]])
    assert layout.is_exchanged == wanted
    assert bool(layout.describe(board)) == wanted or layout.is_legacy
    found = [detect_corners(board, layout, path, (1600, 1200)) for path in paths]
    assert sum(len(image.corner) for image in found) == count
    # The corners of a flat board lie on a homography of the numbers of the rig.
    for image in found:
        if len(image.corner) > 8:
            homography, _ = cv2.findHomography(board.points[image.corner, :2], image.pixels)
            mapped = (
                np.column_stack([board.points[image.corner, :2], np.ones(len(image.corner))]) @ homography.T
            )
            assert np.abs(mapped[:, :2] / mapped[:, 2:] - image.pixels).max() < 6


BOARDS = [
    CHARUCO,
    Board("c", "tip", "checkerboard", columns=8, rows=5, square=0.03),
    Board(
        "a",
        "tip",
        "aprilgrid",
        columns=4,
        rows=3,
        square=0.04,
        spacing=0.012,
        dictionary="DICT_APRILTAG_36h11",
    ),
]


CAMERA = Camera("c", "world", *SIZE, np.array([1100.0, 1110, 640, 470, -0.1, 0.05, 0.001, -0.001, 0]))


def views(board, count, rng):
    """Return poses of a board in a camera: turned by up to 40 degrees about any axis, 0.4 to 0.8 m away."""
    poses = []
    for _ in range(count):
        axis = rng.normal(size=3)
        rotation = se3.exp3(axis / np.linalg.norm(axis) * rng.uniform(0.05, 0.7))
        depth = rng.uniform(0.4, 0.8)
        centre = depth * np.array([rng.uniform(-0.12, 0.12), rng.uniform(-0.08, 0.08), 1])
        poses.append(se3.transform(rotation, centre - rotation @ board.points.mean(0)))
    return poses


def projected(board, pose):
    """Return the image coordinates of all corners by OpenCV."""
    fx, fy, cx, cy = CAMERA.values[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rotation, translation = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
    return cv2.projectPoints(board.points, rotation, translation, matrix, CAMERA.values[4:])[0].reshape(-1, 2)


@pytest.mark.parametrize(("blur", "noise"), some_slow([(0.7, 2.0), (1.2, 4.0)], {1}))
@pytest.mark.parametrize("board", some_slow(BOARDS, {0, 2}), ids=lambda board: board.type)
def test_corners_of_rendered_boards(board, blur, noise, tmp_path):
    rng, path, errors = np.random.default_rng(1), str(tmp_path / "board.png"), []
    poses = views(board, 2, rng)
    images = render_images(CAMERA, [[(board, pose)] for pose in poses], rng, ImageQuality(blur, noise, 4))
    for pose, image in zip(poses, images, strict=True):
        cv2.imwrite(path, image)
        layout = find_layout(board, [image])
        assert layout.describe(board) == "" or board.rows % 2
        found = detect_corners(board, layout, path, SIZE)
        assert found.problem == ""
        assert len(found.corner) >= 0.95 * len(board.points)
        errors.append(found.pixels - projected(board, pose)[found.corner])
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.05


@pytest.mark.parametrize("board", [BOARDS[0], BOARDS[2]], ids=lambda board: board.type)
def test_corners_of_boards_that_are_partly_covered(board, tmp_path):
    """What covers a part of a board moves no corner: those at its edge are left out."""
    rng, path = np.random.default_rng(2), str(tmp_path / "board.png")
    poses = views(board, 2, rng)
    images = render_images(CAMERA, [[(board, pose)] for pose in poses], rng)
    for pose, image in zip(poses, images, strict=True):
        exact = projected(board, pose)
        cover = exact[len(exact) // 2] + np.array([[-10, -15], [35, -50], [300, 200], [100, 300]])
        cv2.fillPoly(image, [cover.astype(np.int32)], int(rng.integers(255)))
        cv2.imwrite(path, image)
        found = detect_corners(board, Layout(), path, SIZE)
        assert 0.2 * len(exact) < len(found.corner) < 0.9 * len(exact)
        errors = found.pixels - exact[found.corner]
        assert np.sqrt(np.mean(errors**2)) < 0.05
        assert np.abs(errors).max() < 0.3


def test_rendered_boards_hide_each_other_and_show_one_side(tmp_path):
    """The nearer of two boards is seen, and the back of a board is not."""
    board = BOARDS[1]
    near, far = (se3.translation([0, 0, depth]) @ views(board, 1, np.random.default_rng(0))[0]
                 for depth in (0.0, 0.5))  # fmt: skip
    quality = ImageQuality(0.0, 0.0)
    alone, both = render_images(
        CAMERA, [[(board, near)], [(board, far), (board, near)]], np.random.default_rng(0), quality
    )
    u, v = np.round(projected(board, near)[0]).astype(int)
    np.testing.assert_array_equal(alone[v - 3 : v + 4, u - 3 : u + 4], both[v - 3 : v + 4, u - 3 : u + 4])
    back = near @ se3.transform(se3.exp3([np.pi, 0, 0]), [0, 0.15, 0])
    (image,) = render_images(CAMERA, [[(board, back)]], np.random.default_rng(0), quality)
    assert image.min() == image.max()


def test_images_that_are_not_used_are_named(tmp_path):
    empty = str(tmp_path / "empty.png")
    cv2.imwrite(empty, np.full(SIZE[::-1], 200, np.uint8))
    assert detect_corners(CHARUCO, find_layout(CHARUCO, []), empty, SIZE).problem == "no board found"
    with pytest.raises(DhcalError, match=r"has 1280 x 960 px; the rig file states 640 x 480 px"):
        detect_corners(CHARUCO, find_layout(CHARUCO, []), empty, (640, 480))
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DhcalError, match="cannot be read as an image"):
        read_image(tmp_path / "text.png")


def test_an_image_of_an_impossible_width_is_refused(tmp_path):
    path = tmp_path / "wide.bmp"
    cv2.imwrite(str(path), np.zeros((2, 2), np.uint8))
    data = bytearray(path.read_bytes())
    data[18:22] = (3_000_000).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(DhcalError, match=r"wide\.bmp: "):
        read_image(path)


def test_a_damaged_video_is_refused_without_messages_of_its_library(tmp_path, capfd):
    path = tmp_path / "arm.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))  # pyright: ignore
    for _ in range(8):
        video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    data = path.read_bytes()
    assert len(read_stills(path)) == 1
    path.write_bytes(data.replace(b"movi", b"mowi"))
    with pytest.raises(DhcalError, match="no frames can be read"):
        read_stills(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.type)
def test_pdf_has_the_size_of_the_board(board):
    """One point is 1/72 inch; the page has a margin of 10 mm."""
    text = board_pdf(board)
    assert text.startswith(b"%PDF-1.6")
    box = text.split(b"/MediaBox [0 0 ")[1].split(b"]")[0].split()
    _, size = black_rectangles(board)
    np.testing.assert_allclose(np.array(box, float) * 25.4 / 72, 1e3 * np.array(size) + 20, atol=1e-3)


def test_corners_of_one_line_are_kept_as_they_are():
    """The rig states a board with two columns of corners, of which an image shows one."""
    points = np.array([[1.0, y] for y in range(1, 8)])
    pixels = np.array([[100.0, 40.0 * y] for y in range(1, 8)])
    found, is_visible = refine_crossings(np.zeros((400, 400), np.uint8), points, pixels, 0.1)
    assert np.array_equal(found, pixels)
    assert is_visible.all()
