"""Rig files: round trip, and messages about mistakes."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from rig_files import BOARD_TABLE, CAMERA_TABLE

from dhcal_pin import se3
from dhcal_pin.cameras import LENSES, Board, Camera, Rig
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.rig_file import (
    _first_pose,
    only_entry,
    read_calibrated_rig,
    read_rig,
    rig_content,
    rig_text,
    with_estimates_of,
    with_poses_of,
)

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


POINTS = '[board."p.q"]\nlink = "tip"\ntype = "points"\npoints_mm = [[0, 0, 1], [2, 0, 0]]\n'
CHECKERS = '[board.c]\nlink = "world"\ntype = "checkerboard"\ncolumns = 4\nrows = 3\nsquare_mm = 25\n'
TAGS = '[board.g]\nlink = "tip"\ntype = "aprilgrid"\ncolumns = 2\nrows = 3\nmarker_mm = 40\nspacing_mm = 12\n'
UNKNOWN = '[camera.c]\nlink = "world"\nmodel = "fisheye"\nwidth = 64\nheight = 48\n'


def board_of(tmp_path, table):
    """Read the only board of a table."""
    (board,) = read_rig(write(tmp_path / "r.toml", CAMERA + table)).boards.values()
    return board


@pytest.mark.parametrize(
    ("table", "lengths"),
    [
        (BOARD_TABLE, (0.03, 0.022, 0.0)),
        (CHECKERS, (0.025, 0.0, 0.0)),
        # A square of an AprilGrid is a tag.
        (TAGS, (0.04, 0.04, 0.012)),
    ],
)
@pytest.mark.parametrize("ruler", [None, 150.0, 147.0])
def test_lengths_of_a_board_are_those_of_its_print(tmp_path, table, lengths, ruler):
    """The ruler line is drawn 150 mm long."""
    board = board_of(tmp_path, table + (f"ruler_mm = {ruler}\n" if ruler else ""))
    scale = (ruler or 150.0) / 150.0
    assert board.print_scale == pytest.approx(scale)
    found = (board.square, board.marker, board.spacing)
    assert found == pytest.approx(tuple(scale * each for each in lengths))


@pytest.mark.parametrize(
    ("ruler", "is_possible"), [(134.9, False), (135.1, True), (164.9, True), (165.1, False)]
)
def test_a_print_is_within_a_tenth_of_the_drawing(tmp_path, ruler, is_possible):
    text = f"{CHECKERS}ruler_mm = {ruler}\n"
    if is_possible:
        assert board_of(tmp_path, text).print_scale == pytest.approx(ruler / 150)
    else:
        with pytest.raises(
            DhcalError, match="expected the measured length of the ruler line, which is drawn 150 mm"
        ):
            board_of(tmp_path, text)


@pytest.mark.parametrize(
    ("points", "is_free", "is_exact"),
    [("auto", False, False), ("prior", True, False), ("fixed", False, True)],
)
def test_points_of_a_board_are_estimated_or_not(tmp_path, points, is_free, is_exact):
    board = board_of(tmp_path, f'{POINTS}points = "{points}"\n')
    assert (board.has_free_points, board.has_exact_points) == (is_free, is_exact)
    assert board.name == "p.q"
    np.testing.assert_allclose(board.points, [[0, 0, 1e-3], [2e-3, 0, 0]])


@pytest.mark.parametrize(
    ("table", "old", "smallest", "largest"),
    [
        (CHECKERS, "columns = 4", 2, 1000),
        (CHECKERS, "rows = 3", 2, 1000),
        (BOARD_TABLE, "columns = 7", 2, 1000),
        (TAGS, "columns = 2", 1, 1000),
        (TAGS, "rows = 3", 1, 1000),
    ],
)
def test_numbers_of_squares_and_tags(tmp_path, table, old, smallest, largest):
    key = old.split(" = ")[0]
    for count in (smallest, largest):
        assert getattr(board_of(tmp_path, table.replace(old, f"{key} = {count}")), key) == count
    for count in (smallest - 1, largest + 1):
        with pytest.raises(DhcalError, match="expected"):
            board_of(tmp_path, table.replace(old, f"{key} = {count}"))


@pytest.mark.parametrize(
    ("length", "is_possible"), [(1e-3, True), (1e5, True), (0.0, False), (100_001, False)]
)
def test_lengths_of_squares_and_places_of_points(tmp_path, length, is_possible):
    """Points may be at the origin and on both sides of it."""
    squares = CHECKERS.replace("square_mm = 25", f"square_mm = {length}")
    points = POINTS.replace("[2, 0, 0]", f"[0, {-length}, 0]")
    for table, is_allowed in ((squares, is_possible), (points, is_possible or not length)):
        if is_allowed:
            assert np.abs(board_of(tmp_path, table).points).max() >= 1e-3 * length
        else:
            with pytest.raises(DhcalError, match="expected"):
                board_of(tmp_path, table)


@pytest.mark.parametrize("key", ["width", "height"])
def test_sizes_of_images(tmp_path, key):
    for size, is_possible in ((1, True), (100_000, True), (0, False), (100_001, False)):
        old = {"width": "1280", "height": "720"}[key]
        path = write(tmp_path / "r.toml", CAMERA.replace(f"{key} = {old}", f"{key} = {size}") + CHECKERS)
        if is_possible:
            assert getattr(read_rig(path).cameras["wrist"], key) == size
        else:
            with pytest.raises(DhcalError, match=rf"{key} = {size}; expected"):
                read_rig(path)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('intrinsics = "fixed"\n', r'intrinsics = "fixed" without values; expected fx, fy, cx, cy'),
        ("distortion = [0, 0, 0, 0]\n", "distortion without fx, fy, cx, cy; expected all of them or none"),
        ("fx = 1.0\nfy = 1.0\ncx = 1.0\n", "fx, fy, cx without cy; expected all of"),
        ("fx = 1.0\nfy = 1.0\ncx = 1.0\ncy = 1.0\ndistortion = [0, 0, 0, 0, 0]\n", "expected 4 numbers"),
    ],
)
def test_a_lens_is_stated_as_a_whole(tmp_path, more, message):
    with pytest.raises(DhcalError, match=message):
        read_rig(write(tmp_path / "r.toml", UNKNOWN + more + CHECKERS))


def test_a_first_pose_needs_one_of_its_keys():
    pose = _first_pose({"xyz_m": None, "rotvec_rad": [0.0, 0, np.pi / 2]})
    assert pose is not None
    np.testing.assert_allclose(pose, [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-12)
    assert _first_pose({"xyz_m": None, "rotvec_rad": None}) is None


def test_content_of_a_rig_file(tmp_path):
    """What is not stated is not written; other lenses and boards have other keys."""
    tags = TAGS + 'points = "prior"\nxyz_m = [1.0, 2.0, 3.0]\nrotvec_rad = [0.0, 0.5, 0.0]\n'
    text = (
        CAMERA + UNKNOWN + BOARD_TABLE + CHECKERS + tags + POINTS.replace('"p.q"', "p") + 'points = "fixed"\n'
    )
    rig = read_rig(write(tmp_path / "r.toml", text))
    content = rig_content(list(rig.cameras.values()), list(rig.boards.values()))
    near = partial(pytest.approx, abs=1e-12)
    sizes = {"columns": 4, "rows": 3}
    assert content["camera"] == {
        "wrist": {
            "link": "tip", "model": "pinhole", "width": 1280, "height": 720, "fx": 640.0, "fy": 641.0,
            "cx": 639.5, "cy": 359.5, "distortion": [0.1, 0, 0, 0, 0], "intrinsics": "prior",
        },
        "c": {"link": "world", "model": "fisheye", "width": 64, "height": 48},
    }  # fmt: skip
    assert content["board"] == {
        "table": {
            "link": "world", "type": "charuco", "columns": 7, "rows": 5, "square_mm": near(30.0),
            "marker_mm": near(22.0), "legacy": False, "dictionary": "DICT_5X5_100",
        },
        "c": {"link": "world", "type": "checkerboard", **sizes, "square_mm": near(25.0)},
        "g": {
            "link": "tip", "type": "aprilgrid", "columns": 2, "rows": 3, "marker_mm": near(40.0),
            "spacing_mm": near(12.0), "dictionary": "DICT_APRILTAG_36h11", "points": "prior",
            "xyz_m": [1.0, 2.0, 3.0], "rotvec_rad": near([0.0, 0.5, 0.0]),
        },
        "p": {"link": "tip", "type": "points", "points_mm": [near([0, 0, 1]), near([2, 0, 0])],
              "points": "fixed"},
    }  # fmt: skip


def test_a_sidecar_with_cameras_and_boards_has_a_rig(tmp_path):
    for text, is_rig in ((CAMERA + CHECKERS, True), (CAMERA, False), (CHECKERS, False), ("", False)):
        path = write(tmp_path / "arm.calibration.toml", text + '[other]\nkey = "value"\n')
        rig = read_calibrated_rig(path)
        assert (rig is not None) == is_rig
        if rig:
            assert (list(rig.cameras), list(rig.boards), rig.source) == (["wrist"], ["c"], str(path))


POSES = se3.exp6(np.random.default_rng(0).normal(size=(4, 6)))
LENS = np.array([500.0, 500, 319.5, 239.5, 0, 0, 0, 0, 0])
BODY = np.random.default_rng(1).normal(size=(6, 3))


def rig_of(camera_pose, board_pose, name="a", **changes):
    """Return a rig of a camera and a board with the same name."""
    camera = Camera(name, "tip", 640, 480, LENS, pose=camera_pose)
    board = Board(name, "world", "checkerboard", columns=4, rows=3, square=0.02, pose=board_pose)
    return Rig({name: replace(camera, **changes)}, {name: board}, "rig.toml")


def test_missing_poses_are_those_of_another_rig():
    """A board keeps its pattern; entries with a pose and entries of other names stay."""
    points = Board("a", "tip", "points", listed_points=BODY, pose=POSES[1])
    other = replace(rig_of(POSES[0], None, values=2 * LENS), boards={"a": points})
    found = with_poses_of(rig_of(None, None), other)
    assert found.cameras["a"] is other.cameras["a"]
    board = found.boards["a"]
    assert (board.type, board.link) == ("checkerboard", "tip")
    assert board.pose is points.pose
    for kept in (rig_of(POSES[2], POSES[3]), rig_of(None, None, "b")):
        found = with_poses_of(kept, other)
        assert found.cameras == kept.cameras
        assert found.boards == kept.boards


def test_estimates_are_those_of_the_same_entries():
    points = Board("a", "base_link", "points", listed_points=BODY, pose=POSES[1])
    calibrated = replace(rig_of(POSES[0], None, link="tool0"), boards={"a": points}, source="arm.toml")
    ends = {"world": "base_link", "tip": "tool0"}
    plain = rig_of(None, None)
    rig = replace(plain, cameras={**plain.cameras, "b": plain.cameras["a"]})
    found = with_estimates_of(rig, calibrated, ends)
    assert found.cameras == {"a": calibrated.cameras["a"], "b": rig.cameras["b"]}
    assert found.boards == calibrated.boards
    changes = [
        (
            {"link": "world"},
            r"\[camera.a\]: link base_link, but tool0 in arm.toml; expected the camera of the cal",
        ),
        ({"width": 641}, r"\[camera.a\]: images 641 x 480 px, but 640 x 480 px in arm.toml"),
        ({"lens": LENSES["fisheye"]}, r"\[camera.a\]: model fisheye, but pinhole in arm.toml"),
    ]
    for change, message in changes:
        with pytest.raises(DhcalError, match=rf"^rig.toml: {message}"):
            with_estimates_of(rig_of(None, None, **change), calibrated, ends)
    fewer = replace(calibrated, boards={"a": replace(points, listed_points=BODY[:5])})
    with pytest.raises(
        DhcalError, match=r"\[board.a\]: number of corners 6, but 5 in arm.toml; expected the board"
    ):
        with_estimates_of(rig, fewer, ends)


def test_the_only_entry_needs_no_name():
    one, two = {"a": rig_of(None, None).cameras["a"]}, rig_of(None, None).cameras
    two = {**two, "b": two["a"]}
    assert only_entry(one, None, "camera", "rig.toml") is one["a"]
    assert only_entry(two, "b", "camera", "rig.toml") is two["b"]
    for entries, name, message in [
        (two, None, r"^rig.toml: has several entries \[camera.NAME\]; choose one with --camera: a, b$"),
        (one, "c", r"^--camera c: rig.toml has no \[camera.c\]; choose from a$"),
    ]:
        with pytest.raises(DhcalError, match=message):
            only_entry(entries, name, "camera", "rig.toml")


@pytest.mark.parametrize(("model", "count"), [("pinhole", 5), ("fisheye", 4)])
def test_a_lens_without_stated_distortion_has_none(tmp_path, model, count):
    table = f'{CAMERA_TABLE}model = "{model}"\nintrinsics = "free"\n'
    camera = read_rig(write(tmp_path / "r.toml", table + UNKNOWN + CHECKERS)).cameras["wrist"]
    np.testing.assert_array_equal(camera.values, [640, 641, 639.5, 359.5, *[0.0] * count])
    assert (camera.lens.name, camera.intrinsics) == (model, "free")
