"""Tests of `dhcal view`."""

import json
import re

import numpy as np
import pytest
from command_line import HEADER, stderr_of, stdout_of, tool_positions

WARNING = "warning: the frames (base, tool) differ: run again with --fit-frames"


@pytest.fixture
def other_set_up(robot_folder):
    """Measurements of the robot by an instrument that stands 2 m away, with a noise of 1 mm."""
    rng = np.random.default_rng(5)
    degrees = rng.uniform(-70, 70, (30, 3))
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    positions = (tool_positions(degrees) + rng.normal(size=(30, 3))) @ rotation.T + [2000, 0, -300]
    rows = np.concatenate([degrees, positions], 1)
    np.savetxt("far.csv", rows, "%.9f", ",", header=HEADER, comments="")


def residuals_of(page):
    """Read the lengths of the residuals that a page draws [m]."""
    (text,) = re.findall(r'"residuals":(\[\[.*?\]\])', page.read_text("utf-8"))
    residuals = json.loads(text)
    return np.linalg.norm(residuals, axis=1)


def test_data_of_another_set_up_are_named_and_fitted_on_request(run, robot_folder, other_set_up):
    err = stderr_of(run("view", "arm.urdf", "--data", "far.csv", "--html", "scene.html"))
    assert WARNING in err
    assert residuals_of(robot_folder / "scene.html").min() > 1
    err = stderr_of(run("view", "arm.urdf", "--data", "far.csv", "--html", "scene.html", "--fit-frames"))
    assert "warning" not in err
    rms = np.sqrt(np.mean(residuals_of(robot_folder / "scene.html") ** 2))
    assert rms == pytest.approx(np.sqrt(3) * 1e-3, rel=0.25)


def test_both_robots_get_the_frames_of_the_new_set_up(run, robot_folder, other_set_up):
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--extend", "none"))
    args = ("view", "arm.urdf", "out.urdf", "--data", "far.csv", "--html", "scene.html")
    assert WARNING in run(*args)[2]
    assert WARNING not in run(*args, "--fit-frames")[2]
    assert residuals_of(robot_folder / "scene.html").max() < 0.02


def test_data_of_the_same_set_up_are_not_named(run, robot_folder):
    stdout_of(run("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--extend", "none"))
    err = stderr_of(run("view", "arm.urdf", "out.urdf", "--data", "data.csv", "--html", "scene.html"))
    assert "warning" not in err


def test_frames_cannot_be_fitted_without_data(assert_refused):
    assert_refused(["--fit-frames", "--data"], "view", "arm.urdf", "--html", "scene.html", "--fit-frames")
