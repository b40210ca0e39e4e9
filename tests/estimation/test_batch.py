"""Batches against the solver for single problems, and against the scatter over repetitions."""

import numpy as np
import pytest
from robots import nominal_arm, paper, random_joints, random_table

from dhcal_pin._kernels import kinematics
from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import BatchProblem, Problem, minimize, select_parameters, solve_batch
from dhcal_pin.estimation.batch import ChainBatch
from dhcal_pin.estimation.batch.solver import MAX_LOCKSTEP
from dhcal_pin.estimation.qr import row_space
from dhcal_pin.exceptions import DhcalError, InvalidArgumentError, UnknownNameError
from dhcal_pin.measurements import KINDS, Noise, Pose, Position, Wires
from dhcal_pin.measurements.base import concatenate
from dhcal_pin.parallel import open_executor
from dhcal_pin.robot import Chain

pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = Noise(1e-4, 1e-4)


def true_chain(errors, rng, size=3e-3):
    """Return a chain with random errors of this standard deviation [m and rad]."""
    return errors.at(size * rng.normal(size=len(errors.parameters)))


def one_by_one(models, data, weights, method="lm"):
    """Solve the problems of a batch by `minimize`."""
    return [
        minimize(Problem(model, tuple(items), weights), method)
        for model, items in zip(models, data, strict=True)
    ]


@pytest.mark.parametrize(
    "sets", ["dh", "modified-dh", "minimal,base,tool", "placement,tool", "base,dh,offset,tool"]
)
@pytest.mark.parametrize("seed", range(3))
def test_frames_and_derivatives_agree_with_those_of_single_chains(sets, seed):
    """Robots of one structure with revolute and prismatic joints, and different nominal geometry."""
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    all_errors = select_parameters(Chain.from_dh(table), "placement,base,tool")
    models = [select_parameters(true_chain(all_errors, rng), sets) for _ in range(4)]
    x = 1e-2 * rng.normal(size=(4, len(models[0].parameters)))
    q = random_joints(rng, table, 2 * 4 * 3).reshape(2, 4, 3, -1)
    chains, bodies, twists = ChainBatch.from_models(models).derivative(x)
    frames = chains.forward_kinematics(q)
    jacobian = np.empty((len(x[0]), 6, 2 * 4 * 3))
    kinematics.batch_point_jacobian(frames.columns, frames.tool[3], bodies, twists, 2, jacobian)
    jacobian = jacobian.reshape(-1, 6, 2, 4, 3)
    for i, model in enumerate(models):
        chain, own_bodies, own_twists = model.derivative(x[i])
        alone = chain.forward_kinematics(chain.joint_state(q[:, i].reshape(6, -1)))
        wanted = chain.tool_jacobian(alone, own_bodies, own_twists).reshape(-1, 6, 2, 3)
        np.testing.assert_allclose(jacobian[:, :, :, i], wanted, atol=1e-13)
        np.testing.assert_allclose(
            frames.tool.reshape(4, 3, 2, 4, 3)[..., i, :].reshape(4, 3, 6), alone.tool, atol=1e-13
        )
        np.testing.assert_allclose(chains.chain(i).poses(q[0, i]), chain.poses(q[0, i]), atol=1e-13)


