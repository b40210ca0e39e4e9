"""Workspace maps: predicted uncertainty against the errors of simulated robots."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.presentation import workspace
from dhcal_pin.diagnostics import predict_workspace, workspace_map
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.robot.sampling import ConfigurationSampler, WorkspaceConstraints

pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = Noise(1e-4, np.deg2rad(0.01))


def test_predicted_uncertainty_equals_the_errors_of_calibrated_robots(sim_6dof):
    """Poses in one corner of joint space give small errors there and larger ones elsewhere."""
    errors = select_parameters(sim_6dof, "minimal,base,tool")
    prior = np.where(errors.is_of_arm, errors.priors, 1e-3)
    rng = np.random.default_rng(0)
    q = ConfigurationSampler.from_chain(sim_6dof, WorkspaceConstraints(), 0.0, 0.0).draw(1500, rng)
    squares, expected = [], []
    for _ in range(6):
        truth = errors.at(prior * rng.standard_normal(len(prior)))
        taken = rng.uniform(0.0, 1.2, (20, 6))
        fit = calibrate(sim_6dof, Pose.simulate(truth, taken, NOISE, rng), "minimal,base,tool")
        found = workspace_map(fit, cell=0.5, samples=1500)
        points = fit.chain.poses(q)[:, :3, 3]
        squared_errors = np.sum((points - truth.poses(q)[:, :3, 3]) ** 2, 1)
        cells = {tuple(cell): i for i, cell in enumerate(np.floor(found.centre / 0.5).astype(int))}
        at = np.array([cells.get(tuple(cell), -1) for cell in np.floor(points / 0.5).astype(int)])
        squares.append(squared_errors[at >= 0])
        expected.append(found.std[at[at >= 0]] ** 2)
    squares, expected = np.concatenate(squares), np.concatenate(expected)
    for low, high in ((0, 25), (25, 50), (50, 75), (75, 100)):
        part = (expected >= np.percentile(expected, low)) & (expected <= np.percentile(expected, high))
        # The sample is small: six robots with about thirty determined directions each.
        assert np.sqrt(squares[part].mean()) == pytest.approx(np.sqrt(expected[part].mean()), rel=0.25)
    assert np.percentile(expected, 90) > 1.3 * np.percentile(expected, 10)


def test_every_configuration_is_counted_in_its_cell(sim_6dof):
    rng = np.random.default_rng(1)
    fit = calibrate(sim_6dof, Pose.simulate(sim_6dof, rng.uniform(-2, 2, (20, 6)), NOISE, rng))
    found = workspace_map(fit, cell=0.25, samples=3000, seed=5)
    assert found.count.sum() == 3000
    q = ConfigurationSampler.from_chain(fit.chain, WorkspaceConstraints(), 0.0, 0.0).draw(
        3000, np.random.default_rng(5)
    )
    prediction = fit.predict(q)
    assert found.worst.max() == pytest.approx(prediction.position_std.max(), rel=1e-12)
    inside = np.abs(prediction.poses[:, None, :3, 3] - found.centre).max(-1) <= 0.125
    assert np.array_equal(inside.sum(0), found.count)
    cell = int(np.argmax(found.count))
    wanted = np.sqrt(np.mean(prediction.position_std[inside[:, cell]] ** 2))
    assert found.std[cell] == pytest.approx(wanted, rel=1e-12)


def test_predicted_points_are_in_the_base_frame(monkeypatch, sim_6dof, sim_6dof_actual):
    monkeypatch.setattr(workspace, "N_PREDICTED_CONFIGURATIONS", 300)
    nominal, actual = sim_6dof, sim_6dof_actual
    truth = replace(actual, base=se3.exp6(np.array([3.0, -2.0, 1.0, 0.3, 0.2, 2.0])))
    rng = np.random.default_rng(0)
    data = Pose.simulate(truth, rng.uniform(-1.5, 1.5, (40, 6)), Noise(1e-4, 1e-4), rng)
    found = predict_workspace(calibrate(nominal, data, "dh,base"), [data])
    model, state = actual.model, actual.model.createData()
    for q, point in zip(data.q, found.measured, strict=True):
        pin.framesForwardKinematics(model, state, actual.configurations(q[None])[0])
        # Base and first joint are distinguished by the priors only, hence the millimetres.
        assert np.abs(state.oMf[actual.frame_id].translation - point).max() < 0.02
    assert found.std.shape == (300,)
    assert np.median(found.std) > np.median(found.measured_std)
