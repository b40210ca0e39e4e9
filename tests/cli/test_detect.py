"""Tests of `dhcal detect` and `dhcal board`."""

import os
from pathlib import Path

import numpy as np
import pytest
from command_line import rows_of, stderr_of, stdout_of, unfolded
from robots import DATA, missing

pytest.importorskip("cv2")

RIG = """[camera.fixed]
link = "world"
width = 1600
height = 1200
[board.target]
link = "tip"
type = "charuco"
columns = {columns}
rows = {rows}
square_mm = 36.195
marker_mm = 18.256
dictionary = "DICT_6X6_250"
"""


@pytest.fixture
def photographs(robot_folder):
    """Folder with photographs of a board of 5 x 7 squares, and a rig file."""
    folder = DATA / "charuco_images" / "images"
    if not folder.exists():
        missing(f"images at {folder}")
    Path("rig.toml").write_text(RIG.format(columns=5, rows=7))
    return folder


def test_corners_of_photographs_with_joint_values(run, photographs):
    names = sorted(path.name for path in photographs.iterdir())
    table = [
        "image,joint_1[deg],joint_2[deg]",
        *(f"{Path(name).stem},{i},{-i}" for i, name in enumerate(names)),
    ]
    Path("joints.csv").write_text("\n".join(table))
    command = ("detect", photographs, "--rig", "rig.toml", "--joints", "joints.csv", "-o", "corners.csv")
    err = stderr_of(run(*command))
    assert f"board target: 309 corners in {len(names)} of {len(names)} images" in unfolded(err)
    rows = rows_of("corners.csv")
    assert len(rows) == 309
    for row in rows:
        assert names[int(row["joint_1[deg]"])] == row["image"]
        assert 0 <= float(row["u[px]"]) < 1600
        assert 0 <= float(row["v[px]"]) < 1200
        assert 0 <= int(row["corner"]) < 24
    Path("joints.csv").write_text("\n".join([*table, "99.png,1,2"]))
    assert "joints.csv: 1 row has no image, such as '99.png'" in unfolded(run(*command)[2])


@pytest.mark.parametrize(
    ("comment", "column"), [("# rows: in order\n", "approach_joint_1"), ("", "time[s]"), ("", "payload[kg]")]
)
def test_order_and_conditions_of_photographs_are_kept(run, photographs, comment, column):
    """Photographs that were taken in another order than that of their names."""
    images = sorted(photographs.iterdir())[:6:2]
    taken = [images[1], images[2], images[0]]
    rows = [f"{image.name},{10 * i},{i - 1 if 'approach' in column else i}" for i, image in enumerate(taken)]
    Path("joints.csv").write_text("\n".join([f"{comment}image,joint_1[deg],{column}", *rows]))
    stdout_of(run("detect", *images, "--rig", "rig.toml", "--joints", "joints.csv", "-o", "corners.csv"))
    rows = rows_of("corners.csv")
    is_ordered = column != "payload[kg]"
    assert ("# rows: in order" in Path("corners.csv").read_text().splitlines()) == is_ordered
    order = list(dict.fromkeys(row["image"] for row in rows))
    assert order == [image.name for image in (taken if is_ordered else images)]
    values = dict.fromkeys((float(row["joint_1[deg]"]), float(row[column])) for row in rows)
    assert set(values) == {(10 * i, i - 1 if "approach" in column else i) for i in range(3)}


def test_exchanged_rows_and_columns_are_named(run, photographs):
    images = sorted(photographs.iterdir())[::3]
    stdout_of(run("detect", *images, "--rig", "rig.toml", "-o", "right.csv"))
    Path("rig.toml").write_text(RIG.format(columns=7, rows=5))
    err = stderr_of(run("detect", *images, "--rig", "rig.toml", "-o", "corners.csv"))
    assert "was printed with columns = 5, rows = 7" in unfolded(err)
    # The same corners, under the numbers of the other board.
    pixels = [
        np.array([[float(r["u[px]"]), float(r["v[px]"])] for r in rows_of(name)])
        for name in ("right.csv", "corners.csv")
    ]
    assert len(pixels[0]) == len(pixels[1]) > 100
    first, second = (each[np.lexsort(each.T)] for each in pixels)
    np.testing.assert_allclose(first, second)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("image,joint_1[deg]\nother,1\n", ["joints.csv", "no joint values of", "such as 'other'"]),
        ("name,joint_1[deg]\nother,1\n", ["joints.csv", "no column `image`"]),
        ("image,joint_1[deg]\nother,1\nother.png,2\n", ["joints.csv:3", "has a row already, line 2"]),
    ],
)
def test_wrong_joint_values_are_refused(assert_refused, photographs, table, words):
    Path("joints.csv").write_text(table)
    command = ("detect", photographs, "--rig", "rig.toml", "--joints", "joints.csv", "-o", "corners.csv")
    assert_refused(words, *command)


def test_images_of_another_size_and_folders_without_images_are_refused(assert_refused, photographs):
    Path("rig.toml").write_text(RIG.format(columns=5, rows=7).replace("1600", "800"))
    assert_refused(["1600 x 1200", "800"], "detect", photographs, "--rig", "rig.toml", "-o", "corners.csv")
    Path("empty").mkdir()
    assert_refused(["empty", "no images"], "detect", "empty", "--rig", "rig.toml", "-o", "corners.csv")
    assert_refused(
        ["--camera other", "choose from fixed"],
        *("detect", photographs, "--rig", "rig.toml", "--camera", "other", "-o", "corners.csv"),
    )


def test_images_that_take_too_much_memory_are_refused(assert_refused, photographs):
    """A file of 100 kB can hold 10⁸ pixels."""
    cv2 = pytest.importorskip("cv2")
    command = ("--rig", "rig.toml", "-o", "corners.csv")
    cv2.imwrite("large.png", np.zeros((10_000, 10_000), np.uint8))
    assert_refused(["large.png", "more than 50 million pixels"], "detect", "large.png", *command)
    Path("long.png").write_bytes(Path("large.png").read_bytes())
    os.truncate("long.png", (64 << 20) + 1)
    assert_refused(["long.png", "larger than 64 MiB"], "detect", "long.png", *command)
    Path("broken.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 1000)
    assert_refused(["broken.png", "cannot be read as an image"], "detect", "broken.png", *command)


def test_boards_are_drawn_as_pdf_only(assert_refused, photographs):
    assert_refused(
        ["board.png: unknown ending; write the board as .pdf"], "board", "rig.toml", "-o", "board.png"
    )


def test_board_is_drawn_at_its_true_scale(run, photographs):
    assert run("board", "rig.toml", "-o", "board.pdf")[0] == 0
    box = Path("board.pdf").read_bytes().split(b"/MediaBox [0 0 ")[1].split(b"]")[0].split()
    wanted = np.array([5, 7]) * 36.195 + 20
    np.testing.assert_allclose(np.array(box, float) * 25.4 / 72, wanted, atol=1e-3)
