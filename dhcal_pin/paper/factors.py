"""Error factors of the paper, equation by equation: an independent check of the fast kernels.

Cho, Ha, Lee and Park, "Positioning Accuracy Improvement of Robots by Link Parameter Calibration". Numbers in
parentheses are the paper's equations. "Erratum" marks those that differ from its print; the derivation
counts. Twists are [v, ω] in the tool frame, lengths in metres, angles in radians.

    A_i   = Rz(θ_i + q_i) Tz(d_i) Tx(a_i) Rx(α_i)                        (1)   link matrix
    T_N   = A_1 A_2 … A_N                                                (2)   tool pose
    dA_i  = A_i δA_i                                                     (3), (4), (6)
    δA_i  = [δ_i× d_i; 0 0]                                              (5)   small displacement and rotation
    ∂A/∂x = A Q_x   for x = θ, d, a, α                                   (7) to (10)
    δA_i  = Q_θ Δθ_i + Q_d Δd_i + Q_a Δa_i + Q_α Δα_i                    (11), (12)
    d_i   = k1_i Δθ_i + k2_i Δd_i + k3_i Δa_i                            (13), (15)
    δ_i   = k2_i Δθ_i + k3_i Δα_i                                        (14), (15)
    dT_N  = Σ_i A_1 … A_i δA_i A_{i+1} … A_N                             (16), (17)
    δT_N  = Σ_i U_{i+1}⁻¹ δA_i U_{i+1}   with dT_N = T_N δT_N            (18), (20)
    U_i   = A_i A_{i+1} … A_N = [n o a p; 0 0 0 1]                       (19)
    DX    = [dx dy dz δx δy δz] from δT_N                                (21)
    DX    = Σ_i THF_i Δθ_i + LDF_i Δd_i + LAF_i Δa_i + ALPF_i Δα_i       (22) to (27)
    DX    = R ΔPAR                                                       (28), (29)

Shapes: m configurations, n joints (the paper's N).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import se3
from .._typing import Array
from ..exceptions import InvalidArgumentError
from ..measurements.validation import validated_joint_positions
from ..robot.dh import DHTable

# Singular values below this fraction of the largest one count as zero.
RTOL = 1e-9


def link_vectors(table: DHTable) -> tuple[Array, Array, Array]:
    """Return the vectors k1, k2 and k3, equations (13) to (15).

        k1 = [0, a·cα, -a·sα],  k2 = [0, sα, cα],  k3 = [1, 0, 0]

    Erratum: (15) prints k1 = [0, a·sα, -a·cα], which contradicts (13). A row with Hayati's angle β ends with
    Ry(β), so its vectors are expressed in a frame rotated by β.
    """
    s, c, zero = np.sin(table.alpha), np.cos(table.alpha), np.zeros(table.n_joints)
    k1 = np.stack([zero, table.a * c, -table.a * s], -1)
    k2 = np.stack([zero, s, c], -1)
    k3 = np.tile([1.0, 0.0, 0.0], (table.n_joints, 1))
    rotation = se3.exp3(-table.beta[:, None] * np.array([0.0, 1.0, 0.0]))
    return (
        np.einsum("nij,nj->ni", rotation, k1),
        np.einsum("nij,nj->ni", rotation, k2),
        np.einsum("nij,nj->ni", rotation, k3),
    )


def tail_matrices(table: DHTable, q: Array) -> Array:
    """Return the tail matrices U_i = A_i·…·A_N·tool, equation (19).

    Entry i of the second axis is U_{i+2}, the tail after link i+1. In the paper the tool is the identity.
    """
    rows = table.rows(q)
    out = np.empty_like(rows)
    tail = np.broadcast_to(table.tool, rows[:, 0].shape)
    for i in reversed(range(table.n_joints)):
        out[:, i] = tail
        tail = rows[:, i] @ tail
    return out


def _dot_axes(u: Array, k: Array) -> Array:
    """Return the dot products n·k, o·k, a·k, shape (..., 3), with the columns of U, shape (..., 4, 4)."""
    return np.einsum("...ij,...i->...j", u[..., :3, :3], k)


def _dot_lever_arms(u: Array, k: Array) -> Array:
    """Return the triple products (p×n)·k, (p×o)·k, (p×a)·k, shape (..., 3)."""
    return _dot_axes(u, np.cross(k, u[..., :3, 3]))


def thf(u: Array, k1: Array, k2: Array) -> Array:
    """Return THF1 … THF6, the motion of the tool per Δθ, shape (..., 6) [m/rad, rad/rad].

        THF1 = n·k1 + (p×n)·k2   (22)        THF4 = n·k2   (25)
        THF2 = o·k1 + (p×o)·k2   (23)        THF5 = o·k2   (26)
        THF3 = a·k1 + (p×a)·k2   (24)        THF6 = a·k2   (27)

    u is the tail matrix U_{i+1} = [n o a p; 0 0 0 1], shape (..., 4, 4); k1 [m] and k2 are vectors of (15).
    """
    return np.concatenate([_dot_axes(u, k1) + _dot_lever_arms(u, k2), _dot_axes(u, k2)], -1)


def ldf(u: Array, k2: Array) -> Array:
    """Return LDF1 … LDF6, the motion of the tool per Δd, shape (..., 6) [m/m, rad/m].

        LDF1 = n·k2 (22),  LDF2 = o·k2 (23),  LDF3 = a·k2 (24),  LDF4 = LDF5 = LDF6 = 0 (28)

    u and k2 are those of `thf`. LAF1 … LAF6, the motion per Δa, are these with k3 in place of k2.
    """
    linear = _dot_axes(u, k2)
    return np.concatenate([linear, np.zeros_like(linear)], -1)


laf = ldf


def alpf(u: Array, k3: Array) -> Array:
    """Return ALPF1 … ALPF6, the motion of the tool per Δα, shape (..., 6) [m/rad, rad/rad].

        ALPF1 = (p×n)·k3   (22)        ALPF4 = n·k3   (25)
        ALPF2 = (p×o)·k3   (23)        ALPF5 = o·k3   (26)
        ALPF3 = (p×a)·k3   (24)        ALPF6 = a·k3   (27)

    u is that of `thf`, k3 a vector of (15). Erratum, probably of the transcription: (24) lacks the term
    of Δα.
    """
    return np.concatenate([_dot_lever_arms(u, k3), _dot_axes(u, k3)], -1)


def error_factors(table: DHTable, q: Array) -> Array:
    """Compute the matrix R of DX = R·ΔPAR, equations (28) and (29).

    Args:
        table: Standard DH table.
        q: Joint positions, shape (m, n) [rad or m].

    Returns:
        R, shape (m, 6, 4n). Rows are dx, dy, dz [m] and δx, δy, δz [rad] in the tool frame. Columns are
        Δθ_1 … Δθ_n, Δd_1 … Δd_n, Δa_1 … Δa_n, Δα_1 … Δα_n.

    Raises:
        InvalidArgumentError: The table is no DH table or has modified DH parameters, for which the paper
            gives no factors, or q is no array of numbers.
    """
    if not isinstance(table, DHTable):
        raise InvalidArgumentError(
            f"table has type {type(table).__name__}; expected a DH table, such as read_dh(path)"
        )
    if table.convention != "standard":
        raise InvalidArgumentError(
            "the paper's error factors need standard DH parameters; convert the table first"
        )
    u = tail_matrices(table, validated_joint_positions(q, "error_factors"))
    k1, k2, k3 = link_vectors(table)
    blocks = [thf(u, k1, k2), ldf(u, k2), laf(u, k3), alpf(u, k3)]
    return np.concatenate([np.swapaxes(block, 1, 2) for block in blocks], -1)


def tool_error(measured: Array, model: Array) -> Array:
    """Compute DX of measured poses in the tool frame of the model, shape (..., 6) [m, rad]: (35) and (36).

        [dx dy dz] = Rᵀ·dp                                        (35)
        [δx δy δz] = (NORᵀ·NOR)⁻¹ NORᵀ·[dn; do; da]               (36)

    with dT = measured - model. NORᵀ·NOR = 2I, so (36) is half the vee of RᵀR_c - R_cᵀR, where R_c is the
    measured rotation. That is sin(φ)·u for an error of angle φ about the axis u: accurate for small angles,
    and ambiguous beyond 90°. Errata: (35) multiplies dp as a point, but it is a direction; (36) lacks the
    factor [dn; do; da].
    """
    rotation = model[..., :3, :3]
    difference = measured[..., :3, :] - model[..., :3, :]
    n, o, a = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    dn, do, da, dp = (difference[..., i] for i in range(4))

    def dot(x: Array, y: Array) -> Array:
        return np.sum(x * y, -1)

    # Rows of NORᵀ times the stacked vector.
    angular = 0.5 * np.stack([dot(a, do) - dot(o, da), dot(n, da) - dot(a, dn), dot(o, dn) - dot(n, do)], -1)
    return np.concatenate([_dot_axes(model, dp), angular], -1)


def pseudo_inverse_step(factors: Array, error: Array) -> Array:
    """Compute the parameter correction ΔPAR, shape (p,) [rad, m]: equations (37) and (38).

    (37) stacks DX_i = R_i·ΔPAR over all configurations to D = ReL·ΔPAR; the factors R_i have shape (m, k, p).
    Erratum: (38) inverts ReLᵀ·ReL, which is singular for nominally parallel axes, however many configurations
    there are. The pseudo-inverse by singular values takes its place; those below `RTOL` of the largest one
    count as zero.
    """
    stacked = factors.reshape(-1, factors.shape[-1])
    return np.linalg.lstsq(stacked, error.reshape(-1), rcond=RTOL)[0]


def apply_correction(table: DHTable, change: Array) -> DHTable:
    """Return the table with PAR' = PAR + ΔPAR, equation (39)."""
    theta, d, a, alpha = np.asarray(change, float).reshape(4, table.n_joints)
    return replace(table, theta=table.theta + theta, d=table.d + d, a=table.a + a, alpha=table.alpha + alpha)
