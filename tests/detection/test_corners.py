"""Boards in photographs and in drawings of known geometry."""

from __future__ import annotations

import numpy as np
import pytest
from robots import DATA, missing

from dhcal_pin.cameras import Board
from dhcal_pin.detection import black_rectangles, board_pdf, detect_corners, find_layout, read_image
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


@pytest.mark.parametrize(("columns", "rows", "wanted"), [(5, 7, False), (7, 5, True)])
def test_all_corners_of_photographs(columns, rows, wanted):
    """A board whose rows and columns are exchanged in the rig is found, and its layout is named."""
    board = Board("b", "tip", "charuco", columns=columns, rows=rows, square=0.036195, marker=0.018256,
                  dictionary="DICT_6X6_250")  # fmt: skip
    paths = photographs()
    layout = find_layout(board, [read_image(path) for path in paths[:3]])
    assert layout.is_exchanged == wanted
    assert bool(layout.describe(board)) == wanted or layout.is_legacy
    found = [detect_corners(board, layout, path, (1600, 1200)) for path in paths]
    assert sum(len(image.corner) for image in found) == 309
    # The corners of a flat board lie on a homography of the numbers of the rig.
    for image in found:
        if len(image.corner) > 8:
            homography, _ = cv2.findHomography(board.points[image.corner, :2], image.pixels)
            mapped = (
                np.column_stack([board.points[image.corner, :2], np.ones(len(image.corner))]) @ homography.T
            )
            assert np.abs(mapped[:, :2] / mapped[:, 2:] - image.pixels).max() < 6


def drawing(board, tmp_path, noise=2.0):
    """Render a board under a known homography with blur and noise; return the path and the homography."""
    rectangles, (width, height) = black_rectangles(board)
    scale, margin = 12000.0, 0.02
    sheet = np.full((int((height + 2 * margin) * scale), int((width + 2 * margin) * scale)), 235, np.uint8)
    for left, top, w, h in rectangles + np.array([margin, margin, 0, 0]):
        low, high = np.round([[left, top], [left + w, top + h]] * np.array(scale)).astype(int)
        sheet[low[1] : high[1], low[0] : high[0]] = 20
    corners = np.array([[0, 0], [sheet.shape[1], 0], sheet.shape[1::-1], [0, sheet.shape[0]]], np.float32)
    image_corners = np.array([[170, 120], [1130, 90], [1080, 850], [220, 780]], np.float32)
    homography = cv2.getPerspectiveTransform(corners, image_corners)
    # Pixel centres are whole numbers, in the sheet, too. The mean of 4 x 4 pixels lies between them.
    shift = np.array([[1, 0, -0.375], [0, 1, -0.375], [0, 0, 1.0]])
    large = cv2.warpPerspective(
        sheet,
        np.diag([4, 4, 1.0]) @ homography,
        (4 * SIZE[0], 4 * SIZE[1]),
        borderValue=235,
        flags=cv2.INTER_AREA,
    )
    image = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.8).astype(float)
    image += noise * np.random.default_rng(0).standard_normal(image.shape)
    path = str(tmp_path / "board.png")
    cv2.imwrite(path, np.clip(image, 0, 255).astype(np.uint8))
    points = np.column_stack([(board.points[:, :2] + margin) * scale - 0.5, np.ones(len(board.points))])
    mapped = points @ (shift @ homography).T
    return path, mapped[:, :2] / mapped[:, 2:]


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


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.type)
def test_corners_of_drawn_boards(board, tmp_path):
    path, wanted = drawing(board, tmp_path)
    layout = find_layout(board, [read_image(path)])
    found = detect_corners(board, layout, path, SIZE)
    assert found.problem == ""
    assert layout.describe(board) == "" or board.rows % 2
    assert len(found.corner) == len(board.points)
    error = found.pixels - wanted[found.corner]
    assert np.sqrt(np.mean(error**2)) < {"checkerboard": 0.06, "charuco": 0.1, "aprilgrid": 0.3}[board.type]


def test_images_that_are_not_used_are_named(tmp_path):
    empty = str(tmp_path / "empty.png")
    cv2.imwrite(empty, np.full(SIZE[::-1], 200, np.uint8))
    assert detect_corners(CHARUCO, find_layout(CHARUCO, []), empty, SIZE).problem == "no board found"
    with pytest.raises(DhcalError, match=r"has 1280 x 960 px; the rig file states 640 x 480 px"):
        detect_corners(CHARUCO, find_layout(CHARUCO, []), empty, (640, 480))
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(DhcalError, match="is no image that can be read"):
        read_image(tmp_path / "text.png")


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.type)
def test_pdf_has_the_size_of_the_board(board):
    """One point is 1/72 inch; the page has a margin of 10 mm."""
    text = board_pdf(board)
    assert text.startswith(b"%PDF-1.6")
    box = text.split(b"/MediaBox [0 0 ")[1].split(b"]")[0].split()
    _, size = black_rectangles(board)
    np.testing.assert_allclose(np.array(box, float) * 25.4 / 72, 1e3 * np.array(size) + 20, atol=1e-3)
