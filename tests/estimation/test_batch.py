"""Stacked calibrations against the solver that takes them one by one, and against scatter over repeats."""

from __future__ import annotations

import numpy as np
import pytest
from robots import paper, random_joints, random_table

from dhcal_pin._kernels import kinematics
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.estimation.batch import BatchProblem, solve_batch
from dhcal_pin.estimation.batch_chains import ChainBatch
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import Problem
from dhcal_pin.estimation.qr import row_space
from dhcal_pin.estimation.solver import METHODS
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import KINDS
from dhcal_pin.measurements.base import Noise, concatenate
from dhcal_pin.measurements.length import Wires
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position
from dhcal_pin.parallel import open_executor
from dhcal_pin.robot.chain import Chain

NOISE = Noise(1e-4, 1e-4)


def wrong(errors, rng, size=3e-3):
    """A true arm whose every parameter is off by about that many metres or radians."""
    return errors.at(size * rng.normal(size=len(errors.parameters)))


def one_by_one(models, data, weights, method="lm"):
    zero = np.zeros(len(weights))
    return [
        METHODS[method](Problem(model, tuple(items), weights), zero, 100, None)
        for model, items in zip(models, data, strict=True)
    ]


@pytest.mark.parametrize(
    "sets", ["dh", "modified-dh", "minimal,base,tool", "placement,tool", "base,dh,offset,tool"]
)
@pytest.mark.parametrize("seed", range(3))
def test_kernel_is_that_of_one_chain(sets, seed):
    """Frames and derivatives of arms of one structure, revolute and prismatic, nominals all different."""
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    models = [
        select_parameters(wrong(select_parameters(Chain.from_dh(table), "placement,base,tool"), rng), sets)
        for _ in range(4)
    ]
    x = 1e-2 * rng.normal(size=(4, len(models[0].parameters)))
    q = random_joints(rng, table, 2 * 4 * 3).reshape(2, 4, 3, -1)
    arms, bodies, twists = ChainBatch.from_models(models).derivative(x)
    frames = arms.forward_kinematics(q)
    velocities, members = np.empty((len(x[0]), 6, 2 * 4 * 3)), np.ascontiguousarray(twists.swapaxes(0, 1))
    kinematics.batch_point_jacobian(frames.columns, frames.tool[3], bodies, members, 2, velocities)
    velocities = velocities.reshape(-1, 6, 2, 4, 3)
    for i, model in enumerate(models):
        chain, own, carried = model.derivative(x[i])
        alone = chain.forward_kinematics(chain.joint_state(q[:, i].reshape(6, -1)))
        wanted = chain.tool_jacobian(alone, own, carried).reshape(-1, 6, 2, 3)
        np.testing.assert_allclose(velocities[:, :, :, i], wanted, atol=1e-13)
        np.testing.assert_allclose(
            frames.tool.reshape(4, 3, 2, 4, 3)[..., i, :].reshape(4, 3, 6), alone.tool, atol=1e-13
        )
        np.testing.assert_allclose(arms.chain(i).poses(q[0, i]), chain.poses(q[0, i]), atol=1e-13)


@pytest.mark.parametrize("seed", range(10))
def test_answers_are_those_of_the_solver(seed):
    """20 problems of a random arm, parameter set, mixture of kinds, priors and method; 200 in all.

    In metres and radians where the data see it, and within a millionth of a sigma all over.
    """
    rng = np.random.default_rng(seed)
    table = random_table(rng, size=int(rng.integers(2, 8)))
    nominal = Chain.from_dh(table)
    errors = select_parameters(nominal, ["minimal,base,tool", "dh", "modified-dh,tool"][seed % 3])
    kinds = [["pose"], ["position", "relative"], ["distance", "pose"], ["axes", "position"]][seed % 4]
    method = "gn" if seed % 4 == 0 else "lm"
    weights = np.zeros(len(errors.parameters)) if seed % 2 else 1 / errors.priors
    data = []
    for _ in range(20):
        truth = wrong(errors, rng)
        data.append(
            [KINDS[kind].simulate(truth, random_joints(rng, table, 15), NOISE, rng) for kind in kinds]
        )
    found = solve_batch(BatchProblem.from_models([errors] * 20, data, weights), method)
    for i, alone in enumerate(one_by_one([errors] * 20, data, weights, method)):
        off = found.x[i] - alone.x
        assert np.abs(row_space(alone.system.r) @ off).max() < 1e-9
        assert np.abs(np.concatenate([alone.system.r, np.diag(weights)]) @ off).max() < 1e-6
        assert found.converged[i] == alone.converged
        cost = alone.system.min_cost + alone.system.z @ alone.system.z
        assert found.cost[i] == pytest.approx(cost, rel=1e-9)


def test_nominal_arms_may_differ_and_samples_be_fewer():
    """A fleet: other nominals, other numbers of samples; and cross-validation's folds are the same thing."""
    rng = np.random.default_rng(0)
    table = random_table(rng, size=5)
    models = [
        select_parameters(
            wrong(select_parameters(Chain.from_dh(table), "placement"), rng, 0.05), "minimal,base,tool"
        )
        for _ in range(6)
    ]
    data = [
        [Pose.simulate(wrong(model, rng), random_joints(rng, table, m), NOISE, rng)]
        for model, m in zip(models, (12, 20, 15, 20, 13, 19), strict=True)
    ]
    weights = 1 / models[0].priors
    batch = BatchProblem.from_models(models, data, weights)
    found = solve_batch(batch)
    for i, alone in enumerate(one_by_one(models, data, weights)):
        np.testing.assert_allclose(found.x[i], alone.x, atol=1e-9)
    np.testing.assert_array_equal(batch.count_rows(), 6 * np.array([12, 20, 15, 20, 13, 19]))


