"""Rigid-body transformations: homogeneous matrices, exponential and logarithm of SO(3) and SE(3).

Conventions:

* T_ab (4, 4) is the pose of frame b in frame a: p_a = T_ab·p_b.
* A twist is ξ = [v, ω] (6,): linear part [m], then angular part [rad].
* [ω]× is the cross-product matrix: [ω]×·x = ω × x.
* All functions broadcast over leading axes, written "..." in shapes.

With θ = |ω| (Rodrigues' formula; Lynch & Park, Modern Robotics, 2017, chapter 3):

* exp3(ω) = I + (sin θ/θ)·[ω]× + ((1 - cos θ)/θ²)·[ω]×²;
* exp6(ξ) = (exp3(ω), V·v) with V = I + ((1 - cos θ)/θ²)·[ω]× + ((θ - sin θ)/θ³)·[ω]×².
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from ._typing import Array

# Cosine of the pitch below which roll and yaw turn about one axis: the rounding error of a quarter turn.
_GIMBAL_LOCK_TOL = 1e-15


def skew(w: ArrayLike) -> Array:
    """Build cross-product matrices."""
    w = np.asarray(w, float)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def transform(rotation: ArrayLike, position: ArrayLike) -> Array:
    """Combine rotations (..., 3, 3) and positions (..., 3) to homogeneous matrices."""
    rotation, position = np.asarray(rotation, float), np.asarray(position, float)
    shape = np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, position, 1.0
    return out


def translation(xyz: ArrayLike) -> Array:
    """Build homogeneous matrices of pure translations."""
    return transform(np.eye(3), xyz)


def transform_points(pose: Array, points: Array) -> Array:
    """Transform points (..., 3) by one pose (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def position_and_rotvec(pose: Array) -> Array:
    """Return the position and the rotation vector of a pose (4, 4), (6,)."""
    return np.concatenate([pose[:3, 3], log3(pose[:3, :3])])


def rms_radius(points: Array) -> float:
    """Compute the RMS distance of points (m, 3) from their mean."""
    return rms_length(points - points.mean(0))


def rms_length(vectors: Array) -> float:
    """Compute the RMS length of vectors (m, d)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, 1))))


def inverse(pose: ArrayLike) -> Array:
    """Invert rigid transformations by transposing the rotation."""
    pose = np.asarray(pose, float)
    out = np.zeros(pose.shape)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation
    out[..., :3, 3:] = -(rotation @ pose[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def adjoint(pose: ArrayLike) -> Array:
    """Build the matrices that express twists of frame b in frame a.

    With T_ab = (R, p): Ad = [[R, [p]×·R], [0, R]] and ξ_a = Ad·ξ_b.
    """
    pose = np.asarray(pose, float)
    rotation = pose[..., :3, :3]
    out = np.zeros((*pose.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., :3, 3:] = skew(pose[..., :3, 3]) @ rotation
    return out


def exp_coefficients(angle: Array) -> tuple[Array, Array, Array]:
    """Compute the three coefficients of the exponential maps without cancellation at small angles."""
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


def angles_of_traces(traces: Array) -> Array:
    """Compute the angles of rotations from the traces of their matrices."""
    return np.arccos(np.clip(0.5 * (traces - 1), -1, 1))


def exp3(rotvec: ArrayLike) -> Array:
    """Compute rotation matrices from rotation vectors."""
    rotvec = np.asarray(rotvec, float)
    first, second, _ = exp_coefficients(np.linalg.norm(rotvec, axis=-1))
    k = skew(rotvec)
    return np.eye(3) + first[..., None, None] * k + second[..., None, None] * (k @ k)


def log3(rotation: ArrayLike) -> Array:
    """Compute rotation vectors from rotation matrices, accurate at all angles from 0 to π.

    The computation is fastest if the last two axes have the largest strides in memory, as in a transposed
    array of shape (3, 3, m). The result has the same layout.
    """
    r = np.asarray(rotation, float)
    out = np.empty((3, *r.shape[:-2]))
    for i, (j, k) in enumerate(((2, 1), (0, 2), (1, 0))):
        np.subtract(r[..., j, k], r[..., k, j], out=out[i, ...])
    # `sine` and `cosine` are 2·sin θ and 2·cos θ; arctan2 of both is accurate at small and at large angles.
    sine = np.sqrt(np.maximum(np.einsum("i...,i...->...", out, out), 1e-300))
    cosine = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2] - 1
    out *= np.arctan2(sine, cosine) / sine
    near_half_turn = cosine < -1.8
    if near_half_turn.any():
        out[:, near_half_turn] = _log3_near_half_turn(r[near_half_turn]).T
    return out.transpose(*range(1, out.ndim), 0)


def _log3_near_half_turn(r: Array) -> Array:
    """Compute rotation vectors (m, 3) of rotations (m, 3, 3) near π from their unit quaternions.

    Each row of 4·q·qᵀ with q = [w, x, y, z] is proportional to q. The row of the largest vector component
    is used because it has the smallest rounding error.
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


def turn_between(start: Array, end: Array) -> Array:
    """Return rotations about the axes normal to both that turn unit vectors (..., 3) into other ones."""
    axis, cosine = np.cross(start, end), np.sum(start * end, -1, keepdims=True)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    return exp3(axis / np.maximum(sine, 1e-300) * np.arctan2(sine, cosine))


def right_jacobian_inverse(rotvec: ArrayLike) -> Array:
    """Compute the inverse right Jacobian of SO(3).

    To first order log3(exp3(φ)·exp3(δ)) = φ + Jr⁻¹(φ)·δ, with

        Jr⁻¹(φ) = I + ½[φ]× + f·[φ]×²,    f = 1/θ² - 1/(2θ·tan(θ/2)),    θ = |φ|.

    For θ² < 1e-3 the series f = 1/12 + θ²/720 + θ⁴/30240 is used.
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
    """Compute rigid transformations from twists."""
    twist = np.asarray(twist, float)
    v, w = twist[..., :3], twist[..., 3:]
    _, second, third = exp_coefficients(np.linalg.norm(w, axis=-1))
    k = skew(w)
    v_matrix = np.eye(3) + second[..., None, None] * k + third[..., None, None] * (k @ k)
    return transform(exp3(w), (v_matrix @ v[..., None])[..., 0])


def log6(pose: ArrayLike) -> Array:
    """Compute twists from rigid transformations."""
    pose = np.asarray(pose, float)
    w = log3(pose[..., :3, :3])
    v_matrix_inverse = np.swapaxes(right_jacobian_inverse(w), -1, -2)
    v = (v_matrix_inverse @ pose[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], -1)


def quaternion_to_matrix(quaternion: ArrayLike) -> Array:
    """Convert unit quaternions to rotation matrices.

    With w the scalar part and v the vector part, R = I + 2·w·[v] + 2·[v]², where [v] is the skew matrix of v.
    """
    quaternion = np.asarray(quaternion, float)
    cross = skew(quaternion[..., 1:])
    return np.eye(3) + 2 * quaternion[..., :1, None] * cross + 2 * cross @ cross


def rotvec_to_quaternion(rotvec: Array) -> Array:
    """Convert rotation vectors (..., 3) to unit quaternions w, x, y, z, (..., 4)."""
    half = 0.5 * np.linalg.norm(rotvec, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * rotvec * np.sinc(half / np.pi)], -1)


def nearest_rotation(matrix: Array) -> Array:
    """Find the rotations nearest to given matrices in the Frobenius norm.

    With the singular value decomposition U·S·Vᵀ the rotation is U·diag(1, 1, ±1)·Vᵀ (Kabsch 1976).
    """
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def to_xyz_rpy(origin: Array) -> list[float]:
    """Convert a transformation to the numbers of a URDF origin."""
    return [float(v) + 0.0 for v in (*origin[:3, 3], *pin.rpy.matrixToRpy(origin[:3, :3]))]


def nearest_rpy(rotation: Array, near: ArrayLike) -> Array:
    """Compute roll, pitch and yaw of a rotation Rz(yaw)·Ry(pitch)·Rx(roll) nearest to given angles [rad].

    A rotation has two triples of angles, (r, p, y) and (r + π, π - p, y + π), each up to whole turns. At a
    pitch of a quarter turn only the sum or the difference of roll and yaw is determined.
    """
    near = np.asarray(near, float)
    angles = pin.rpy.matrixToRpy(rotation)
    candidates = [angles, np.array([angles[0] + np.pi, np.pi - angles[1], angles[2] + np.pi])]
    candidates = [near + _wrapped(candidate - near) for candidate in candidates]
    if abs(np.cos(angles[1])) < _GIMBAL_LOCK_TOL:
        # The rotation depends on roll - yaw at a pitch of π/2 and on roll + yaw at -π/2.
        sign = np.sign(angles[1])
        half = 0.5 * _wrapped(angles[0] - sign * angles[2] - near[0] + sign * near[2])
        pitch = near[1] + _wrapped(sign * np.pi / 2 - near[1])
        candidates.append(np.array([near[0] + half, pitch, near[2] - sign * half]))
    return min(candidates, key=lambda angles: float(np.linalg.norm(angles - near)))


def _wrapped(angles: Array) -> Array:
    """Remove whole turns, so that angles are between -π and π."""
    return angles - 2 * np.pi * np.round(angles / (2 * np.pi))
