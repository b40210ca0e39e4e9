"""Error factors of the paper against finite differences, and its errata."""

from dataclasses import replace

import numpy as np
import pytest
from robots import paper, random_table

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.paper import (
    alpf,
    apply_correction,
    error_factors,
    laf,
    ldf,
    link_vectors,
    pseudo_inverse_step,
    tail_matrices,
    thf,
    tool_error,
)
from dhcal_pin.paper.jacobian_check import numerical_jacobian
from dhcal_pin.robot import Chain, DHTable

ARMS = ["sim_6dof", "sim_6dof_actual", "sim_3dof", "sim_3dof_actual", "experiment", "experiment_published"]


KEYS = ("theta", "d", "a", "alpha")


def joints(table: DHTable, m: int = 30, seed: int = 0):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (m, table.n_joints))


def q_matrices(table: DHTable):
    """Return the derivative matrices Q, equations (9) and (10).

    They satisfy ∂A_i/∂x = A_i·Q_x. Erratum, probably of the transcription: Q_α has -1 at row 2, column 3.
    """
    s, c = np.sin(table.alpha), np.cos(table.alpha)
    out = np.zeros((4, table.n_joints, 4, 4))
    # Q_θ
    out[0, :, 0, 1], out[0, :, 0, 2] = -c, s
    out[0, :, 1, 0], out[0, :, 1, 3] = c, table.a * c
    out[0, :, 2, 0], out[0, :, 2, 3] = -s, -table.a * s
    # Q_d
    out[1, :, 1, 3], out[1, :, 2, 3] = s, c
    # Q_a
    out[2, :, 0, 3] = 1.0
    # Q_α
    out[3, :, 1, 2], out[3, :, 2, 1] = -1.0, 1.0
    return out


def test_link_derivatives_are_products_with_q():
    """Equations (7) to (10): ∂A/∂x = A·Q_x."""
    table, h = paper("sim_6dof_actual"), 1e-6
    q = joints(table, 1)
    rows = table.rows(q)[0]
    for key, matrix in zip(KEYS, q_matrices(table), strict=True):
        up, down = (replace(table, **{key: getattr(table, key) + s * h}).rows(q)[0] for s in (1, -1))
        np.testing.assert_allclose(rows @ matrix, (up - down) / (2 * h), atol=1e-9)


def test_small_motion_of_a_link_is_the_sum_of_its_vectors():
    """Equations (11) to (14): the vectors k agree with the matrices Q."""
    table = paper("sim_6dof_actual")
    k1, k2, k3 = link_vectors(table)
    zero = np.zeros_like(k1)
    for matrix, linear, angular in zip(
        q_matrices(table), (k1, k2, k3, zero), (k2, zero, zero, k3), strict=True
    ):
        np.testing.assert_allclose(matrix[:, :3, 3], linear, atol=1e-16)
        np.testing.assert_allclose(matrix[:, :3, :3], se3.skew(angular), atol=1e-16)


@pytest.mark.parametrize("arm", ARMS)
def test_factors_are_the_derivative_of_the_dh_product(arm):
    table = paper(arm)
    q = joints(table)
    np.testing.assert_allclose(error_factors(table, q), numerical_jacobian(table, q), atol=1e-9)


def test_factors_of_random_arms_with_prismatic_joints():
    rng = np.random.default_rng(7)
    for _ in range(20):
        table = random_table(rng)
        table = replace(table, beta=rng.uniform(-0.1, 0.1, table.n_joints), tool=se3.exp6(rng.normal(size=6)))
        q = joints(table, 5)
        np.testing.assert_allclose(error_factors(table, q), numerical_jacobian(table, q), atol=1e-8)


def test_the_printed_vector_15_is_wrong():
    """As printed, k1 = [0, a·sα, -a·cα] differs from the derivative by up to 145 mm/rad."""
    table = paper("sim_6dof_actual")
    q = joints(table, 100)
    k1, k2, k3 = link_vectors(table)
    printed = np.stack([0 * table.a, table.a * np.sin(table.alpha), -table.a * np.cos(table.alpha)], -1)
    u, numeric = tail_matrices(table, q), numerical_jacobian(table, q)

    def gap(first):
        blocks = [thf(u, first, k2), ldf(u, k2), laf(u, k3), alpf(u, k3)]
        return np.abs(np.concatenate([np.swapaxes(b, 1, 2) for b in blocks], -1) - numeric).max()

    assert gap(k1) < 1e-9
    assert gap(printed) == pytest.approx(0.145, abs=0.002)


