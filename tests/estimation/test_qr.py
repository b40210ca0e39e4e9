"""Triangular systems against the QR of all rows at once, and against arithmetic of fifty digits."""

import mpmath
import numpy as np
import pytest
from robots import paper

from dhcal_pin._kernels import qr as numpy_qr
from dhcal_pin.estimation import (
    Problem,
    TriangularSystem,
    linearize_and_factor,
    problem,
    qr,
    select_parameters,
)
from dhcal_pin.estimation.batch import TriangularSystemBatch
from dhcal_pin.estimation.problem import CHUNK_SIZE
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.measurements.base import whitened_jacobian
from dhcal_pin.robot import Chain

NO_INSTRUMENT = np.empty(0)


def whitened_rows(errors, data, x):
    """Return the whitened Jacobian (p, k·m) and residuals (k·m,) of all samples at once."""
    model = errors.derivative(x)
    frames = model[0].forward_kinematics(data.q)
    residual = data.residual(frames, NO_INSTRUMENT)
    rows = whitened_jacobian(data, model, frames, NO_INSTRUMENT, residual)
    return rows.reshape(len(x), -1), residual.ravel()


def test_merged_chunks_equal_the_qr_of_all_rows(sim_6dof_actual):
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (2 * CHUNK_SIZE + 17, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(1e-4, 1e-4), rng)
    errors, zero = select_parameters(sim_6dof_actual, "dh"), np.zeros(24)
    system = linearize_and_factor(Problem(errors, (data,), zero), zero, small_angle=False)
    rows, residual = whitened_rows(errors, data, zero)
    r = np.linalg.qr(rows.T, mode="r")
    np.testing.assert_allclose(np.abs(system.r), np.abs(r), atol=1e-9 * np.abs(r).max())
    assert system.min_cost + system.z @ system.z == pytest.approx(np.sum(residual**2), rel=1e-12)
    assert system.cost == pytest.approx(np.sum(residual**2), rel=1e-12)


@pytest.mark.parametrize("kernel", ["compiled", "panels", "plain"])
@pytest.mark.parametrize("n_samples", [50, 700])
def test_each_kernel_keeps_the_products_of_the_rows(kernel, n_samples, sim_6dof, monkeypatch):
    """All residuals or one at a time, by panels or not, with columns that are zero in some rows."""
    if kernel != "compiled":
        monkeypatch.setattr(numpy_qr, "USE_PANELS", kernel == "panels")
        monkeypatch.setattr(problem, "factor_jacobian", numpy_qr.factor_jacobian)
    errors, rng = select_parameters(sim_6dof, "dh"), np.random.default_rng(0)
    data = Pose.simulate(sim_6dof, rng.uniform(-3, 3, (n_samples, 6)), Noise(1e-4, 1e-4), rng)
    zero = np.zeros(24)
    system = linearize_and_factor(Problem(errors, (data,), zero), zero, small_angle=False)
    jacobian, residual = whitened_rows(errors, data, zero)
    rows = np.concatenate([jacobian, residual[None]])
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    factor = np.zeros((25, 25))
    factor[:24, :24], factor[:24, 24], factor[24, 24] = system.r, system.z, np.sqrt(system.min_cost)
    assert np.array_equal(factor, np.triu(factor))
    factor /= np.linalg.norm(factor, axis=0)
    np.testing.assert_allclose(factor.T @ factor, rows @ rows.T, atol=1e-13)


def test_the_rank_is_full_at_condition_1e8():
    """JᵀJ would lose the smallest singular values."""
    rng = np.random.default_rng(0)
    u, _ = np.linalg.qr(rng.normal(size=(50, 6)))
    v, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    r = np.asarray(np.linalg.qr(u * np.logspace(0, -8, 6) @ v, mode="r"))
    assert qr.rank(r) == 6
    system = TriangularSystem(np.pad(r, (0, 1)))
    assert system.rank == 6
    assert system.condition == pytest.approx(1e8, rel=1e-6)


def test_row_space_and_null_space_are_complements():
    rng = np.random.default_rng(0)
    r = np.asarray(np.linalg.qr(rng.normal(size=(50, 4)) @ rng.normal(size=(4, 6)), mode="r"))
    observable, unobservable = qr.row_space(r), qr.null_space(r)
    assert observable.shape == (4, 6)
    assert unobservable.shape == (6, 2)
    assert np.abs(r @ unobservable).max() < 1e-12 * np.abs(r).max()
    both = np.concatenate([observable, unobservable.T])
    np.testing.assert_allclose(both @ both.T, np.eye(6), atol=1e-14)


@pytest.mark.parametrize("largest", [1.0, 1e9])
def test_priors_couple_observable_and_unobservable_directions(largest):
    """Of five directions two are determined, one of them much better: (RᵀR + W²)⁻¹ with sixty digits."""
    rng = np.random.default_rng(3)
    directions = np.linalg.qr(rng.normal(size=(5, 5)))[0][:2]
    exact_rows = np.array([[largest], [3.0]]) * directions
    rows = np.zeros((6, 6))
    rows[:2, :5] = np.linalg.qr(exact_rows, mode="r")
    weights = np.array([1.0, 0.3, 2.0, 0.7, 5.0])
    root, unbounded = TriangularSystem(rows).sqrt_covariance(weights)
    assert unbounded.shape == (5, 0)
    with mpmath.workdps(60):
        information = mpmath.matrix(exact_rows.tolist()).T * mpmath.matrix(exact_rows.tolist())
        exact = (information + mpmath.diag((weights**2).tolist())) ** -1
        exact = np.array(exact.tolist(), float)
    std = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(root @ root.T / np.outer(std, std), exact / np.outer(std, std), atol=1e-6)


