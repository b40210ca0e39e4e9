"""Boards on a sheet of paper, with the measured scale of the printer, and photographs or a video of them."""

import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from command_line import stderr_of, unfolded

from dhcal_pin.cameras.boards import RULER
from dhcal_pin.io.rig_file import read_rig
from dhcal_pin.se3 import exp3, transform

cv2 = pytest.importorskip("cv2")

RIG = """[camera.webcam]
link = "world"
width = 320
height = 240
[board.paper]
link = "tip"
type = "checkerboard"
columns = 9
rows = 6
square_mm = 25
"""
POINT = 25.4 / 72  # [mm]


def rectangles(path: str) -> np.ndarray:
    """Rectangles of a PDF: left, bottom, width and height [mm]."""
    content = zlib.decompress(Path(path).read_bytes().split(b"stream\n")[1].split(b"\nendstream")[0]).decode()
    found = re.findall(r"^([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", content, re.MULTILINE)
    return POINT * np.array(found, float)


@pytest.mark.parametrize(("paper", "size"), [("a4", (297, 210)), ("letter", (279.4, 215.9))])
def test_board_and_ruler_are_on_the_sheet_at_their_true_scale(run, robot_folder, paper, size):
    Path("rig.toml").write_text(RIG)
    err = stderr_of(run("board", "rig.toml", "--paper", paper, "-o", "board.pdf"))
    assert "ruler_mm = 149.6" in unfolded(err)
    box = Path("board.pdf").read_bytes().split(b"/MediaBox [0 0 ")[1].split(b"]")[0].split()
    np.testing.assert_allclose(POINT * np.array(box, float), size, atol=1e-3)
    drawn = rectangles("board.pdf")
    squares, ruler = drawn[:27], drawn[27:]
    np.testing.assert_allclose(squares[:, 2:], 25, atol=1e-3)
    assert (ruler[:, 0] + ruler[:, 2]).max() - ruler[:, 0].min() == pytest.approx(1e3 * RULER, abs=1e-3)
    # No printer prints to the edge of a sheet.
    assert drawn[:, :2].min() > 8
    assert np.all(drawn[:, :2] + drawn[:, 2:] < np.array(size) - 8)
    assert squares[:, 1].min() > ruler[:, 1].max() + 6


def test_measured_ruler_scales_the_board_and_not_its_drawing(run, robot_folder):
    Path("rig.toml").write_text(RIG)
    assert run("board", "rig.toml", "--paper", "a4", "-o", "drawn.pdf")[0] == 0
    Path("rig.toml").write_text(RIG + "ruler_mm = 148.5\n")
    board = read_rig("rig.toml").boards["paper"]
    assert board.square == pytest.approx(0.025 * 0.99)
    np.testing.assert_allclose(board.points[-1], 0.99 * 0.025 * np.array([8, 5, 0]))
    assert run("board", "rig.toml", "--paper", "a4", "-o", "again.pdf")[0] == 0
    np.testing.assert_allclose(rectangles("again.pdf"), rectangles("drawn.pdf"), atol=1e-3)


def test_wrong_ruler_and_large_boards_are_refused(assert_refused, robot_folder):
    Path("rig.toml").write_text(RIG + "ruler_mm = 14.9\n")
    command = ("board", "rig.toml", "--paper", "a4", "-o", "board.pdf")
    assert_refused(["rig.toml", "ruler_mm", "14.9", "drawn 150 mm long"], *command)
    Path("rig.toml").write_text(RIG.replace("25", "40"))
    assert_refused(["rig.toml", "360 x 240 mm does not fit on a4", "277 x 170 mm"], *command)


def test_video_gives_one_still_per_pause(run, robot_folder):
    """The board moves between five poses and stops at each for half a second; the first one is repeated."""
    from dhcal_pin.detection import render_images

    Path("rig.toml").write_text(RIG.replace("columns = 9\nrows = 6", "columns = 6\nrows = 5"))
    rig = read_rig("rig.toml")
    board = rig.boards["paper"]
    camera = rig.cameras["webcam"].__class__(
        "webcam", "world", 320, 240, np.array([300, 300, 159.5, 119.5, 0, 0, 0, 0, 0.0])
    )
    rng = np.random.default_rng(0)
    centre = transform(np.eye(3), -board.points.mean(0))
    turns = rng.normal(0, 0.25, (5, 3))
    places = np.column_stack([rng.uniform(-0.03, 0.03, (5, 2)), rng.uniform(0.3, 0.38, 5)])
    stops = [transform(exp3(v), p) @ centre for v, p in zip(turns, places, strict=True)]
    moving = list(render_images(camera, [[(board, pose)] for pose in stops], rng))
    video = cv2.VideoWriter("arm.avi", cv2.VideoWriter_fourcc(*"MJPG"), 20, (320, 240))
    for before, after in zip([moving[-1], *moving], moving, strict=False):
        for share in np.linspace(0.1, 0.9, 6):  # motion
            blend = (1 - share) * before + share * after
            video.write(cv2.cvtColor(np.uint8(blend), cv2.COLOR_GRAY2BGR))
        for _ in range(12):
            noisy = np.clip(after + rng.normal(0, 2, after.shape), 0, 255)
            video.write(cv2.cvtColor(np.uint8(noisy), cv2.COLOR_GRAY2BGR))
    video.release()
    counts = [f"arm-{i:03d},{2000 + i}" for i in range(1, 6)]
    Path("joints.csv").write_text("\n".join(["image,shoulder_pan[ticks]", *counts]))
    err = stderr_of(run(
        "detect", "arm.avi", "--rig", "rig.toml", "--joints", "joints.csv", "--stills", "stills",
        "-o", "corners.csv", "--verbose",
    ))  # fmt: skip
    assert "5 pauses" in unfolded(err)
    assert sorted(path.name for path in Path("stills").iterdir()) == [f"arm-{i:03d}.png" for i in range(1, 6)]
    lines = [line.split(",") for line in Path("corners.csv").read_text().splitlines() if line[0] != "#"]
    assert lines[0][0] == "shoulder_pan[ticks]"
    for i, pose in enumerate(stops, 1):
        rows = [line for line in lines[1:] if line[-1] == f"arm-{i:03d}.png"]
        assert {line[0] for line in rows} == {str(2000 + i)}
        local = board.points @ pose[:3, :3].T + pose[:3, 3]
        exact = camera.lens.project(local.T, camera.values)[0].T[[int(line[3]) for line in rows]]
        found = np.array([line[1:3] for line in rows], float)
        # A checkerboard of 6 x 5 squares has one orientation only.
        assert np.sqrt(np.mean((found - exact) ** 2)) < 0.3
    # Nothing is kept if another input is wrong.
    assert run("detect", "arm.avi", "--rig", "no.toml", "--stills", "other", "-o", "other.csv")[0] == 2
    assert not Path("other").exists()


def test_video_without_pauses_is_refused(assert_refused, robot_folder):
    Path("rig.toml").write_text(RIG)
    video = cv2.VideoWriter("arm.avi", cv2.VideoWriter_fourcc(*"MJPG"), 20, (320, 240))
    rng = np.random.default_rng(0)
    for _ in range(30):
        video.write(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
    video.release()
    command = ("detect", "arm.avi", "--rig", "rig.toml", "-o", "corners.csv")
    assert_refused(["arm.avi", "something moves in all frames"], *command)
    Path("arm.avi").write_bytes(b"RIFF")
    assert_refused(["arm.avi", "no frames can be read"], *command)
    assert_refused(["--stills", "needs a video"], "detect", ".", *command[2:], "--stills", "x")
