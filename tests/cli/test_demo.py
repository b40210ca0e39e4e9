"""Command demo."""

import os
from pathlib import Path

import numpy as np
import pytest
from command_line import KEYS, assert_same_poses, json_of, parse_json, tool_positions
from robots import URDF

from dhcal_pin.cli import screens
from dhcal_pin.io import read_robot
from dhcal_pin.paper import simulations


def test_files_and_figures_of_the_demo(run, robot_folder, monkeypatch):
    simulation_rows = simulations.simulation_rows
    monkeypatch.setattr(simulations, "simulation_rows", lambda: simulation_rows(seeds=2))
    opened = []
    monkeypatch.setattr(screens, "open_page", opened.append)
    assert json_of(run("demo", "--out", "shown", "--json", "-", "--open"))["outliers"] == [7, 8]
    # The report explains itself and contains the scene.
    assert opened == [os.path.join("shown", "report.html")]
    assert Path(opened[0]).read_text().count("application/json") == 1
    assert sorted(os.listdir("shown")) == [
        *("experiment.urdf", "experiment_calibrated.urdf", "report.html"),
        *("result.json", "scene.html", "summary.md"),
    ]
    document = parse_json(Path("shown/result.json").read_text())
    assert document.keys() >= KEYS
    assert document["outliers"] == [7, 8]
    assert document["samples"] == 6
    assert set(document["inputs"]) == {"experiment.dh.toml", "experiment_table5.csv"}
    # Table 5 without its two corrupt rows, against the closed form of two links in a plane.
    rows = np.loadtxt(URDF / "experiment_table5.csv", delimiter=",", comments=("#", "j"))[:6]
    off = np.linalg.norm(tool_positions(rows[:, :3]) - rows[:, 3:6], axis=1) / 1e3
    assert document["before"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)
    # The written robot has the fitted correction, whatever the verdict advises.
    written = read_robot("shown/experiment_calibrated.urdf").poses(np.deg2rad(rows[:, :3]))[:, :3, 3]
    left = np.linalg.norm(written - rows[:, 3:6] / 1e3, axis=1)
    assert document["after"]["position_rms_m"] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-6)
    assert "correction is applied" not in Path("shown/report.html").read_text()
    summary = Path("shown/summary.md").read_text()
    assert "Row 7 of Table 5 is excluded" in summary
    assert f"{1e3 * document['after']['position_rms_m']:.3f}" in summary
    assert "21→24/24" in summary
    assert "except alpha3" in summary
    left_out, other = document["comparisons"][0]["after"], document["experiment_m"]["least_squares_left_out"]
    assert left_out["position_rms_m"] == pytest.approx(other, rel=1e-3)
    assert_same_poses("shown/experiment.urdf", URDF / "experiment.dh.toml")
