"""Differences of two calibrations of simulated arms, against what was changed between them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import paper
from scipy import stats
from sessions import NOISE, Simulation

from dhcal_pin import Result, calibrate, se3
from dhcal_pin.cli.main import main
from dhcal_pin.diagnostics import Calibrated, Difference, compare
from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io import write_urdf
from dhcal_pin.measurements import Measurement, Pose, Position
from dhcal_pin.robot import Chain


def calibration(sim: Simulation, data: Measurement) -> Calibrated:
    """Calibrate an arm without curves."""
    return of(calibrate(sim.chain, data, extend="none", session="off"))


def of(fit: Result) -> Calibrated:
    """Return what a sidecar holds of a calibration."""
    return Calibrated(fit.chain, fit.uncertainty, fit.measured_region, "arm.urdf")


def halves(arm: str, seed: int, kind: type[Measurement], count: int = 120, curves: float = 0.0) -> Difference:
    """Compare two halves of a set; with curves, the halves are two regions of the second joint."""
    sim = Simulation(arm, count, seed)
    order = np.arange(count)
    if curves:
        sine, cosine = sim.rng.normal(0, curves, (2, sim.chain.n_joints))
        poses = sim.poses
        sim.poses = lambda q, model=None: poses(q + sine * np.sin(2 * q) + cosine * np.cos(q), model)
        order = np.argsort(sim.q[:, 1])
        order = np.concatenate([order[: count // 2], order[count // 2 :]]).reshape(2, -1).T.ravel()
    data = sim.measure(kind)
    return compare(*(calibration(sim, data.take(order[i::2])) for i in (0, 1)))


def test_halves_without_model_error_are_equal():
    found = [halves("ur10", seed, Position) for seed in range(3)]
    assert [each.verdict for each in found] == ["equal"] * 3
    assert 0.5 < np.mean([each.reduced or 0.0 for each in found]) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "kind"), [("ur10", Position), ("panda", Pose)])
def test_chi_square_of_halves_has_its_distribution(arm, kind):
    found = [halves(arm, seed, kind) for seed in range(100)]
    assert 0.8 < np.mean([each.reduced or 0.0 for each in found]) < 1.25
    inside = [each.usual[0] < (each.reduced or 0.0) < each.usual[1] for each in found]
    assert np.mean(inside) >= 0.9
    assert stats.kstest([each.p_value for each in found], "uniform").pvalue > 1e-3


@pytest.mark.slow
def test_curves_that_the_model_lacks_make_regions_different():
    found = [halves("ur10", seed, Position, 600, 1e-3) for seed in range(40)]
    assert np.mean([each.verdict == "different" for each in found]) >= 0.95


def test_a_changed_joint_is_named_whatever_base_and_tool_are():
    sim = Simulation("ur10", 60, 3)
    first = calibration(sim, sim.measure(Pose))
    sim.base, sim.tool = sim.tool, sim.base.inverse()
    poses = sim.poses
    sim.poses = lambda q, model=None: poses(q + np.array([0, 0, np.deg2rad(0.1), 0, 0, 0]), model)
    found = compare(first, calibration(sim, sim.measure(Pose)))
    assert found.verdict == "different"
    assert next(iter(found.joints)) == "elbow_joint"
    # The tool moves as the joint turns it, less what base and tool take up.
    assert 0.1e-3 < np.sqrt(np.mean(found.everywhere.position**2)) < 1.5e-3


def test_distances_do_not_depend_on_base_and_tool():
    nominal, actual = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
    found = compare(Calibrated(nominal), Calibrated(actual))
    turn = se3.exp6(np.array([0.3, -0.2, 0.5, 0.1, 2.0, -0.4]))
    moved = compare(Calibrated(nominal), Calibrated(replace(actual, base=turn, tool=turn)))
    np.testing.assert_allclose(moved.everywhere.position, found.everywhere.position, atol=1e-7)
    assert found.verdict == "unknown"
    # No other base and tool are nearer.
    rms = np.sqrt(np.mean(found.everywhere.position**2))
    assert (
        0 < rms < np.sqrt(np.mean(np.sum((nominal.poses(found.q) - actual.poses(found.q))[:, :3, 3] ** 2, 1)))
    )


def test_other_robots_are_refused(sim_6dof, sim_3dof):
    with pytest.raises(InvalidArgumentError, match="another robot: its joints"):
        compare(Calibrated(sim_6dof), Calibrated(sim_3dof))
    table = paper("sim_6dof")
    other = Chain.from_dh(replace(table, a=np.array(table.a)[::-1] * 2))
    with pytest.raises(InvalidArgumentError, match="mm RMS from that of"):
        compare(Calibrated(sim_6dof), Calibrated(other))


def test_command(tmp_path: Path, capsys):
    sim = Simulation("ur10", 40, 3)
    names = [str(tmp_path / name) for name in ("a.urdf", "b.urdf")]
    for name in names:
        data = sim.measure(Position)
        write_urdf(
            calibrate(sim.chain, Position(data.q, data.positions(), NOISE), extend="none", session="off"),
            name,
        )
    report = tmp_path / "d.html"
    assert main(["diff", *names, "--tip", "tool0", "--report", str(report), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "equal"
    assert found["joint_space"]["position_rms_m"] < 5 * NOISE
    assert "Distance of the tools" in report.read_text()
    (tmp_path / "other.urdf").write_bytes(
        (Path(__file__).parents[2] / "urdf" / "experiment.urdf").read_bytes()
    )
    assert main(["diff", names[0], str(tmp_path / "other.urdf"), "--json", str(tmp_path / "d.json")]) == 2
    assert not (tmp_path / "d.json").exists()
