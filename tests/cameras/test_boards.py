"""Boards and rigs: corners in their order, prints of another size, and what a rig leaves open."""

from dataclasses import replace

import numpy as np
import pytest

from dhcal_pin.cameras import Board, Camera, Rig

CHARUCO = Board("c", "world", "charuco", columns=4, rows=3, square=0.03, marker=0.02)
GRID = Board("g", "tip", "aprilgrid", columns=2, rows=3, square=0.04, marker=0.04, spacing=0.01)
LISTED = Board("p", "tip", "points", listed_points=np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]]))


@pytest.mark.parametrize("kind", ["checkerboard", "charuco"])
def test_inner_corners_are_numbered_row_by_row(kind):
    inner = [[0.03, 0.03], [0.06, 0.03], [0.09, 0.03], [0.03, 0.06], [0.06, 0.06], [0.09, 0.06]]
    np.testing.assert_allclose(replace(CHARUCO, type=kind).points, np.pad(inner, ((0, 0), (0, 1))))


def test_corners_of_tags_are_numbered_tag_by_tag_clockwise():
    corners = [[0, 0], [0.04, 0], [0.04, 0.04], [0, 0.04]]
    origins = [[0, 0], [0.05, 0], [0, 0.05], [0.05, 0.05], [0, 0.1], [0.05, 0.1]]
    wanted = np.concatenate([np.array(corners) + origin for origin in origins])
    np.testing.assert_allclose(GRID.points, np.pad(wanted, ((0, 0), (0, 1))))
    np.testing.assert_array_equal(LISTED.points, LISTED.listed_points)


@pytest.mark.parametrize(
    ("board", "count"),
    [
        (CHARUCO, 6),
        (replace(CHARUCO, columns=5), 7),
        (GRID, 6),
        (replace(CHARUCO, type="checkerboard"), 0),
        (LISTED, 0),
    ],
)
def test_markers_are_in_every_other_square_or_are_tags(board, count):
    assert board.n_markers == count


def test_a_drawn_board_has_the_lengths_before_printing():
    lengths = ("square", "marker", "spacing")
    for board in (CHARUCO, GRID):
        printed = replace(board, **{name: 0.98 * getattr(board, name) for name in lengths}, print_scale=0.98)
        assert printed.drawn.print_scale == board.print_scale == 1.0
        for name in lengths:
            assert getattr(printed.drawn, name) == pytest.approx(getattr(board, name))
        np.testing.assert_allclose(printed.points, 0.98 * printed.drawn.points)


def test_a_board_without_a_file_has_its_name_and_no_properties():
    assert CHARUCO.where == "board 'c'"
    assert replace(CHARUCO, source="rig.toml: [board.c]").where == "rig.toml: [board.c]"
    for name in ("is_legacy", "has_free_points", "has_exact_points"):
        assert not getattr(CHARUCO, name)


def test_a_rig_is_complete_with_all_poses_and_lenses():
    values = np.array([500.0, 500, 319.5, 239.5, 0, 0, 0, 0, 0])
    camera = Camera("c", "world", 640, 480, values, pose=np.eye(4))
    board = replace(CHARUCO, pose=np.eye(4))
    np.testing.assert_array_equal(camera.image_centre, [319.5, 239.5])
    assert camera.lens.name == "pinhole"
    assert camera.has_intrinsics
    unknown = replace(camera, values=np.concatenate([values[:3], [np.nan], values[4:]]))
    assert not unknown.has_intrinsics
    for cameras, boards, is_complete in [
        ([camera], [board], True),
        ([camera, unknown], [board], False),
        ([replace(camera, pose=None)], [board], False),
        ([camera], [board, CHARUCO], False),
    ]:
        rig = Rig(
            {f"c{i}": each for i, each in enumerate(cameras)}, {f"b{i}": b for i, b in enumerate(boards)}
        )
        assert rig.is_complete == is_complete
