"""Rigid motions as stacks of homogeneous matrices, and their exponential coordinates.

Everything broadcasts over leading axes. A twist is [v, ω]: three linear components in metres, then
three angular ones in radians. T_ab is the pose of frame b in frame a.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]


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
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    return transform(rotation, -(rotation @ pose[..., :3, 3:])[..., 0])


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
    """Rotation vectors (..., 3) in radians, of norm up to π, of rotations (..., 3, 3).

    Goes through the unit quaternion with the largest component positive, which keeps full precision
    near zero and near π.
    """
    r = np.asarray(rotation, float)
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    candidates = np.stack([trace, r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]], -1)
    pick = np.argmax(candidates, -1)[..., None, None]
    d = r - np.swapaxes(r, -1, -2)
    vee = np.stack([d[..., 2, 1], d[..., 0, 2], d[..., 1, 0]], -1)
    s = r + np.swapaxes(r, -1, -2)
    # Rows of 4·q·qᵀ, [w, x, y, z]: any of them is proportional to q; the longest is the safest.
    rows = np.empty((*r.shape[:-2], 4, 4))
    rows[..., 0, 0] = 1 + trace
    rows[..., 0, 1:] = rows[..., 1:, 0] = vee
    rows[..., 1:, 1:] = s
    for i in range(3):
        rows[..., i + 1, i + 1] = 1 - trace + 2 * r[..., i, i]
    q = np.take_along_axis(rows, pick, -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(sine, q[..., 0])
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)
    return q[..., 1:] * scale[..., None]


def right_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Jr⁻¹ (..., 3, 3): log3(R·exp3(δ)) = φ + Jr⁻¹(φ)·δ to first order, φ = rotvec (..., 3)."""
    rotvec = np.asarray(rotvec, float)
    t2 = np.sum(rotvec**2, -1)
    small = t2 < 1e-3
    safe = np.where(small, 1.0, t2)
    angle = np.sqrt(safe)
    factor = np.where(
        small, 1 / 12 + t2 / 720 + t2**2 / 30240, 1 / safe - 0.5 / (angle * np.tan(0.5 * angle))
    )
    k = skew(rotvec)
    return np.eye(3) + 0.5 * k + factor[..., None, None] * (k @ k)


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
