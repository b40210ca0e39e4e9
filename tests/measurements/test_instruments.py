"""An instrument's own values: surveyed ones are held, found ones go to the sidecar and come from there."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from robots import URDF

from dhcal_pin import se3
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.measurement_csv import measurement_text
from dhcal_pin.io.sidecar import read_instrument
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.length import Wires
from dhcal_pin.measurements.position import MultiTargetPosition


def wires(chain, m, seed=0):
    """Raw lengths of the three-wire device and its true anchors by name; the same rig for every seed."""
    rng = np.random.default_rng(seed)
    anchors = np.array([[-1.4, 0, 0.5], [-1.4, 0.26, 0.05], [-1.4, -0.26, 0.05]])
    q = rng.uniform(-2.5, 2.5, (m, 6))
    length = np.linalg.norm(chain.poses(q)[:, None, :3, 3] - anchors, axis=2)
    true = {f"wire{i + 1}.{axis}": float(anchors[i, j]) for i in range(3) for j, axis in enumerate("xyz")}
    return Wires(q, length), true


def test_surveyed_anchors_are_held_and_fix_the_base(sim_6dof, sim_6dof_actual):
    """With the rig surveyed in the base's frame the wires see what positions see."""
    data, true = wires(sim_6dof_actual, 60)
    fit = calibrate(sim_6dof, data, "dh", priors="none", known=true)
    assert fit.problem.instrument_parameters == ()
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


def test_targets_a_foot_apart_on_the_far_side_of_the_shop_converge(sim_6dof, sim_6dof_actual):
    """Only the offsets between the targets see how the tool is turned, so a way there bends."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        q, label = rng.uniform(-3, 3, (40, 6)), np.arange(40) % 3
        places = rng.normal(0, 0.2, (3, 3))
        base = se3.transform(se3.exp3(rng.normal(0, 1, 3)), rng.normal(0, 3, 3))
        pose = base @ sim_6dof_actual.poses(q)
        seen = pose[:, :3, 3] + np.einsum("mij,mj->mi", pose[:, :3, :3], places[label])
        data = MultiTargetPosition(q, seen + rng.normal(0, 1e-4, seen.shape), [f"t{i}" for i in label])
        fit = calibrate(sim_6dof, data, "minimal,base,tool")
        assert fit.converged
        assert fit.iterations < 30
        # How far the targets are from each other is no matter of where the tool's axes are.
        found = np.reshape([*fit.instruments.values()], (2, 3))
        expected = np.linalg.norm(places[1:] - places[0], axis=1)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), expected, atol=1e-3)


def test_files_that_count_their_targets_differently_are_refused(sim_6dof, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = MultiTargetPosition.simulate(
        sim_6dof, np.random.default_rng(0).uniform(-3, 3, (30, 6)), Noise(1e-4), np.random.default_rng(1)
    )
    Path("arm.urdf").write_bytes((URDF / "sim_6dof.urdf").read_bytes())
    Path("a.csv").write_text(measurement_text(data, sim_6dof))
    Path("b.csv").write_text(measurement_text(data.take(np.arange(1, 30)), sim_6dof))
    Path("c.csv").write_text(measurement_text(data.take(np.arange(0, 30, 3)), sim_6dof))
    for held in ([], ["--holdout", "b.csv"]):
        second = [] if held else ["b.csv"]
        assert main(["calibrate", "arm.urdf", "a.csv", *second, *held, "-o", "out.urdf"]) == 2
        assert "b.csv: the first target is 't2', " in capsys.readouterr().err
        assert not Path("out.urdf").exists()
    assert main(["calibrate", "arm.urdf", "a.csv", "c.csv", "-o", "out.urdf"]) == 0
    assert main(["validate", "out.urdf", "b.csv"]) == 2
    assert "b.csv: the first target is 't2', " in capsys.readouterr().err
