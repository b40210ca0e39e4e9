"""Command plan with --rig: poses that are read back and looked at, existing images, and wrong input."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import error_of, json_of, stderr_of, stdout_of, unfolded
from rig_files import BOARD_TABLE, CAMERA_TABLE

from dhcal_pin.io import read_configurations, read_robot
from dhcal_pin.io.rig_file import read_rig
from dhcal_pin.measurements import ViewLimits, is_board_in_view, mount_rig

pytestmark = pytest.mark.usefixtures("uneventful", "untried", "ordered_axes")

RIG = (
    f"{CAMERA_TABLE}xyz_m = [0.0, 0.06, 0.03]\nrotvec_rad = [0.0, 0.0, 0.0]\n"
    f"{BOARD_TABLE}xyz_m = [0.6, 0.1, 0.02]\nrotvec_rad = [3.14159, 0.0, 0.0]\n"
)
PLAN = ("plan", "example:ur10", "--tip", "tool0", "--rig", "rig.toml", "-o", "poses.csv")


@pytest.fixture(autouse=True)
def rig_folder(tmp_path, monkeypatch):
    """Working folder with a rig file."""
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(RIG)


def test_planned_poses_have_the_board_in_view(run):
    options = ("-n", 12, "--candidates", 60, "--distance", "250:500mm", "--angle", "40deg")
    pages = ("--html", "scene.html", "--report", "report.html", "--json", "plan.json")
    err = stderr_of(run(*PLAN, *options, *pages))
    assert "lower predicted error than 12 random poses" in err
    document = json.loads(Path("plan.json").read_text())
    (views,) = document["views"]
    assert (document["kind"], views["camera"], views["images"]) == ("camera", "wrist", 12)
    assert 0.25 <= views["distance_min_m"] < views["distance_max_m"] <= 0.5
    assert views["angle_max_rad"] <= np.deg2rad(40)
    assert 0.3 < views["covered_share"] <= 1
    assert f"{100 * views['covered_share']:.0f} %" in err
    assert max(map(len, err.splitlines())) <= 80
    arm = read_robot("example:ur10", tip="tool0")
    q = read_configurations("poses.csv", arm)
    rig = mount_rig(read_rig("rig.toml"), arm)
    # The angles of the file have four decimals: a pixel of tolerance.
    limits = ViewLimits(0.249, 0.501, np.deg2rad(40.1), 1.0, 24.0)
    assert is_board_in_view(rig, 0, 0, arm.poses(q), limits).all()
    assert "Images of the boards" in Path("report.html").read_text()
    assert '"name":"wrist"' in Path("scene.html").read_text()


def test_missing_poses_are_estimated_from_images(run):
    """Ten more poses for images of a rig without poses: of the simulated one, with two cameras."""
    arm, sizes = ("example:ur10", "--tip", "tool0"), ("-n", 6, "--candidates", 100)
    run("simulate", *arm, "--kind", "camera", "-m", 12, "--noise", "0.3mm", "-o", "images.csv")
    plan = ("plan", *arm, "--rig", "images.rig.toml", *sizes, "--json", "-")
    more = json_of(run(*plan, "-o", "more.csv", "--data", "images.csv"))
    assert [one["camera"] for one in more["views"]] == ["left", "right"]
    assert sum(one["images"] for one in more["views"]) >= 6
    assert any("hides points of 'target' is not checked" in note for note in more["notes"])
    out = stdout_of(run(*plan, "-o", "chosen.csv", "--data", "images.csv", "--from", "images.csv"))
    rows = np.array(json.loads(out)["rows"]) - 1
    # A configuration has one row for each of the six corners.
    assert len(set(rows // 6)) == 6
    assert np.all(rows % 6 == 0)
    err = error_of(run(*plan, "-o", "none.csv"))
    assert unfolded(err).startswith("dhcal: images.rig.toml: [camera.left] has no pose; expected")
    assert not Path("none.csv").exists()


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (("xyz_m = [0.0, 0.06, 0.03]\nrotvec_rad = [0.0, 0.0, 0.0]\n", ""), (), "[camera.wrist] has no pose"),
        (("fx = 640.0\nfy = 641.0\ncx = 639.5\ncy = 359.5\n", ""), (), "[camera.wrist] has no fx, fy"),
        (("[0.6, 0.1, 0.02]", "[6.0, 0.1, 0.02]"), (), "no camera can see a board in any pose"),
        (("[3.14159, 0.0, 0.0]", "[0.0, 0.0, 0.0]"), (), "z axis of a board points away"),
        (('link = "world"', 'link = "tip"'), (), "no joint moves a board against a camera"),
        (("", ""), ("--distance", "5:6m"), "no camera can see a board in any pose"),
        (("", ""), ("--distance", "1:20mm"), "does not fit into the image"),
        (("", ""), ("--distance", "900:300mm"), "must be at least 0 and less than the second"),
        (("", ""), ("--distance", "300mm"), "such as 300:900mm"),
        (("", ""), ("--angle", "0deg"), "--angle 0deg: invalid angle"),
        (("", ""), ("--corners", "1.5"), "--corners 1.5: expected a share above 0 and at most 1"),
        (("", ""), ("--border", "60"), "--border 60: expected pixels above zero, such as 60px"),
        (("", ""), ("--border", "500px"), "does not fit into the image"),
        (("", ""), ("--sigma", "0.1mm"), "--sigma 0.1mm: expected pixels above zero first"),
        (("", ""), ("--sigma", "0.3px,1deg,2deg"), "second angle"),
        (("", ""), ("--kind", "position"), "--kind position: not allowed with --rig"),
        (("", ""), ("--data", "positions.csv"), "a plan of images complements images"),
        (("", ""), ("--from", "positions.csv"), "0 of 20 candidates are feasible; expected"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_line(run, change, options, message):
    Path("rig.toml").write_text(RIG.replace(*change) if change[0] else RIG)
    if "positions.csv" in options:
        run(
            "simulate",
            "example:ur10",
            "--tip",
            "tool0",
            "--kind",
            "position",
            "-m",
            20,
            "-o",
            "positions.csv",
        )
    err = error_of(run(*PLAN, "-n", 5, "--candidates", 50, *options))
    assert err.startswith("dhcal: ")
    assert message in unfolded(err)
    assert not Path("poses.csv").exists()


@pytest.mark.parametrize("option", [("--distance", "300:900mm"), ("--angle", "50deg"), ("--corners", "0.5")])
def test_options_of_views_need_a_rig(run, option):
    err = error_of(run("plan", "example:ur10", "-n", 5, "-o", "poses.csv", *option))
    assert f"{option[0]}: needs --rig" in unfolded(err)
    err = error_of(run("plan", "example:ur10", "-n", 5, "-o", "poses.csv", "--kind", "camera"))
    assert "--kind camera: needs --rig" in unfolded(err)
