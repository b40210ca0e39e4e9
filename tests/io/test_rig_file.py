"""Rig files: round trip, and messages about mistakes."""

import numpy as np
import pytest
from rig_files import BOARD_TABLE, CAMERA_TABLE

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.rig_file import read_rig, rig_text

CAMERA = CAMERA_TABLE + "distortion = [0.1, 0, 0, 0, 0]\n"


def write(path, text):
    path.write_text(text)
    return path


def test_values_of_the_file(tmp_path):
    rig = read_rig(write(tmp_path / "r.toml", CAMERA + BOARD_TABLE + "xyz_m = [1.0, 2.0, 3.0]\n"))
    camera, board = rig.cameras["wrist"], rig.boards["table"]
    np.testing.assert_array_equal(camera.values, [640, 641, 639.5, 359.5, 0.1, 0, 0, 0, 0])
    assert (camera.link, camera.intrinsics, camera.pose) == ("tip", "prior", None)
    # OpenCV draws the older pattern on request only.
    assert not board.is_legacy
    assert board.points.shape == (24, 3)
    np.testing.assert_allclose(board.points[[0, 5, 6]], [[0.03, 0.03, 0], [0.18, 0.03, 0], [0.03, 0.06, 0]])
    assert board.pose is not None
    np.testing.assert_array_equal(board.pose[:3, 3], [1, 2, 3])


def test_text_reads_back(tmp_path):
    points = '[board.p]\nlink = "world"\ntype = "points"\npoints_mm = [[0, 0, 1], [2, 0, 0]]\n'
    grid = '[board.g]\nlink = "tip"\ntype = "aprilgrid"\ncolumns = 2\nrows = 3\n'
    grid += "marker_mm = 40\nspacing_mm = 12\n"
    one = grid.replace(".g]", ".o]").replace("= 2\n", "= 1\n").replace("= 3\n", "= 1\n")
    unknown = '[camera.c]\nlink = "world"\nmodel = "fisheye"\nwidth = 64\nheight = 48\n'
    first = read_rig(write(tmp_path / "r.toml", CAMERA + unknown + BOARD_TABLE + points + one + grid))
    text = rig_text(list(first.cameras.values()), list(first.boards.values()))
    again = read_rig(write(tmp_path / "s.toml", text))
    assert text == rig_text(list(again.cameras.values()), list(again.boards.values()))
    np.testing.assert_allclose(again.boards["g"].points[[0, 1, 2, 3, 4]] * 1e3,
                               [[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0], [52, 0, 0]])  # fmt: skip
    assert again.boards["o"].points.shape == (4, 3)
    assert not again.cameras["c"].has_intrinsics


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOARD_TABLE, r"no \[camera.NAME\] table"),
        (CAMERA, r"no \[board.NAME\] table"),
        (CAMERA.replace("fy = 641.0\n", "") + BOARD_TABLE, "without fy; expected all of fx, fy, cx, cy"),
        (CAMERA.replace("fx = 640.0", "fx = -1.0") + BOARD_TABLE, "fx = -1.0; expected a number above 0"),
        (CAMERA + BOARD_TABLE.replace("22.0", "30.0"), "marker_mm = 30.0; expected less than square_mm = 30"),
        (CAMERA + BOARD_TABLE.replace("rows = 5", "rows = 1"), "expected at least 2 each"),
        (
            CAMERA + BOARD_TABLE.replace("22.0", "2e5"),
            "expected a length in millimetres above 0 and up to 100000",
        ),
        (CAMERA + BOARD_TABLE.replace("charuco", "chess"), 'choose from "checkerboard"'),
        (CAMERA + BOARD_TABLE + "squares = 3\n", "unknown key 'squares'"),
        (CAMERA.replace("1280", "12.5") + BOARD_TABLE, "width = 12.5; expected a whole number"),
        (CAMERA.replace("[0.1, 0, 0, 0, 0]", "[0.1]") + BOARD_TABLE, "distortion = .*; expected 5 numbers"),
    ],
)
def test_mistakes_are_named(tmp_path, text, message):
    with pytest.raises(DhcalError, match=message):
        read_rig(write(tmp_path / "r.toml", text))