def test_a_loop_with_the_printed_vector_converges():
    """Convergence does not validate R; only the comparison with finite differences does."""
    nominal, actual = paper("sim_6dof"), paper("sim_6dof_actual")
    q = joints(nominal, 10)
    goal, table = actual.poses(q), nominal
    for _ in range(25):
        _, k2, k3 = link_vectors(table)
        printed = np.stack([0 * table.a, table.a * np.sin(table.alpha), -table.a * np.cos(table.alpha)], -1)
        u = tail_matrices(table, q)
        blocks = [thf(u, printed, k2), ldf(u, k2), laf(u, k3), alpf(u, k3)]
        factors = np.concatenate([np.swapaxes(b, 1, 2) for b in blocks], -1)
        table = apply_correction(table, pseudo_inverse_step(factors, tool_error(goal, table.poses(q))))
    np.testing.assert_allclose(table.d, actual.d, atol=1e-9)


def test_ldf_and_laf_have_no_rotation():
    table = paper("sim_6dof_actual")
    factors = error_factors(table, joints(table))
    assert np.abs(factors[:, 3:, 6:18]).max() == 0.0


def differential_motion(change, pose):
    """Compute dn, do, da, dp of the tool pose, shape (..., 3, 4), from DX: equations (30) to (34).

        dT_N = T_N·δT_N = [dn do da dp; 0 0 0 0]     (30)
        dn   =  o·δz - a·δy                          (31)
        do   = -n·δz + a·δx                          (32)
        da   =  n·δy - o·δx                          (33)
        dp   =  n·dx + o·dy + a·dz                   (34)

    Erratum, probably of the transcription: (31) prints a·δz in place of o·δz.
    """
    n, o, a = pose[..., :3, 0], pose[..., :3, 1], pose[..., :3, 2]
    dx, dy, dz, rx, ry, rz = (change[..., i, None] for i in range(6))
    return np.stack([o * rz - a * ry, a * rx - n * rz, n * ry - o * rx, n * dx + o * dy + a * dz], -1)


def test_differential_motion_is_the_derivative_of_the_pose():
    """Equations (30) to (34), with the erratum of (31), against finite differences."""
    table = paper("sim_6dof_actual")
    pose = table.poses(joints(table))
    change = np.random.default_rng(3).normal(size=(len(pose), 6))
    h = 1e-7
    numeric = (pose @ se3.exp6(h * change) - pose @ se3.exp6(-h * change)) / (2 * h)
    np.testing.assert_allclose(differential_motion(change, pose), numeric[:, :3], atol=1e-8)


def test_tool_error_is_nearly_the_logarithm():
    """(35) and (36): d = Rᵀ·dp, and sin(φ)·u in place of φ·u; they differ by at most 0.087°."""
    nominal, actual = paper("sim_6dof"), paper("sim_6dof_actual")
    gaps = []
    for seed in range(50):
        q = joints(nominal, 10, seed)
        measured, model = actual.poses(q), nominal.poses(q)
        error = tool_error(measured, model)
        relative = se3.inverse(model) @ measured
        np.testing.assert_allclose(error[:, :3], relative[:, :3, 3], atol=1e-15)
        log = se3.log3(relative[:, :3, :3])
        angle = np.linalg.norm(log, axis=1, keepdims=True)
        np.testing.assert_allclose(error[:, 3:], log / angle * np.sin(angle), atol=1e-14)
        gaps.append(np.abs(error[:, 3:] - log).max())
    assert np.rad2deg(max(gaps)) < 0.088


def test_modified_tables_are_an_error():
    with pytest.raises(DhcalError, match="standard"):
        error_factors(random_table(np.random.default_rng(0), "modified"), np.zeros((1, 1)))


def test_a_chain_is_no_table():
    with pytest.raises(DhcalError, match=r"table has type Chain; expected a DH table"):
        error_factors(Chain.from_dh(paper("experiment")), np.zeros((1, 3)))  # pyright: ignore[reportArgumentType]
