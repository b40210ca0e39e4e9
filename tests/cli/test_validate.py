"""Command validate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import HEADER, KEYS, json_of, parse_json, tool_positions
from robots import URDF


def test_sidecar_is_an_input(run, robot_folder):
    Path("arm.calibration.toml").write_text("[base]\nxyz_m = [0.5, 0.0, 0.0]\n")
    document = json_of(run("validate", "arm.urdf", "data.csv", "--json", "-"))
    assert set(document["inputs"]) == {"arm.urdf", "data.csv", "arm.calibration.toml"}
    assert document["after"]["position_rms_m"] == pytest.approx(0.5, abs=0.01)
    Path("other.toml").write_text("[base]\nxyz_m = [0.0, 0.0, 0.25]\n")
    args = ("validate", "arm.urdf", "data.csv", "--sidecar", "other.toml", "--json", "-")
    assert json_of(run(*args))["after"]["position_rms_m"] == pytest.approx(0.25, abs=0.01)


def test_json_of_a_validation(run, robot_folder):
    document = json_of(run("validate", "arm.urdf", "data.csv", "--json", "-"))
    assert document.keys() >= KEYS
    assert document["samples"] == 20
    assert document["before"] == document["after"]
    assert document["parameters"] == []
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    off = np.linalg.norm(tool_positions(rows[:, :3]) - rows[:, 3:], axis=1) / 1e3
    assert document["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)


def test_fit_frames_finds_the_measuring_frame(run, robot_folder):
    rows = np.loadtxt("data.csv", delimiter=",", skiprows=1)
    # The tracker is rotated by 90° about z and translated by 2 m.
    moved = np.stack([-rows[:, 4] + 2000, rows[:, 3], rows[:, 5] - 300], -1)
    np.savetxt("far.csv", np.concatenate([rows[:, :3], moved], 1), "%.9f", ",", header=HEADER, comments="")
    near = json_of(run("validate", "arm.urdf", "data.csv", "--fit-frames", "--json", "-"))
    status, out, err = run("validate", "arm.urdf", "far.csv", "--fit-frames", "--json", "-")
    assert status == 0
    far = parse_json(out)
    assert far["before"]["position_rms_m"] > 1
    # The weak priors on base and tool change the results by less than this.
    assert far["after"]["position_rms_m"] == pytest.approx(near["after"]["position_rms_m"], rel=1e-4)
    assert "base and tool as given" in err


def test_unreachable_rows_are_reported_and_included(run, robot_folder):
    """Rows 7 and 8 of Table 5, as printed, raise the RMS error from 25.5 mm to 473 mm."""
    table = str(URDF / "experiment_table5.csv")
    status, out, err = run("validate", URDF / "experiment.dh.toml", table, "--json", "-")
    rows = np.loadtxt(table, delimiter=",", comments=("#", "j"))
    off = np.linalg.norm(tool_positions(rows[:, :3]) - rows[:, 3:6], axis=1) / 1e3
    document = parse_json(out)
    assert (status, document["samples"]) == (0, 8)
    assert document["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    assert [text.split(": ")[1] for text in document["warnings"]] == ["row 7", "row 8"]
    assert "warning: row 7: its joint positions lead 1095 mm away" in err
    assert run("validate", URDF / "experiment.dh.toml", table, "--fit-frames")[2].count("warning: row") == 0
