"""Pose measurements: the paper's small-angle rows, and rotation noise."""

import numpy as np
import pytest
from robots import paper

from dhcal_pin import se3
from dhcal_pin._kernels import apply_observation_matrix
from dhcal_pin.estimation import select_parameters
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.paper.factors import error_factors, tool_error


def test_small_angle_rows_are_those_of_the_paper(sim_6dof, sim_6dof_actual):
    """In axes of the tool frame, the small-angle rows are R and (35), (36)."""
    q = np.random.default_rng(3).uniform(-3, 3, (11, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    errors = select_parameters(sim_6dof, "dh")
    chain, bodies, twists = errors.derivative(np.zeros(24))
    frames = chain.forward_kinematics(q)
    residual, mixture = data.small_angle(frames, np.array([]))
    velocities = chain.tool_jacobian(frames, bodies, twists)
    rows = apply_observation_matrix(velocities, mixture, np.empty((24, *residual.shape)))
    rotation = chain.poses(q)[:, :3, :3]
    into_tool = np.zeros((11, 6, 6))
    into_tool[:, :3, :3] = into_tool[:, 3:, 3:] = np.swapaxes(rotation, 1, 2)
    seen = np.einsum("mij,jm->mi", into_tool, residual) * 1e-3
    np.testing.assert_allclose(seen, tool_error(data.poses, chain.poses(q)), atol=1e-15)
    order = [next(i for i, p in enumerate(errors.parameters) if p.name == f"{key}{j}")
             for key in ("theta", "d", "a", "alpha") for j in range(1, 7)]  # fmt: skip
    mine = np.einsum("mij,pjm->mip", into_tool, rows)[:, :, order] * 1e-3
    np.testing.assert_allclose(mine, error_factors(paper("sim_6dof"), q), atol=1e-14)


def test_rotation_noise_has_the_given_standard_deviation(sim_6dof):
    data = Pose.simulate(sim_6dof, np.zeros((50, 6)), Noise(0, 0.2), np.random.default_rng(0))
    spread = se3.log3(data.poses[:, :3, :3] @ np.swapaxes(sim_6dof.poses(np.zeros((50, 6)))[:, :3, :3], 1, 2))
    assert np.std(spread) == pytest.approx(0.2, rel=0.15)
