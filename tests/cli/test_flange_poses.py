"""A hand-eye calibration from poses of the flange states nothing about the joint space of a robot."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from camera_setups import ARMS, simulate
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.io.rig_file import rig_text

pytestmark = pytest.mark.usefixtures("uneventful", "ordered_axes")


def write_images(
    seed: int, is_on_wrist: bool, arm: str = "ur10", of_poses=lambda poses: poses, n_images: int = 20
):
    """Write simulated images with a function of the poses of the flange, and their rig; return the truth."""
    chain, rng = ARMS[arm](), np.random.default_rng(seed)
    setup = simulate(chain, chain, rng, is_on_wrist=is_on_wrist, n_images=n_images, sigma=0.1)
    images = setup.images
    lines = ["x[m],y[m],z[m],rx[rad],ry[rad],rz[rad],u[px],v[px],corner"]
    for pose, pixels, corner in zip(
        of_poses(chain.poses(images.q)), images.values, images.corner, strict=True
    ):
        values = [*pose[:3, 3], *se3.log3(pose[:3, :3]), *pixels]
        lines.append(",".join([*(repr(float(value)) for value in values), str(corner)]))
    Path("images.csv").write_text("\n".join(lines))
    Path("rig.toml").write_text(rig_text(images.rig.cameras, images.rig.boards))
    return setup.exact.rig


@pytest.fixture
def flange_files(tmp_path, monkeypatch):
    """Write simulated images with poses of the flange, and their rig, into an empty folder."""
    monkeypatch.chdir(tmp_path)
    write_images(5, is_on_wrist=True)


def test_nothing_is_stated_about_joint_space(run, flange_files):
    status, _, err = run(
        *("calibrate", "flange.urdf", "images.csv", "--rig", "rig.toml", "--verbose"),
        *("--report", "report.md", "--json", "fit.json", "--map", "map.html", "-o", "out.urdf"),
    )
    assert status == 0, err
    document, report = json.loads(Path("fit.json").read_text()), Path("report.md").read_text()
    assert (document["covered_share"], document["reached_share"]) == (None, None)
    assert document["holdout_region_after"]
    assert "image error among the measured poses" in err
    assert "image error outside of them" in err
    assert "Among the measured poses: " in report
    for text in (err, report):
        assert not re.search("% of (the )?joint space|[Mm]easured region|[Mm]easured joint values", text)
        assert "Added to the geometry" not in text
    # The sidecar has no measured region either: `validate` cannot say what is outside of it.
    assert "[measured]" not in Path("out.calibration.toml").read_text()
    # Nothing of the robot is uncertain, and nothing of it has changed.
    assert "Predicted accuracy" not in report
    assert "No parameter of the robot was estimated" in Path("map.html").read_text()
    assert "before and after are errors of the same arm" in report
    (noise,) = re.findall(r"pixels ([0-9.]+) px, estimated", report)
    assert float(noise) == pytest.approx(0.1, rel=0.15)


def test_a_robot_with_joint_values_has_a_measured_region(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("simulate", "example:ur10", "--tip", "tool0", "-m", "20", "--kind", "camera", "-o", "images.csv")
    status, _, err = run(
        *("calibrate", "example:ur10", "images.csv", "--tip", "tool0", "--rig", "images.rig.toml"),
        *("--parameters", "camera,board", "--json", "fit.json", "-o", "out.urdf", "--verbose"),
    )
    assert status == 0, err
    assert 0 < json.loads(Path("fit.json").read_text())["covered_share"] <= 1
    assert "Inside: measured region, " in err


CALIBRATE = (
    "calibrate",
    "flange.urdf",
    "images.csv",
    "--rig",
    "rig.toml",
    "-o",
    "out.urdf",
    "--json",
    "fit.json",
)


def written_position(rig_name: str) -> np.ndarray:
    """Return the position of the camera in its link from the written sidecar [m]."""
    camera = tomllib.loads(Path("out.calibration.toml").read_text())["camera"][rig_name]
    return np.array(camera["xyz_m"])


@pytest.mark.usefixtures("inside_only")
@pytest.mark.parametrize(
    ("arm", "seed", "is_on_wrist"), some_slow([("ur10", 5, True), ("panda", 4, False)], {1})
)
def test_inverse_flange_poses_are_named_beside_exchanged_links(
    run, tmp_path, monkeypatch, arm, seed, is_on_wrist
):
    """Both give the same images; the distances to the stated links let a user decide."""
    monkeypatch.chdir(tmp_path)
    true = write_images(seed, is_on_wrist, arm, se3.inverse, 10).camera_in_end(0)[:3, 3]
    status, _, err = run(*CALIBRATE)
    assert status == 3
    assert not Path("out.urdf").exists()
    (reason,) = json.loads(Path("fit.json").read_text())["verdict"]["reasons"]
    link, other = ("tip", "world") if is_on_wrist else ("world", "tip")
    assert "inverse flange poses (of the base in the flange), or exchanged links" in reason
    distance = re.search(
        r"If the poses are inverse, camera 'camera0' is ([0-9.]+) mm from link '(\w+)'", reason
    )
    assert distance
    assert float(distance[1]) == pytest.approx(1e3 * np.linalg.norm(true), rel=0.05)
    assert distance[2] == link
    assert f"If camera 'camera0' is on link '{link}', invert the poses, or add --mend poses:inverse" in reason
    assert f"if it is on link '{other}', exchange the links in the rig file" in reason
    status, _, err = run(*CALIBRATE, "--mend", "poses:inverse")
    assert status == 0, err
    assert "flange poses changed by --mend poses:inverse" in " ".join(err.split())
    assert json.loads(Path("fit.json").read_text())["verdict"]["status"] == "ok"
    assert written_position("camera0") == pytest.approx(true, abs=1e-3)


@pytest.mark.usefixtures("inside_only")
def test_exchanged_links_are_named_beside_inverse_flange_poses(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    true = write_images(5, is_on_wrist=True, n_images=10).camera_in_end(0)[:3, 3]
    right = Path("rig.toml").read_text()
    exchanged = right.replace('"tip"', '"none"').replace('"world"', '"tip"').replace('"none"', '"world"')
    Path("rig.toml").write_text(exchanged)
    status, _, _ = run(*CALIBRATE)
    assert status == 3
    (reason,) = json.loads(Path("fit.json").read_text())["verdict"]["reasons"]
    assert "if it is on link 'tip', exchange the links in the rig file" in reason
    Path("rig.toml").write_text(right)
    assert run(*CALIBRATE)[0] == 0
    assert written_position("camera0") == pytest.approx(true, abs=1e-3)


def test_a_robot_that_reaches_the_inverse_poses_only_says_so(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_images(4, is_on_wrist=True, arm="panda", of_poses=se3.inverse)
    options = ("calibrate", "example:panda", "--tip", "panda_link8", *CALIBRATE[2:])
    status, _, err = run(*options)
    assert status == 2
    assert "it reaches the inverse of all poses: invert them" in err
    # Of right poses beyond its reach, the robot does not reach the inverse ones either.
    write_images(
        5, is_on_wrist=True, of_poses=lambda poses: poses @ se3.transform(np.eye(3), np.full(3, 2.0))
    )
    status, _, err = run(*options)
    assert status == 2
    assert "does not reach the pose" in err
    assert "inverse" not in err