def test_the_step_is_exact_at_condition_1e8():
    """Nearly parallel axes: the same rows solved with fifty digits give the same step."""
    errors = select_parameters(Chain.from_dh(paper("sim_6dof")), "dh")
    tilts = [i for i, p in enumerate(errors.parameters) if p.name in ("alpha2", "alpha3", "alpha5")]
    x = np.zeros(24)
    x[tilts] = 1e-4, -2e-4, 1e-4
    rng = np.random.default_rng(2)
    q = rng.uniform(-3, 3, (12, 6))
    data = Pose.simulate(errors.at(x + 1e-4 * rng.normal(size=24)), q, Noise(1e-4, 1e-4), rng)
    case = Problem(errors, (data,), np.zeros(24))
    system = linearize_and_factor(case, x, small_angle=False).with_priors(case.weights, x)
    assert system.rank == 24
    assert 3e7 < system.condition < 3e8
    rows, residual = whitened_rows(errors, data, x)
    with mpmath.workdps(50):
        # Fifty digits can afford the normal equations.
        exact = mpmath.lu_solve(mpmath.matrix(rows.T.tolist()), mpmath.matrix(residual.tolist()))
        exact = np.array([float(value) for value in exact])
    step = qr.pseudo_inverse(system.r, system.z)
    assert np.linalg.norm(step - exact) <= 1e-6 * np.linalg.norm(exact)


def test_the_pseudo_inverse_survives_a_decomposition_that_does_not_converge(monkeypatch):
    """The divide and conquer method fails for some matrices whose elements differ by twenty digits."""
    rng = np.random.default_rng(0)
    r = np.asarray(np.linalg.qr(rng.normal(size=(20, 3)) @ rng.normal(size=(3, 5)), mode="r"))
    z = rng.normal(size=5)
    wanted = np.linalg.pinv(r, rcond=qr.RANK_RTOL) @ z
    np.testing.assert_allclose(qr.pseudo_inverse(r, z), wanted, atol=1e-12)

    def fail(*_args, **_options):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(np.linalg, "lstsq", fail)
    np.testing.assert_allclose(qr.pseudo_inverse(r, z), wanted, atol=1e-12)
    monkeypatch.setattr(np.linalg, "svd", fail)
    np.testing.assert_allclose(qr.pseudo_inverse(r, z), wanted, atol=1e-12)


@pytest.mark.parametrize("rank", [3, 5])
def test_a_batch_of_systems_agrees_with_the_single_one(rank):
    """The members that both classes share, with damping, for a full and a deficient rank."""
    rng = np.random.default_rng(rank)
    rows = np.linalg.qr(rng.normal(size=(4, 20, rank)) @ rng.normal(size=(4, rank, 5)), mode="r")
    rows = np.concatenate([rows, np.zeros((4, max(5 - rows.shape[1], 0), 5))], 1)
    rows = np.concatenate([rows, rng.normal(size=(4, 5, 1))], 2)
    rows = np.concatenate([rows, np.zeros((4, 1, 6))], 1)
    rows[:, 5, 5] = rng.normal(size=4)
    batch = TriangularSystemBatch(rows.copy())
    diagonal = rng.uniform(0.1, 1, (4, 5))
    steps, damped = batch.solve(), batch.with_damping(diagonal)
    changes = batch.residual_change(steps)
    for i in range(4):
        single = TriangularSystem(rows[i])
        step = qr.pseudo_inverse(single.r, single.z)
        np.testing.assert_allclose(steps[i], step, rtol=1e-9, atol=1e-12)
        change = single.residual_change(step)
        np.testing.assert_allclose(changes[i], change, rtol=1e-9, atol=1e-12)
        assert batch.predicted_reduction(changes)[i] == pytest.approx(single.predicted_reduction(change))
        for name in ("cost", "roundoff"):
            assert getattr(batch, name)[i] == pytest.approx(getattr(single, name), rel=1e-12)
        wanted = qr.append_rows(single, diagonal[i], np.zeros(5))
        assert damped.cost[i] == pytest.approx(wanted.cost, rel=1e-12)
        np.testing.assert_allclose(
            damped.solve()[i], qr.pseudo_inverse(wanted.r, wanted.z), rtol=1e-9, atol=1e-12
        )


def test_without_data_the_covariance_is_that_of_the_priors(capfd):
    """Also LAPACK, which prints to standard output itself, says nothing."""
    sigma = np.array([1e-3, 2.0, 5e-9])
    root, unbounded = TriangularSystem(np.zeros((4, 4))).sqrt_covariance(1 / sigma)
    np.testing.assert_allclose(root @ root.T, np.diag(sigma**2), rtol=1e-12, atol=1e-30)
    assert unbounded.shape == (3, 0)
    assert capfd.readouterr() == ("", "")


def test_a_decomposition_that_does_not_converge_is_tried_another_way(monkeypatch):
    """A matrix of 408 columns with values up to 5e18 was one."""
    r = np.triu(np.random.default_rng(0).standard_normal((5, 5)))
    r[-1] = 0
    expected, decompose = qr.null_space(r), np.linalg.svd

    def fail(a, compute_uv=True):
        if compute_uv:
            raise np.linalg.LinAlgError("SVD did not converge")
        return decompose(a, compute_uv=False)

    monkeypatch.setattr(np.linalg, "svd", fail)
    found = qr.null_space(r)
    np.testing.assert_allclose(np.abs(found.T @ expected), [[1.0]], atol=1e-12)
