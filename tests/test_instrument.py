"""An instrument's own values: surveyed ones are held, found ones go to the sidecar and come from there."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from conftest import URDF

from dhcal_pin.calibration import calibrate
from dhcal_pin.cli import main
from dhcal_pin.errors import DhcalError
from dhcal_pin.lengths import Wires
from dhcal_pin.measurement_files import measurement_text
from dhcal_pin.robot_files import read_instrument


def wires(chain, m, seed=0):
    """Raw lengths of the three-wire device and its true anchors by name; the same rig for every seed."""
    rng = np.random.default_rng(seed)
    anchors = np.array([[-1.4, 0, 0.5], [-1.4, 0.26, 0.05], [-1.4, -0.26, 0.05]])
    q = rng.uniform(-2.5, 2.5, (m, 6))
    length = np.linalg.norm(chain.poses(q)[:, None, :3, 3] - anchors, axis=2)
    true = {f"wire{i + 1}.{axis}": float(anchors[i, j]) for i in range(3) for j, axis in enumerate("xyz")}
    return Wires.of(q, length), true


def test_surveyed_anchors_are_held_and_fix_the_base(sim_6dof, sim_6dof_actual):
    """With the rig surveyed in the base's frame the wires see what positions see."""
    data, true = wires(sim_6dof_actual, 60)
    fit = calibrate(sim_6dof, data, "dh", priors="none", known=true)
    assert fit.problem.unknowns == ()
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (50, 6))
    gap = fit.chain.poses(q)[:, :3, 3] - sim_6dof_actual.poses(q)[:, :3, 3]
    assert np.abs(gap).max() < 1e-9


def test_some_surveyed_some_found(sim_6dof, sim_6dof_actual):
    data, true = wires(sim_6dof_actual, 60)
    part = {name: value for name, value in true.items() if not name.startswith("wire3")}
    fit = calibrate(sim_6dof, data, "dh", priors="none", known=part)
    for axis in "xyz":
        assert fit.instruments[f"wire3.{axis}"] == pytest.approx(true[f"wire3.{axis}"], abs=1e-8)


def test_unknown_names_are_refused(sim_6dof):
    data, _ = wires(sim_6dof, 10)
    with pytest.raises(DhcalError, match=r"known 'wire9.x'.*wire1.x, wire1.y"):
        calibrate(sim_6dof, data, "dh", known={"wire9.x": 1.0})


def test_found_values_go_to_the_sidecar_and_serve_validation(
    sim_6dof, sim_6dof_actual, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    nominal = str(URDF / "sim_6dof.dh.toml")
    for name, seed in (("fit.csv", 0), ("other.csv", 1)):
        Path(name).write_text(measurement_text(wires(sim_6dof_actual, 60, seed)[0], sim_6dof))
    options = ["--parameters", "dh", "--priors", "none", "--fix", "theta1,d1"]
    assert main(["calibrate", nominal, "fit.csv", "-o", "out.urdf", *options]) == 0
    values = tomllib.loads(Path("out.calibration.toml").read_text())["instrument"]
    assert set(values) == set(wires(sim_6dof_actual, 1)[1])
    assert main(["validate", "out.urdf", "other.csv", "--json", "v.json"]) == 0
    assert json.loads(Path("v.json").read_text())["after"]["residual_rms"] < 1e-8
    text, x = Path("out.calibration.toml").read_text(), values["wire1.x"]
    Path("moved.toml").write_text(text.replace(repr(x), repr(x + 0.1)))
    assert main(["validate", "out.urdf", "other.csv", "--sidecar", "moved.toml", "--json", "v.json"]) == 0
    assert json.loads(Path("v.json").read_text())["after"]["residual_rms"] > 1e-3


def test_values_from_a_file(sim_6dof, sim_6dof_actual, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data, true = wires(sim_6dof_actual, 60)
    Path("d.csv").write_text(measurement_text(data, sim_6dof))
    lines = ["[instrument]", *(f'"{name}" = {value}' for name, value in true.items())]
    Path("rig.toml").write_text("\n".join(lines))
    nominal = str(URDF / "sim_6dof.dh.toml")
    arguments = [
        "calibrate",
        nominal,
        "d.csv",
        "-o",
        "o.urdf",
        "--instrument",
        "rig.toml",
        "--json",
        "r.json",
    ]
    assert main([*arguments, "--priors", "none"]) == 0
    result = json.loads(Path("r.json").read_text())
    assert result["parameters_total"] == 24
    assert result["after"]["residual_rms"] < 1e-9


@pytest.mark.parametrize("text", ["[instrument]\nx = 'a'", "[instrument]\nx = nan", "instrument = 3"])
def test_wrong_values_are_one_line(text, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(DhcalError, match=r"rig\.toml: "):
        read_instrument(path)