def test_rank_and_covariance_are_the_result_s(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    data = [[Position.simulate(sim_6dof_actual, rng.uniform(-3, 3, (20, 6)), NOISE, rng)] for _ in range(3)]
    found = solve_batch(BatchProblem.from_models([errors] * 3, data, np.zeros(24)))
    for i, items in enumerate(data):
        fit = calibrate(sim_6dof, items, "dh", priors="none")
        assert found.rank[i] == fit.rank == 23
        np.testing.assert_allclose(found.std[i], fit.std, rtol=1e-5)


def test_stated_spread_is_the_scatter_over_repeats(sim_6dof, sim_6dof_actual):
    """1,000 repeats: each parameter's scatter over its stated standard deviation is 1."""
    errors = select_parameters(sim_6dof, "dh")
    truth = [p.nominal for p in select_parameters(sim_6dof_actual, "dh").parameters]
    rng = np.random.default_rng(0)
    q = np.tile(rng.uniform(-3, 3, (20, 6)), (1000, 1))
    data = Pose.simulate(sim_6dof_actual, q, NOISE, rng)
    found = solve_batch(BatchProblem(ChainBatch.from_models([errors] * 1000), (data,), np.zeros(24)))
    assert found.converged.all()
    scores = (found.x + [p.nominal for p in errors.parameters] - truth) / found.std
    np.testing.assert_allclose(np.sqrt(np.mean(scores**2, 0)), 1.0, atol=0.1)


@pytest.mark.parametrize("method", ["lm", "gn"])
def test_singular_members_leave_the_others_alone(method, sim_6dof, sim_6dof_actual):
    """A member that never moves, and one that measures nothing wrong, among good ones."""
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    joints = [rng.uniform(-3, 3, (10, 6)), np.zeros((10, 6)), rng.uniform(-3, 3, (10, 6))]
    data = [[Pose.simulate(sim_6dof_actual, q, NOISE, rng)] for q in joints]
    data.append([Pose(joints[0], sim_6dof.poses(joints[0]), 1e-4, 1e-4)])
    found = solve_batch(BatchProblem.from_models([errors] * 4, data, np.zeros(24)), method)
    assert found.converged.all()
    assert list(found.rank) == [24, 6, 24, 21]
    for i, alone in enumerate(one_by_one([errors] * 4, data, np.zeros(24), method)):
        assert np.abs(row_space(alone.system.r) @ (found.x[i] - alone.x)).max() < 1e-9
    assert np.abs(found.x[3]).max() < 1e-12


def test_a_runaway_is_not_called_converged():
    """Four positions of the 3-DOF arm make plain Gauss-Newton diverge now and then."""
    nominal, actual = Chain.from_dh(paper("sim_3dof")), Chain.from_dh(paper("sim_3dof_actual"))
    data, errors = [], select_parameters(nominal, "dh")
    for seed in range(50):
        q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (4, 3))
        data.append([Position.simulate(actual, q, Noise(), np.random.default_rng(0))])
    found = solve_batch(BatchProblem.from_models([errors] * 50, data, np.zeros(12)), "gn")
    stopped = found.converged & (found.cost < 1e-12)
    assert 40 <= stopped.sum() < 50
    assert np.isfinite(found.x[stopped]).all()


def test_surveyed_instruments_only(sim_6dof):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    truth = wrong(errors, rng)
    data = Wires.simulate(truth, rng.uniform(-3, 3, (40, 6)), Noise(1e-5), rng)
    with pytest.raises(DhcalError, match=r"wire1\.x is unknown"):
        BatchProblem.from_models([errors], [[data]], 1 / errors.priors)
    points = truth.poses(data.q)[:, :3, 3]
    anchors = points.mean(0) + [-1.5, 0, 0] + 0.3 * np.array([[0, 0, 1], [0, 0.866, -0.5], [0, -0.866, -0.5]])
    known = {f"wire{i + 1}.{axis}": anchors[i, j] for i in range(3) for j, axis in enumerate("xyz")}
    found = solve_batch(BatchProblem.from_models([errors] * 2, [[data]] * 2, 1 / errors.priors, known))
    alone = METHODS["lm"](Problem(errors, (data,), 1 / errors.priors, known), np.zeros(24), 100, None)
    np.testing.assert_allclose(found.x, [alone.x, alone.x], atol=1e-9)


def test_what_does_not_go_together_is_said(sim_6dof):
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (7, 6))
    pose, position = (kind.simulate(sim_6dof, q, NOISE, rng) for kind in (Pose, Position))
    with pytest.raises(DhcalError, match="more than its samples"):
        concatenate([pose, position])
    errors = select_parameters(sim_6dof, "dh")
    with pytest.raises(DhcalError, match="cannot be divided among 2"):
        BatchProblem(ChainBatch.from_models([errors] * 2), (pose,), np.zeros(24))
    with pytest.raises(DhcalError, match="arm 2 has other joints or other parameters"):
        ChainBatch.from_models([errors, select_parameters(sim_6dof, "minimal")])
    with pytest.raises(DhcalError, match="calibrate such arms one by one"):
        ChainBatch.from_models([select_parameters(sim_6dof, "dh,gain")])
    with pytest.raises(DhcalError, match="choose from lm, gn"):
        solve_batch(BatchProblem(ChainBatch.from_models([errors]), (pose,), np.zeros(24)), "newton")


def test_processes_give_the_same_digits(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (3000, 6)), NOISE, rng)
    batch = BatchProblem(ChainBatch.from_models([errors] * 300), (data,), np.zeros(24))
    with open_executor(jobs=2) as two:
        np.testing.assert_array_equal(solve_batch(batch, executor=two).x, solve_batch(batch).x)
