"""A hand-eye calibration from poses of the flange states nothing about the joint space of a robot."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from camera_setups import ARMS, simulate

from dhcal_pin import se3
from dhcal_pin.io.rig_file import rig_text

pytestmark = pytest.mark.usefixtures("uneventful")


@pytest.fixture
def flange_files(tmp_path, monkeypatch):
    """Write simulated images with poses of the flange, and their rig, into an empty folder."""
    monkeypatch.chdir(tmp_path)
    chain = ARMS["ur10"]()
    images = simulate(chain, chain, np.random.default_rng(5), is_on_wrist=True, n_images=20, sigma=0.1).images
    poses = chain.poses(images.q)
    lines = ["x[m],y[m],z[m],rx[rad],ry[rad],rz[rad],u[px],v[px],corner"]
    for pose, pixels, corner in zip(poses, images.values, images.corner, strict=True):
        values = [*pose[:3, 3], *se3.log3(pose[:3, :3]), *pixels]
        lines.append(",".join([*(repr(float(value)) for value in values), str(corner)]))
    Path("images.csv").write_text("\n".join(lines))
    Path("rig.toml").write_text(rig_text(images.rig.cameras, images.rig.boards))


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
