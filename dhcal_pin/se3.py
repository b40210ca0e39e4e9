"""Rigid motions as stacks of homogeneous matrices, and their exponential coordinates.

Everything broadcasts over leading axes. A twist is [v, ω]: three linear components in metres, then
three angular ones in radians. T_ab is the pose of frame b in frame a.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from ._typing import Array


def skew(w: ArrayLike) -> Array:
    """Cross-product matrix [w]× of w (..., 3), shape (..., 3, 3)."""
    w = np.asarray(w, float)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def transform(rotation: ArrayLike, position: ArrayLike) -> Array:
    """Homogeneous matrices (..., 4, 4) from rotations (..., 3, 3) and positions (..., 3) in metres."""
    rotation, position = np.asarray(rotation, float), np.asarray(position, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, position, 1.0
    return out


def translation(xyz: ArrayLike) -> Array:
    """Pure translations (..., 4, 4) by xyz (..., 3) metres."""
    return transform(np.eye(3), xyz)


def inverse(pose: ArrayLike) -> Array:
    """Inverse of rigid motions (..., 4, 4), by transposing the rotation."""
    pose = np.asarray(pose, float)
    out = np.zeros(pose.shape)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation
    out[..., :3, 3:] = -(rotation @ pose[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def adjoint(pose: ArrayLike) -> Array:
    """Matrices (..., 6, 6) that carry twists in frame b to frame a, given T_ab (..., 4, 4)."""
    pose = np.asarray(pose, float)
    rotation = pose[..., :3, :3]
    out = np.zeros((*pose.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., :3, 3:] = skew(pose[..., :3, 3]) @ rotation
    return out


def series(angle: Array) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1-cos t)/t², (t-sin t)/t³ of angles (...,) in radians, exact to rounding at any t."""
    half = np.sinc(angle / (2 * np.pi))
    small = np.abs(angle) < 0.1
    t2 = np.square(angle)
    safe = np.where(small, 1.0, angle)
    third = np.where(
        small,
        1 / 6 - t2 / 120 + t2**2 / 5040 - t2**3 / 362880 + t2**4 / 39916800,
        (safe - np.sin(safe)) / safe**3,
    )
    return np.sinc(angle / np.pi), 0.5 * half**2, third


def exp3(rotvec: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians."""
    rotvec = np.asarray(rotvec, float)
    first, second, _ = series(np.linalg.norm(rotvec, axis=-1))
    k = skew(rotvec)
    return np.eye(3) + first[..., None, None] * k + second[..., None, None] * (k @ k)


def log3(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3) in radians, of norm up to π, of rotations (..., 3, 3), precise everywhere.

    Arrays with the samples last in memory, seen through a transpose, are the quickest, and the result is
    such an array too.
    """
    r = np.asarray(rotation, float)
    out = np.empty((3, *r.shape[:-2]))
    for i, (j, k) in enumerate(((2, 1), (0, 2), (1, 0))):
        np.subtract(r[..., j, k], r[..., k, j], out=out[i, ...])
    # Twice the angle's sine and cosine; the sine alone is blind near π, the cosine near 0.
    sine = np.sqrt(np.maximum(np.einsum("i...,i...->...", out, out), 1e-300))
    cosine = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1
    out *= np.arctan2(sine, cosine) / sine
    back = cosine < -1.8
    if back.any():
        out[:, back] = _log3_near_half_turn(r[back]).T
    return out.transpose(*range(1, out.ndim), 0)


def _log3_near_half_turn(r: Array) -> Array:
    """Rotation vectors (m, 3) of rotations (m, 3, 3) by an obtuse angle, through the unit quaternion.

    Rows of 4·q·qᵀ, [w, x, y, z], are all proportional to q; that of the largest component is the safest.
    """
    m, trace = len(r), np.trace(r, axis1=1, axis2=2)
    rows = np.empty((m, 3, 4))
    rows[:, :, 0] = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], -1)
    rows[:, :, 1:] = r + np.swapaxes(r, 1, 2)
    for i in range(3):
        rows[:, i, i + 1] = 1 - trace + 2 * r[:, i, i]
    q = rows[np.arange(m), np.argmax(np.stack([r[:, i, i] for i in range(3)], -1), 1)]
    q *= np.where(q[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    return q[:, 1:] * (2 * np.arctan2(sine, q[:, 0]) / sine)[:, None]


def right_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Jr⁻¹ (..., 3, 3): log3(R·exp3(δ)) = φ + Jr⁻¹(φ)·δ to first order, φ = rotvec (..., 3).

    The result has the samples last in memory.
    """
    rotvec = np.asarray(rotvec, float)
    v = rotvec.transpose(-1, *range(rotvec.ndim - 1))
    t2 = np.einsum("i...,i...->...", v, v)
    factor = np.asarray(1 / 12 + t2 * (1 / 720 + t2 / 30240))
    large = t2 >= 1e-3
    if large.any():
        square = t2[large]
        angle = np.sqrt(square)
        factor[large] = 1 / square - 0.5 / (angle * np.tan(0.5 * angle))
    # I + ½[φ]× + f·[φ]×², with [φ]×² = φφᵀ - |φ|²·I.
    out = (factor * v) * v[:, None]
    half, diagonal = 0.5 * v, 1 - factor * t2
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        out[i, i] += diagonal
        out[k, j] += half[i]
        out[j, k] -= half[i]
    return out.transpose(*range(2, out.ndim), 0, 1)


def exp6(twist: ArrayLike) -> Array:
    """Rigid motions (..., 4, 4) of twists [v, ω] (..., 6)."""
    twist = np.asarray(twist, float)
    v, w = twist[..., :3], twist[..., 3:]
    _, second, third = series(np.linalg.norm(w, axis=-1))
    k = skew(w)
    left = np.eye(3) + second[..., None, None] * k + third[..., None, None] * (k @ k)
    return transform(exp3(w), (left @ v[..., None])[..., 0])


def log6(pose: ArrayLike) -> Array:
    """Twists [v, ω] (..., 6) of rigid motions (..., 4, 4), rotations up to π."""
    pose = np.asarray(pose, float)
    w = log3(pose[..., :3, :3])
    left_inverse = np.swapaxes(right_jacobian_inverse(w), -1, -2)
    v = (left_inverse @ pose[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], -1)


def nearest_rotation(matrix: Array) -> Array:
    """The rotations (..., 3, 3) nearest to matrices (..., 3, 3), such as sums of rotations."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def to_xyz_rpy(origin: Array) -> list[float]:
    """x, y, z in m and roll, pitch, yaw in rad of an origin (4, 4)."""
    return [float(v) + 0.0 for v in (*origin[:3, 3], *pin.rpy.matrixToRpy(origin[:3, :3]))]
