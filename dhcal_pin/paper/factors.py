"""The paper's error factors, equation by equation: an independent check of the fast kernel.

Cho, Ha, Lee and Park, "Positioning Accuracy Improvement of Robots by Link Parameter Calibration".
Numbers in parentheses are the paper's equations. Where its print is wrong the derivation stands and
the text says "erratum". Twists are [v, ω] in the tool frame, lengths in metres, angles in radians.

A link's matrix changes by dA_i = A_i·δA_i (3, 4, 6), with δA_i the cross-product form (5) of a small
displacement d_i and rotation δ_i. The partial derivatives (7, 8) are written A_i·Q (9) with the
constant matrices Q (10) of `q_matrices`; their sum (11) is δA_i (12), whose entries (13, 14) are
d_i = k1·Δθ + k2·Δd + k3·Δa and δ_i = k2·Δθ + k3·Δα with the vectors (15) of `link_vectors`. The
products (16) are linearised (17), gathered behind T_N (18) with the tail matrices U (19) of
`tail_matrices`, and give the tool's own small motion (20, 21).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import DhcalError
from ..robot.dh import DHTable


def q_matrices(table: DHTable) -> Array:
    """Q_θ, Q_d, Q_a, Q_α (4, n, 4, 4): ∂A_i/∂x = A_i·Q_x, equations (9) and (10).

    Erratum, probably of the transcription: Q_α has -1 at row 2, column 3.
    """
    s, c = np.sin(table.alpha), np.cos(table.alpha)
    out = np.zeros((4, table.n_joints, 4, 4))
    out[0, :, 0, 1], out[0, :, 0, 2] = -c, s
    out[0, :, 1, 0], out[0, :, 1, 3] = c, table.a * c
    out[0, :, 2, 0], out[0, :, 2, 3] = -s, -table.a * s
    out[1, :, 1, 3], out[1, :, 2, 3] = s, c
    out[2, :, 0, 3] = 1.0
    out[3, :, 1, 2], out[3, :, 2, 1] = -1.0, 1.0
    return out


def link_vectors(table: DHTable) -> tuple[Array, Array, Array]:
    """k1, k2, k3, each (n, 3), of equations (13) to (15); k1 in metres, the others directions.

    Erratum: (15) prints k1 = [0, a·sα, -a·cα], which contradicts (13). Right is [0, a·cα, -a·sα].
    A row with Hayati's β ends in Ry(β), so its vectors are seen in a frame turned by β.
    """
    s, c, zero = np.sin(table.alpha), np.cos(table.alpha), np.zeros(table.n_joints)
    k1 = np.stack([zero, table.a * c, -table.a * s], -1)
    k2 = np.stack([zero, s, c], -1)
    k3 = np.tile([1.0, 0.0, 0.0], (table.n_joints, 1))
    turn = se3.exp3(-table.beta[:, None] * np.array([0.0, 1.0, 0.0]))
    return (
        np.einsum("nij,nj->ni", turn, k1),
        np.einsum("nij,nj->ni", turn, k2),
        np.einsum("nij,nj->ni", turn, k3),
    )


def tail_matrices(table: DHTable, q: Array) -> Array:
    """U_2 … U_{N+1} (m, n, 4, 4) at q (m, n): U_i = A_i·…·A_N·tool, equation (19).

    Entry i of the second axis is U_{i+2}, the tail behind link i+1. The paper's tool is the identity.
    """
    rows = table.rows(q)
    out = np.empty_like(rows)
    tail = np.broadcast_to(table.tool, rows[:, 0].shape)
    for i in reversed(range(table.n_joints)):
        out[:, i] = tail
        tail = rows[:, i] @ tail
    return out


def _turned(u: Array, k: Array) -> Array:
    """The dot products n·k, o·k, a·k (..., 3) with the columns of U (..., 4, 4)."""
    return np.einsum("...ij,...i->...j", u[..., :3, :3], k)


def _levered(u: Array, k: Array) -> Array:
    """The dot products (p×n)·k, (p×o)·k, (p×a)·k (..., 3)."""
    return _turned(u, np.cross(k, u[..., :3, 3]))


def thf(u: Array, k1: Array, k2: Array) -> Array:
    """THF1 … THF6 (..., 6): the tool's motion per Δθ; equations (22) to (27)."""
    return np.concatenate([_turned(u, k1) + _levered(u, k2), _turned(u, k2)], -1)


