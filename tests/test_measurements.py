"""Conformance of every kind of measurement: it walks the list, a new kind needs no edit here."""

from __future__ import annotations

import numpy as np
import pytest

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.errors import DhcalError
from dhcal_pin.measurements import KINDS, Noise, Pose, Position
from dhcal_pin.parameters import select

KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def setting(chain, kind, seed=0, m=7):
    """Readings of an arm that is a little off, noisy, and the errors to differentiate by."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (m, chain.size))
    errors = select(chain, "dh,base,tool")
    x = 0.1 * rng.normal(size=len(errors.parameters))
    return kind.simulate(errors.at(x), q, Noise(1e-3, 1e-3), rng), errors, x, rng


@KIND
def test_derivative_equals_central_differences(kind, sim_6dof_actual):
    h = 1e-6
    for seed in range(20):
        data, errors, x, rng = setting(sim_6dof_actual, kind, seed)
        x = x + 0.2 * rng.normal(size=len(x))
        chain, bodies, twists = errors.derivative(x)
        sweep = chain.sweep(data.q)
        rows = data.whiten(sweep, chain.tool_velocities(sweep, bodies, twists))
        assert rows.shape == (len(x), *data.residual(sweep).shape)
        for k in range(len(x)):
            step = h * np.eye(len(x))[k]
            up, down = (data.residual(errors.at(x + s * step).sweep(data.q)) for s in (1, -1))
            numeric = -(up - down) / (2 * h)
            np.testing.assert_allclose(rows[k], numeric, atol=1e-6 * max(1.0, np.abs(rows).max()))


@KIND
def test_truth_leaves_no_residual(kind, sim_6dof_actual):
    q = np.random.default_rng(0).uniform(-3, 3, (9, 6))
    data = kind.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    assert np.abs(data.residual(sim_6dof_actual.sweep(q))).max() < 1e-10


@KIND
def test_noise_whitens_to_one(kind, sim_6dof_actual):
    rng = np.random.default_rng(5)
    q = rng.uniform(-3, 3, (4000, 6))
    data = kind.simulate(sim_6dof_actual, q, Noise(2e-4, 3e-4), rng)
    residual = data.residual(sim_6dof_actual.sweep(q))
    for rows in data.groups.values():
        assert np.std(residual[rows]) == pytest.approx(1.0, abs=0.03)


@KIND
def test_slices_are_slices(kind, sim_6dof_actual):
    data, _, _, _ = setting(sim_6dof_actual, kind)
    part = data.take(np.array([1, 4]))
    whole = data.residual(sim_6dof_actual.sweep(data.q))
    np.testing.assert_array_equal(part.residual(sim_6dof_actual.sweep(part.q)), whole[:, [1, 4]])
    np.testing.assert_array_equal(part.rows, [2, 5])


@KIND
def test_sigmas_divide(kind, sim_6dof_actual):
    data, _, _, _ = setting(sim_6dof_actual, kind)
    sweep = sim_6dof_actual.sweep(data.q)
    scaled = data.scaled(dict.fromkeys(data.groups, 4.0))
    np.testing.assert_allclose(scaled.residual(sweep) * 4, data.residual(sweep), rtol=1e-14)


@KIND
def test_noise_free_calibration_finds_other_poses(kind, sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(8)
    data = kind.simulate(sim_6dof_actual, rng.uniform(-3, 3, (40, 6)), Noise(), rng)
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    other = kind.simulate(sim_6dof_actual, rng.uniform(-3, 3, (50, 6)), Noise(), rng)
    assert fit.converged
    assert fit.validate(other)["position_max_m"] < 1e-9


def test_paper_rows_are_its_r_and_sine(sim_6dof, sim_6dof_actual):
    """Seen in the tool frame, the small-angle rows are R and (35), (36)."""
    from conftest import paper

    from dhcal_pin.factors import error_factors, tool_error

    q = np.random.default_rng(3).uniform(-3, 3, (11, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    errors = select(sim_6dof, "dh")
    chain, bodies, twists = errors.derivative(np.zeros(24))
    sweep = chain.sweep(q)
    residual, rows = data.small_angle(sweep, chain.tool_velocities(sweep, bodies, twists))
    rotation = chain.poses(q)[:, :3, :3]
    into_tool = np.zeros((11, 6, 6))
    into_tool[:, :3, :3] = into_tool[:, 3:, 3:] = np.swapaxes(rotation, 1, 2)
    seen = np.einsum("mij,jm->mi", into_tool, residual) * 1e-3
    np.testing.assert_allclose(seen, tool_error(data.poses, chain.poses(q)), atol=1e-15)
    order = [next(i for i, p in enumerate(errors.parameters) if p.name == f"{key}{j}")
             for key in ("theta", "d", "a", "alpha") for j in range(1, 7)]  # fmt: skip
    mine = np.einsum("mij,pjm->mip", into_tool, rows)[:, :, order] * 1e-3
    np.testing.assert_allclose(mine, error_factors(paper("sim_6dof"), q), atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda q, p: Position.of(q, p[:3, :3, 3]), "position has shape"),
        (lambda q, p: Position.of(q, p[:, :3, 3] * np.nan), "finite"),
        (lambda q, p: Position.of(q, p[:, :3, 3], -1e-3), "positive"),
        (lambda q, p: Pose.of(q, p * 2), "number 1 is not a rotation"),
        (lambda q, p: Pose.of(q, p, 1e-3), "or neither"),
    ],
)
def test_wrong_readings_are_refused(make, message, sim_6dof):
    q = np.zeros((5, 6))
    with pytest.raises(DhcalError, match=message):
        make(q, sim_6dof.poses(q))


def test_left_handed_rotation_is_refused(sim_6dof):
    poses = sim_6dof.poses(np.zeros((2, 6)))
    poses[:, :3, 0] *= -1
    with pytest.raises(DhcalError, match="not a rotation"):
        Pose.of(np.zeros((2, 6)), poses)


def test_small_rotation_noise_is_a_rotation(sim_6dof):
    data = Pose.simulate(sim_6dof, np.zeros((50, 6)), Noise(0, 0.2), np.random.default_rng(0))
    spread = se3.log3(data.poses[:, :3, :3] @ np.swapaxes(sim_6dof.poses(np.zeros((50, 6)))[:, :3, :3], 1, 2))
    assert np.std(spread) == pytest.approx(0.2, rel=0.15)
