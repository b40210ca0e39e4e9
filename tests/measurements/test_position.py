"""Positions of several targets on the tool."""

from pathlib import Path

import numpy as np
import pytest
from robots import URDF
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import MultiTargetPosition, Noise

pytestmark = pytest.mark.usefixtures("unsuspected")


@pytest.mark.parametrize("n_seeds", some_slow([1, 4], {0}))
def test_targets_far_apart_and_an_instrument_far_away_converge(n_seeds, sim_6dof, sim_6dof_actual):
    """Only the offsets between targets depend on the tool rotation, so the problem is nonlinear."""
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        q, label = rng.uniform(-3, 3, (40, 6)), np.arange(40) % 3
        offsets = rng.normal(0, 0.2, (3, 3))
        base = se3.transform(se3.exp3(rng.normal(0, 1, 3)), rng.normal(0, 3, 3))
        pose = base @ sim_6dof_actual.poses(q)
        positions = pose[:, :3, 3] + np.einsum("mij,mj->mi", pose[:, :3, :3], offsets[label])
        data = MultiTargetPosition(
            q, positions + rng.normal(0, 1e-4, positions.shape), [f"t{i}" for i in label]
        )
        fit = calibrate(sim_6dof, data, "minimal,base,tool")
        assert fit.converged
        assert fit.iterations < 30
        # The distances between the targets do not depend on the axes of the tool frame.
        found = np.reshape([*fit.instruments.values()], (2, 3))
        expected = np.linalg.norm(offsets[1:] - offsets[0], axis=1)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), expected, atol=1e-3)


def test_files_with_different_first_targets_are_refused(sim_6dof, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = MultiTargetPosition.simulate(
        sim_6dof, np.random.default_rng(0).uniform(-3, 3, (30, 6)), Noise(1e-4), np.random.default_rng(1)
    )
    Path("arm.urdf").write_bytes((URDF / "sim_6dof.urdf").read_bytes())
    Path("a.csv").write_text(measurement_text(data, sim_6dof))
    Path("b.csv").write_text(measurement_text(data.take(data.label > 0), sim_6dof))
    Path("c.csv").write_text(measurement_text(data.take(np.arange(0, 30, 3)), sim_6dof))
    for holdout in ([], ["--holdout", "b.csv"]):
        second = [] if holdout else ["b.csv"]
        assert main(["calibrate", "arm.urdf", "a.csv", *second, *holdout, "-o", "out.urdf"]) == 2
        assert "b.csv: the first target in alphabetical order is 't2', " in capsys.readouterr().err
        assert not Path("out.urdf").exists()
    assert main(["calibrate", "arm.urdf", "a.csv", "c.csv", "-o", "out.urdf"]) == 0
    assert main(["validate", "out.urdf", "b.csv"]) == 2
    assert "b.csv: the first target in alphabetical order is 't2', " in capsys.readouterr().err