def ldf(u: Array, k2: Array) -> Array:
    """LDF1 … LDF6 (..., 6): the tool's motion per Δd; the last three vanish (22 to 24, 28)."""
    turned = _turned(u, k2)
    return np.concatenate([turned, np.zeros_like(turned)], -1)


def laf(u: Array, k3: Array) -> Array:
    """LAF1 … LAF6 (..., 6): the tool's motion per Δa; the last three vanish (22 to 24, 28)."""
    turned = _turned(u, k3)
    return np.concatenate([turned, np.zeros_like(turned)], -1)


def alpf(u: Array, k3: Array) -> Array:
    """ALPF1 … ALPF6 (..., 6): the tool's motion per Δα; equations (22) to (27).

    Erratum, probably of the transcription: (24) has lost its Δα term.
    """
    return np.concatenate([_levered(u, k3), _turned(u, k3)], -1)


def error_factors(table: DHTable, q: Array) -> Array:
    """The paper's R (m, 6, 4n) at q (m, n): DX = R·ΔPAR, equations (28) and (29).

    Columns are Δθ_1…Δθ_n, Δd…, Δa…, Δα…; rows are dx dy dz (m) and δx δy δz (rad) in the tool frame.

    Raises:
        DhcalError: for a modified table, whose factors the paper does not give.
    """
    if table.convention != "standard":
        raise DhcalError("the paper's factors belong to standard DH; convert the table first")
    u = tail_matrices(table, q)
    k1, k2, k3 = link_vectors(table)
    blocks = [thf(u, k1, k2), ldf(u, k2), laf(u, k3), alpf(u, k3)]
    return np.concatenate([np.swapaxes(block, 1, 2) for block in blocks], -1)


def differential_motion(change: Array, pose: Array) -> Array:
    """dn, do, da, dp as columns (..., 3, 4) of dT_N, from DX (..., 6) and T_N (..., 4, 4).

    Equations (30) to (34). Erratum, probably of the transcription: (31) is dn = o·δz - a·δy.
    """
    n, o, a = pose[..., :3, 0], pose[..., :3, 1], pose[..., :3, 2]
    dx, dy, dz, rx, ry, rz = (change[..., i, None] for i in range(6))
    return np.stack([o * rz - a * ry, a * rx - n * rz, n * ry - o * rx, n * dx + o * dy + a * dz], -1)


def tool_error(measured: Array, model: Array) -> Array:
    """DX (..., 6) in the tool frame from measured and modelled poses (..., 4, 4): (35) and (36).

    dT = measured - model. With NORᵀ·NOR = 2I, (36) is half the vee of RᵀRc - RcᵀR, that is sin(φ)·u:
    right for small angles, and useless beyond 90°. Errata: (35) takes dp as a direction, so
    d = Rᵀ·dp; (36) lacks the factor [dn; do; da].
    """
    rotation = model[..., :3, :3]
    change = measured[..., :3, :] - model[..., :3, :]
    n, o, a = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    dn, do, da = change[..., 0], change[..., 1], change[..., 2]
    dot = lambda x, y: np.sum(x * y, -1)  # noqa: E731
    # NORᵀ times the stacked vector, row by row.
    small = 0.5 * np.stack([dot(a, do) - dot(o, da), dot(n, da) - dot(a, dn), dot(o, dn) - dot(n, do)], -1)
    return np.concatenate([_turned(model, change[..., 3]), small], -1)


def pseudo_inverse_step(factors: Array, error: Array, cut: float = 1e-9) -> Array:
    """ΔPAR (p,) of equations (37) and (38) from R (m, k, p) and DX (m, k).

    Erratum: (38) inverts ReLᵀ·ReL, which is singular for nominally parallel axes at every number of
    poses. The pseudo-inverse by singular values, cut relative to the largest, is what it stands for.
    (39) then is PAR' = PAR + ΔPAR.
    """
    stacked = factors.reshape(-1, factors.shape[-1])
    return np.linalg.lstsq(stacked, error.reshape(-1), rcond=cut)[0]


def moved(table: DHTable, change: Array) -> DHTable:
    """The table with PAR' = PAR + ΔPAR, equation (39); change (4n,) in the order of R's columns."""
    theta, d, a, alpha = np.asarray(change, float).reshape(4, table.n_joints)
    return replace(table, theta=table.theta + theta, d=table.d + d, a=table.a + a, alpha=table.alpha + alpha)