@pytest.mark.parametrize("seed", range(10))
def test_solutions_agree_with_the_single_solver(seed):
    """20 problems with random robot, parameter set, measurement kinds, priors and method; 200 in all.

    Observable directions agree to 1e-9 m and rad, all others to a millionth of a standard deviation.
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
        truth = true_chain(errors, rng)
        data.append(
            [KINDS[kind].simulate(truth, random_joints(rng, table, 15), NOISE, rng) for kind in kinds]
        )
    found = solve_batch(BatchProblem.from_models([errors] * 20, data, weights), method)
    for i, alone in enumerate(one_by_one([errors] * 20, data, weights, method)):
        difference = found.x[i] - alone.x
        assert np.abs(row_space(alone.system.r) @ difference).max() < 1e-9
        assert np.abs(np.concatenate([alone.system.r, np.diag(weights)]) @ difference).max() < 1e-6
        assert found.converged[i] == alone.converged
        cost = alone.system.min_cost + alone.system.z @ alone.system.z
        assert found.cost[i] == pytest.approx(cost, rel=1e-9)


def test_problems_with_curved_rows_converge_as_alone():
    """Positions of robots with errors that the minimal set describes only in part.

    The lockstep iteration alone leaves most of them unconverged after 100 iterations.
    """
    rng = np.random.default_rng(71)
    arm = nominal_arm("ur10")
    errors = select_parameters(arm, "placement")
    models, data = [], []
    for number in range(8):
        truth = true_chain(errors, rng)
        models.append(select_parameters(arm if number % 2 else true_chain(errors, rng, 1e-4), "minimal"))
        data.append([Position.simulate(truth, rng.uniform(-3, 3, (60, 6)), Noise(5e-5), rng)])
    weights = 1 / models[1].priors
    found = solve_batch(BatchProblem.from_models(models, data, weights))
    assert found.converged.all()
    assert found.iterations.max() > MAX_LOCKSTEP
    for i, alone in enumerate(one_by_one(models, data, weights)):
        assert alone.converged
        assert found.cost[i] == pytest.approx(alone.system.cost, rel=1e-5)


def test_nominal_robots_and_numbers_of_samples_may_differ():
    """As in a fleet of robots, or in the folds of a cross-validation."""
    rng = np.random.default_rng(0)
    table = random_table(rng, size=5)
    models = [
        select_parameters(
            true_chain(select_parameters(Chain.from_dh(table), "placement"), rng, 0.05), "minimal,base,tool"
        )
        for _ in range(6)
    ]
    data = [
        [Pose.simulate(true_chain(model, rng), random_joints(rng, table, m), NOISE, rng)]
        for model, m in zip(models, (12, 20, 15, 20, 13, 19), strict=True)
    ]
    weights = 1 / models[0].priors
    batch = BatchProblem.from_models(models, data, weights)
    found = solve_batch(batch)
    for i, alone in enumerate(one_by_one(models, data, weights)):
        np.testing.assert_allclose(found.x[i], alone.x, atol=1e-9)
    np.testing.assert_array_equal(batch.count_rows(), 6 * np.array([12, 20, 15, 20, 13, 19]))


def test_rank_and_standard_deviations_agree_with_calibrate(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    data = [[Position.simulate(sim_6dof_actual, rng.uniform(-3, 3, (30, 6)), NOISE, rng)] for _ in range(3)]
    found = solve_batch(BatchProblem.from_models([errors] * 3, data, np.zeros(24)))
    for i, items in enumerate(data):
        fit = calibrate(sim_6dof, items, "dh", priors="none")
        assert fit.converged
        assert found.rank[i] == fit.rank == 23
        np.testing.assert_allclose(found.std[i], fit.std, rtol=1e-5)


def test_standard_deviations_agree_with_the_scatter_over_repetitions(sim_6dof, sim_6dof_actual):
    """1,000 repetitions: the ratio of scatter to stated standard deviation is 1 for each parameter."""
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
def test_singular_problems_do_not_affect_the_others(method, sim_6dof, sim_6dof_actual):
    """One problem has a single configuration, another one has no errors."""
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


def test_a_diverging_problem_is_not_reported_as_converged():
    """With four positions of the 3-DOF robot, Gauss-Newton diverges in some cases."""
    nominal, actual = Chain.from_dh(paper("sim_3dof")), Chain.from_dh(paper("sim_3dof_actual"))
    data, errors = [], select_parameters(nominal, "dh")
    for seed in range(50):
        q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (4, 3))
        data.append([Position.simulate(actual, q, Noise(), np.random.default_rng(0))])
    found = solve_batch(BatchProblem.from_models([errors] * 50, data, np.zeros(12)), "gn")
    solved = found.converged & (found.cost < 1e-12)
    assert 40 <= solved.sum() < 50
    assert np.isfinite(found.x[solved]).all()


def test_instruments_must_be_known(sim_6dof):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    truth = true_chain(errors, rng)
    data = Wires.simulate(truth, rng.uniform(-3, 3, (40, 6)), Noise(1e-5), rng)
    with pytest.raises(DhcalError, match=r"wire1\.x is unknown"):
        BatchProblem.from_models([errors], [[data]], 1 / errors.priors)
    points = truth.poses(data.q)[:, :3, 3]
    anchors = points.mean(0) + [-1.5, 0, 0] + 0.3 * np.array([[0, 0, 1], [0, 0.866, -0.5], [0, -0.866, -0.5]])
    known = {f"wire{i + 1}.{axis}": anchors[i, j] for i in range(3) for j, axis in enumerate("xyz")}
    known |= {f"wire{i + 1}.zero": 0.0 for i in range(3)}
    found = solve_batch(BatchProblem.from_models([errors] * 2, [[data]] * 2, 1 / errors.priors, known))
    alone = minimize(Problem(errors, (data,), 1 / errors.priors, known))
    np.testing.assert_allclose(found.x, [alone.x, alone.x], atol=1e-9)


def test_incompatible_problems_are_refused(sim_6dof):
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (7, 6))
    pose, position = (kind.simulate(sim_6dof, q, NOISE, rng) for kind in (Pose, Position))
    with pytest.raises(DhcalError, match="more than its samples"):
        concatenate([pose, position])
    errors = select_parameters(sim_6dof, "dh")
    with pytest.raises(InvalidArgumentError, match="cannot be divided among 2"):
        BatchProblem(ChainBatch.from_models([errors] * 2), (pose,), np.zeros(24))
    with pytest.raises(InvalidArgumentError, match="arm 2 has other joints or other parameters"):
        ChainBatch.from_models([errors, select_parameters(sim_6dof, "minimal")])
    with pytest.raises(InvalidArgumentError, match="calibrate such arms one by one"):
        ChainBatch.from_models([select_parameters(sim_6dof, "dh,gain")])
    with pytest.raises(UnknownNameError, match="choose from lm, gn"):
        solve_batch(BatchProblem(ChainBatch.from_models([errors]), (pose,), np.zeros(24)), "newton")


def test_processes_yield_the_same_digits(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    errors = select_parameters(sim_6dof, "dh")
    data = Pose.simulate(sim_6dof_actual, rng.uniform(-3, 3, (3000, 6)), NOISE, rng)
    batch = BatchProblem(ChainBatch.from_models([errors] * 300), (data,), np.zeros(24))
    with open_executor(jobs=2) as two:
        np.testing.assert_array_equal(solve_batch(batch, executor=two).x, solve_batch(batch).x)
