"""Wires with known and unknown anchors, also by files of instrument parameters and sidecars."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from robots import URDF, nominal_arm
from slow_cases import some_slow

from dhcal_pin.calibration import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.estimation import select_parameters
from dhcal_pin.estimation.initialization import align
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text
from dhcal_pin.io.sidecar import read_instrument
from dhcal_pin.measurements import Noise, Wires
from dhcal_pin.robot.sampling import joint_range

pytestmark = pytest.mark.usefixtures("unsuspected")


def wires(chain, m, seed=0):
    """Return lengths of a three-wire device, and its true anchors and zero offsets by name."""
    rng = np.random.default_rng(seed)
    anchors = np.array([[-1.4, 0, 0.5], [-1.4, 0.26, 0.05], [-1.4, -0.26, 0.05]])
    q = rng.uniform(-2.5, 2.5, (m, 6))
    length = np.linalg.norm(chain.poses(q)[:, None, :3, 3] - anchors, axis=2)
    true = {f"wire{i + 1}.{axis}": float(anchors[i, j]) for i in range(3) for j, axis in enumerate("xyz")}
    return Wires(q, length), true | {f"wire{i + 1}.zero": 0.0 for i in range(3)}


def test_the_derivative_of_lengths_by_instrument_parameters(sim_6dof):
    """Central differences of the modelled lengths, with anchors and zeros unknown."""
    rng = np.random.default_rng(0)
    q, points = rng.uniform(-2.5, 2.5, (9, 6)), rng.normal(size=(1, 3, 9))
    data = Wires(q, rng.uniform(1, 2, (9, 2)), 1e-4, offsets=[np.nan, np.nan]).initialized(sim_6dof)
    names = [parameter.name for parameter in data.instrument_parameters]
    assert [name for name in names if name.endswith("zero")] == ["wire1.zero", "wire2.zero"]
    u = rng.normal(size=len(names))
    _, _, jacobian = data.model(points, u)
    for i, step in enumerate(1e-6 * np.eye(len(u))):
        numeric = (data.model(points, u + step)[0] - data.model(points, u - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[i], numeric, atol=1e-8)
    # A longer zero makes a longer reading.
    assert (jacobian[-2:].sum(1) == 1).all()


def test_anchors_start_at_the_lengths_without_their_known_zeros(sim_6dof):
    """Exact lengths with a zero of 0.3 m give the true anchors at once."""
    rng = np.random.default_rng(0)
    anchors = np.array([[-1.4, 0, 0.5], [-1.4, 0.26, 0.05]])
    q = rng.uniform(-2.5, 2.5, (40, 6))
    length = np.linalg.norm(sim_6dof.poses(q)[:, None, :3, 3] - anchors, axis=2)
    data = Wires(q, length + np.array([0.3, -0.2]), 1e-4, offsets=[0.3, -0.2]).initialized(sim_6dof)
    found = np.reshape([parameter.nominal for parameter in data.instrument_parameters], (2, 3))
    np.testing.assert_allclose(found, anchors, atol=1e-9)


def test_known_anchors_make_the_base_observable(sim_6dof, sim_6dof_actual):
    """With anchors known in the base frame, lengths determine the robot as positions do."""
    data, true = wires(sim_6dof_actual, 60)
    fit = calibrate(sim_6dof, data, "dh", priors="none", known=true)
    assert fit.problem.instrument_parameters == ()
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (50, 6))
    gap = fit.chain.poses(q)[:, :3, 3] - sim_6dof_actual.poses(q)[:, :3, 3]
    assert np.abs(gap).max() < 1e-9


@pytest.mark.parametrize("n_seeds", some_slow([2, 6], {0}))
def test_unknown_zero_offsets_cost_hardly_any_accuracy(n_seeds):
    """Offsets of 4, -10 and 30 mm: the same lengths with known offsets have the same errors."""
    chain, errors, offsets = nominal_arm("ur10"), [], np.array([4e-3, -1e-2, 3e-2])
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        model = select_parameters(chain, "minimal,base,tool")
        sizes = [1e-3 if p.unit == "m" else 2e-3 for p in model.parameters]
        actual = model.at(rng.normal(size=len(sizes)) * sizes)
        lengths = Wires.simulate(actual, rng.uniform(-2, 2, (60, 6)), Noise(1e-4), rng)
        other = rng.uniform(-2, 2, (200, 6))
        for data in (
            Wires(lengths.q, lengths.values, 1e-4, offsets=0.0),
            Wires(lengths.q, lengths.values + offsets, 1e-4),
        ):
            fit = calibrate(chain, data, "minimal,base,tool", extend="none")
            assert fit.verdict.status == "ok"
            found, true = (c.poses(other)[:, :3, 3] for c in (fit.chain, actual))
            errors.append(align(found, true)[1])
        zeros = [fit.instruments[f"wire{i}.zero"] for i in (1, 2, 3)]
        np.testing.assert_allclose(zeros, offsets, atol=1e-3)
    known, unknown = np.square(errors).reshape(-1, 2).mean(0)
    assert unknown < 1.2**2 * known


def test_some_anchors_known_and_some_estimated(sim_6dof, sim_6dof_actual):
    data, true = wires(sim_6dof_actual, 60)
    part = {name: value for name, value in true.items() if not name.startswith("wire3")}
    fit = calibrate(sim_6dof, data, "dh", priors="none", known=part)
    for axis in "xyz":
        assert fit.instruments[f"wire3.{axis}"] == pytest.approx(true[f"wire3.{axis}"], abs=1e-8)


def test_unknown_names_of_known_values_are_refused(sim_6dof):
    data, _ = wires(sim_6dof, 10)
    with pytest.raises(DhcalError, match=r"known value of 'wire9.x'.*wire1.x, wire1.y"):
        calibrate(sim_6dof, data, "dh", known={"wire9.x": 1.0})


def test_estimated_values_are_written_to_the_sidecar_and_used_by_validate(
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


def test_known_values_from_a_file(sim_6dof, sim_6dof_actual, tmp_path, monkeypatch):
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
def test_wrong_values_in_a_file_are_refused_with_its_name(text, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(DhcalError, match=r"rig\.toml: "):
        read_instrument(path)


def test_single_wire_accepts_one_length_per_sample(sim_6dof):
    q = np.random.default_rng(0).uniform(-1, 1, (4, 6))
    data = Wires(q, [1.0, 1.1, 1.2, 1.3], anchors=[[2.0, 0.0, 0.0]], offsets=None)
    assert data.values.shape == (4, 1)
    assert [parameter.name for parameter in data.instrument_parameters] == ["wire1.zero"]
    assert list(data.to_columns()) == ["length"]


def test_simulated_wires_have_three_numbered_columns(sim_6dof):
    data = Wires.simulate(sim_6dof, np.zeros((3, 6)), Noise(1e-4), np.random.default_rng(0))
    assert list(data.to_columns()) == ["L1", "L2", "L3", "sigma_L1", "sigma_L2", "sigma_L3"]


def test_a_point_on_the_last_axis_does_not_tilt_that_axis():
    """Lengths hardly determine the direction of the axis: with priors of any width it turns by 40°."""
    chain = nominal_arm("ur10")
    errors = select_parameters(chain, "minimal,base,tool,harmonics,compliance")
    names = [parameter.name for parameter in errors.parameters]
    sizes = {"m": 5e-4, "rad": 1e-3, "rad/Nm": 1e-5}
    scale = np.array([sizes[parameter.unit] for parameter in errors.parameters])
    is_compliance = [name.endswith("compliance") for name in names]
    scale[[".sin" in name or ".cos" in name for name in names]] = 3e-4
    scale[[name.startswith(("base", "tool")) for name in names]] = 0
    rng = np.random.default_rng(20)
    x = scale * rng.standard_normal(len(scale))
    x[is_compliance] = abs(x[is_compliance])
    truth = errors.at(x).with_current_loads()
    q = rng.uniform(*joint_range(chain), (100, 6))
    fit = calibrate(chain, Wires.simulate(truth, q, Noise(5e-5), rng))
    assert fit.verdict.status == "ok"
    of_last = [p.name.startswith("wrist_3_joint.r") for p in fit.parameters]
    assert abs(fit.x[of_last]).max() < np.deg2rad(2)
