"""Messages about mistakes in rig files and in files of corners: each names the file, and the line."""

from pathlib import Path

import pytest
from command_line import error_of, unfolded
from rig_files import BOARD_TABLE, CAMERA_TABLE

import dhcal_pin as dh

RIG = CAMERA_TABLE + BOARD_TABLE
# Corners of one image.
CORNERS = [(0, 300, 200), (1, 330, 201), (6, 301, 231), (7, 332, 230), (8, 361, 229)]


@pytest.fixture
def files(robot_folder):
    """Write a rig and a file with the corners of one image."""
    Path("rig.toml").write_text(RIG)
    write_corners(CORNERS)


def write_corners(corners, header="u[px],v[px],corner", more=""):
    """Write corners of one image after the values of the joints."""
    names = dh.read_robot("example:ur10", tip="tool0").joint_names
    lines = [",".join(f"{name}[deg]" for name in names) + f",{header}"]
    lines += [f"1,2,3,4,5,6,{u},{v},{number}{more}" for number, u, v in corners]
    Path("corners.csv").write_text("\n".join(lines))


CALIBRATE = (
    "calibrate",
    "example:ur10",
    "corners.csv",
    "--tip",
    "tool0",
    "--rig",
    "rig.toml",
    "-o",
    "out.urdf",
)
BOARD = ("board", "rig.toml", "-o", "board.pdf")
PLAN = ("plan", "example:ur10", "--tip", "tool0", "-n", "3", "--rig", "rig.toml", "-o", "poses.csv")


def check(run, command, *parts):
    """Check that a command is refused with one line that has some parts."""
    err = error_of(run(*command))
    for part in parts:
        assert part in unfolded(err)


@pytest.mark.parametrize(
    ("old", "new", "command", "message"),
    [
        ('"DICT_5X5_100"', '"DICT_9X9"', BOARD, "[board.table]: dictionary = 'DICT_9X9' is unknown; choose"),
        ("rows = 5", "rows = 90", BOARD, "[board.table]: 7 x 90 squares need 315 markers, and DICT_5X5_100"),
        ("[board.table]", "[board]", CALIBRATE, "[board]: no name; expected a table [board.NAME] with link"),
        ('link = "world"', 'link = "nix"', CALIBRATE, '[board.table]: link = "nix" is not a link of'),
        ("fx = 640.0\n", "", CALIBRATE, "[camera.wrist]: fy, cx, cy without fx"),
        ('"charuco"', '"chess"', BOARD, "[board.table]: type = 'chess'; choose from"),
        ("22.0", "40.0", BOARD, "[board.table]: marker_mm = 40.0; expected less than square_mm = 30"),
        ("", "", PLAN, "[camera.wrist] has no pose; expected an approximate one in its link"),
    ],
)
def test_mistakes_of_a_rig_name_its_file_and_table(run, files, old, new, command, message):
    if command is BOARD:
        pytest.importorskip("cv2")
    Path("rig.toml").write_text(RIG.replace(old, new, 1))
    check(run, command, f"dhcal: rig.toml: {message}")


@pytest.mark.parametrize(
    ("corners", "options", "message"),
    [
        (
            [*CORNERS, (24, 390, 200)],
            {},
            ":7: column 'corner': '24' is not a corner of board 'table'; expected",
        ),
        ([*CORNERS, ("a", 390, 200)], {}, ":7: column 'corner': 'a' is not a corner of board 'table'"),
        ([CORNERS[0], (1, 99999, 200)], {}, ":3: u = 99999, v = 200 px is far outside the images of camera"),
        (
            CORNERS,
            {"header": "u[px],v[px],corner,camera", "more": ",left"},
            ":2: column 'camera': 'left' is not",
        ),
        (
            CORNERS,
            {"header": "u[px],v[px],corner,board", "more": ",wall"},
            ":2: column 'board': 'wall' is not in",
        ),
        (
            CORNERS,
            {"header": "u[px],v[px],set"},
            ":1: no measured values; u, v alone is not enough; kind camera",
        ),
        (CORNERS, {}, ": camera 'wrist' and board 'table': 1 usable image; expected at least 3 at different"),
        (CORNERS[:3], {}, ": camera 'wrist': no image determines its pose; expected images with at least 4"),
    ],
)
def test_mistakes_of_corners_name_their_file_and_line(run, files, corners, options, message):
    write_corners(corners, **options)
    check(run, CALIBRATE, f"dhcal: corners.csv{message}")


def test_degrees_in_columns_of_radians_are_refused_before_the_fit(run, files):
    write_corners(CORNERS)
    text = (
        Path("corners.csv")
        .read_text()
        .replace("[deg]", "[rad]")
        .replace("1,2,3,4,5,6,", "10,-72,85,-95,20,40,")
    )
    Path("corners.csv").write_text(text)
    message = (
        "dhcal: corners.csv: joint shoulder_lift_joint reaches 72 rad, 11.5 turns; if the values are degrees"
    )
    check(run, CALIBRATE, message, "write [deg] in the header")


def test_far_corners_name_the_rig_to_correct(run, files):
    Path("rig.toml").write_text(RIG.replace("width = 1280", "width = 80"))
    check(run, CALIBRATE, "corners.csv:2: u = 300", "of 80 x 720 px; check width and height in rig.toml")


def test_ends_name_the_rig_to_correct(run, files):
    Path("rig.toml").write_text(RIG.replace('"world"', '"tip"'))
    check(run, CALIBRATE, "corners.csv: camera 'wrist' sees board 'table'", "correct a link in rig.toml")


def test_samples_without_a_file_have_numbers(files):
    """In Python a sample is named by its number."""
    arm = dh.read_robot("example:ur10", tip="tool0")
    from dhcal_pin.io.rig_file import read_rig
    from dhcal_pin.measurements import CameraCorners, mount_rig

    rig = mount_rig(read_rig("rig.toml"), arm)
    with pytest.raises(dh.DhcalError, match=r"^sample 2: column 'corner': '99' is not a corner"):
        CameraCorners([[0.0] * 6] * 2, [[1.0, 2.0]] * 2, [3, 99], rig)
