"""Frames, Jacobians and rotations of a serial chain over many samples, in NumPy.

Frames along the chain: F_(j+1) = F_j·L_j·M_j(q_j), where L_j is a constant link transform and M_j is a
rotation about z by q_j (revolute) or a translation along z by q_j (prismatic).

Jacobian of a point p by a unit twist [v, ω] of a body with rotation R and origin o:

    ω' = R·ω,    v' = R·v + ω' × (p - o).

Letters in shapes: m samples, k moving joints, b bodies, p errors. The samples are on the last axis.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

from .. import se3
from .._typing import Array
from .types import JointState, ObservationMatrix
from .work_arrays import UnbufferedRows, work_array

_IDENTITY = np.eye(4)
# Samples of all bodies that are treated together, so that they stay in the cache.
BLOCK_SIZE = 2048
# Maps the columns x, y, z, p to themselves and to y, -x.
_ROTATION_MIX = np.vstack([np.eye(4), [[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]]])


def cos_sin(angles: Array) -> tuple[Array, Array]:
    """Compute cosines and sines of angles (k, m) [rad], (k, m) each, by the half-angle formulas.

    With t = tan(angle/2): cos = (1 - t²)/(1 + t²) and sin = 2t/(1 + t²). One tangent takes a fifth of the
    time of a cosine and a sine.
    """
    half = np.tan(0.5 * angles)
    square = half * half
    return (1 - square) / (1 + square), 2 * half / (1 + square)


@UnbufferedRows()
def propagate_frames(
    link_transforms: Array, prismatic: Array, joint_state: JointState, frames: Array
) -> None:
    """Compute the frames along the chains of a batch, from the base to the tool.

    `frames`, shape (k+2, 7, 3, b·m), has columns x, y, z, p of each frame and three columns of work memory.
    Frame 0 is given; the others are filled. The last of the constant transforms, shape (b, k+1, 4, 4), leads
    to the tool. The samples are those of member 1, then those of member 2, and so on.
    """
    if len(link_transforms) > 1:
        _propagate_batch(link_transforms, prismatic, joint_state, frames)
        return
    # The columns of F·L are linear combinations of the columns of F: one small matrix product for all
    # samples. A rotation by q about z maps x to cos q·x + sin q·y and y to cos q·y - sin q·x.
    mixing, columns = (
        _ROTATION_MIX @ np.swapaxes(link_transforms[0], 1, 2),
        frames.reshape(*frames.shape[:2], -1),
    )
    steps = zip(mixing, columns[:, :4], columns[1:, :6], frames[1:], prismatic.tolist(), strict=False)
    for j, (mix, parent, product, child, is_prismatic) in enumerate(steps):
        if is_prismatic:
            np.matmul(mix[:4], parent, out=product[:4])
            np.multiply(child[2], joint_state.positions[j], out=child[4])
            child[3] += child[4]
        else:
            np.matmul(mix, parent, out=product)
            axes, rotated_axes = child[:2], child[4:6]
            axes *= joint_state.cos[j]
            rotated_axes *= joint_state.sin[j]
            axes += rotated_axes
    np.matmul(mixing[-1, :4], columns[-2, :4], out=columns[-1, :4])


def _propagate_batch(
    link_transforms: Array, prismatic: Array, joint_state: JointState, frames: Array
) -> None:
    """Compute the frames along several chains."""
    b, k = len(link_transforms), len(prismatic)
    by_member = frames.reshape(*frames.shape[:3], b, -1)
    positions, cos, sin = (
        part.reshape(k, b, -1) for part in (joint_state.positions, joint_state.cos, joint_state.sin)
    )
    for j, link in enumerate(link_transforms.swapaxes(0, 1)):
        parent, frame = by_member[j], by_member[j + 1]
        for column in range(4):
            coefficients = link[:, :, column].T[:, :, None]
            np.multiply(parent[0], coefficients[0], out=frame[column])
            frame[column] += parent[1] * coefficients[1]
            frame[column] += parent[2] * coefficients[2]
        frame[3] += parent[3]
        if j < k and prismatic[j]:
            frame[3] += frame[2] * positions[j]
        elif j < k:
            x, y = frame[0].copy(), frame[1].copy()
            frame[0] = x * cos[j] + y * sin[j]
            frame[1] = y * cos[j] - x * sin[j]


@UnbufferedRows()
def point_jacobian(frames: Array, point: Array, bodies: Array, twists: Array, out: Array) -> None:
    """Compute the Jacobian of a point by unit twists of bodies, in the axes of the measuring frame.

    The frames have columns x, y, z, p and three that are overwritten, shape (b, 7, 3, m); the point has shape
    (3, m) [m]. The body numbers, shape (p,), ascend. `out` receives velocities [v', ω'], shape (p, 6, m).
    """
    # A velocity is a linear combination of the body's axes and of the velocities that rotations about them
    # cause: one small matrix product for all samples and components.
    combination = np.zeros((len(bodies), 7))
    combination[:, :3], combination[:, 4:] = twists[:, :3], twists[:, 3:]
    runs = _equal_runs(tuple(np.bincount(bodies).tolist()))
    for start in range(0, point.shape[-1], BLOCK_SIZE):
        samples = np.s_[..., start : start + BLOCK_SIZE]
        for run, rows, count in runs:
            part = frames[run][samples]
            _fill_rotation_velocities(part, point[samples])
            n, _, _, m = part.shape
            part = part.swapaxes(1, 2)
            velocity = out[rows][samples].reshape(n, count, 6, m).swapaxes(1, 2)
            np.matmul(combination[rows].reshape(n, 1, count, 7), part, out=velocity[:, :3])
            np.matmul(combination[rows, 4:].reshape(n, 1, count, 3), part[:, :, :3], out=velocity[:, 3:])


def batch_point_jacobian(
    frames: Array, point: Array, bodies: Array, twists: Array, ends: int, out: Array
) -> None:
    """Compute the Jacobian of a point by unit twists of bodies, for a batch of chains.

    The samples are ordered by configuration of the sample (first or second), then by member of the batch.
    Frames have shape (j, 7, 3, ends·b·m), the point (3, ends·b·m) [m], the twists of the members (b, p, 6)
    and the velocities in `out` (p, 6, ends·b·m). The body numbers ascend.
    """
    shape = ends, len(twists), point.shape[1] // max(ends * len(twists), 1)
    starts = np.searchsorted(bodies, np.arange(len(frames) + 1)).tolist()
    for start, end, frame in zip(starts, starts[1:], frames, strict=False):
        if start == end:
            continue
        axes, lever = frame[:3].reshape(3, 3, *shape), (point - frame[3]).reshape(3, *shape)
        components = twists[:, start:end].transpose(2, 1, 0)[:, :, None, None, :, None]
        block = out[start:end].reshape(end - start, 6, *shape)
        for part, first in ((block[:, :3], 0), (block[:, 3:], 3)):
            np.multiply(components[first], axes[0], out=part)
            part += components[first + 1] * axes[1]
            part += components[first + 2] * axes[2]
        for i, (u, v) in enumerate(((1, 2), (2, 0), (0, 1))):
            block[:, i] += block[:, 3 + u] * lever[v] - block[:, 3 + v] * lever[u]


def apply_observation_matrix(jacobian: Array, observation: ObservationMatrix, out: Array) -> Array:
    """Multiply an observation matrix by tool velocities (p, 6, c·m); `out` has shape (p, r, m)."""
    out[:] = 0.0
    p, _, m = out.shape
    ends = jacobian.reshape(p, 6, jacobian.shape[2] // max(m, 1), m)
    product = work_array("product", p, m)
    terms = zip(observation.rows, observation.components, observation.coefficients, strict=True)
    for row, component, coefficient in terms:
        out[:, row] += np.multiply(ends[:, component % 6, component // 6], coefficient, out=product)
    return out


def error_frame_poses(body_from_urdf: Array, origins: Array, tool: Array, displacements: Array) -> Array:
    """Compute the pose of each error frame in its body, before its own displacement, shape (..., 2b+2, 4, 4).

    The URDF link frames in their bodies and the origins without joint motions have shape (..., b, 4, 4), the
    displacements of the error frames (..., 2b+2, 4, 4).
    """
    frames = np.empty(displacements.shape)
    # The frame of body 0 lies behind the displacement of the base.
    frames[..., 0, :, :] = se3.inverse(displacements[..., 0, :, :])
    frames[..., 1:-1:2, :, :] = body_from_urdf
    np.matmul(body_from_urdf @ displacements[..., 1:-1:2, :, :], origins, out=frames[..., 2::2, :, :])
    frames[..., -1, :, :] = frames[..., -2, :, :] @ displacements[..., -2, :, :] @ tool
    return frames


def perturb_frames(
    body_from_urdf: Array, origins: Array, tool: Array, error_frames: Array, twists: Array, x: Array
) -> tuple[Array, Array]:
    """Displace the error frames of the chains of a batch, and express the errors as twists of bodies.

    The displacement of error frame s is the product of exp(x_i·ξ_i) over the errors i at s, in their order.
    The derivative of a chain by x_i is the twist Ad(F·E)·ξ_i of the frame's body, where F is the pose of
    the error frame in the body and E the product over the preceding errors at s. The error frames, shape
    (p,), ascend. Of n members have origins (n, b, 4, 4), tool (n, 4, 4) and twists (n, p, 6) one or each
    its own; x has shape (n, p). The result is all displacements, shape (n, 2b+2, 4, 4), and the twists in
    body frames, shape (n, p, 6).
    """
    n, p = x.shape
    displacements, preceding = np.empty((n, 2 * len(body_from_urdf) + 2, 4, 4)), np.empty((n, p, 4, 4))
    displacements[:] = _IDENTITY
    exponentials = _exponentials(twists, x)
    for i, frame in enumerate(error_frames.tolist()):
        preceding[:, i] = displacements[:, frame]
        np.matmul(preceding[:, i], exponentials[:, i], out=displacements[:, frame])
    frames = error_frame_poses(body_from_urdf, origins, tool, displacements)[:, error_frames] @ preceding
    return displacements, (se3.adjoint(frames) @ twists[..., None])[..., 0]


def _exponentials(twists: Array, x: Array) -> Array:
    """Compute exp(x·ξ) (..., 4, 4) of values x (...) and twists ξ (..., 6), faster than `se3.exp6`.

    With the matrix A of ξ/|ω| and θ = x·|ω|: exp = I + θ·A + (1 - cos θ)·A² + (θ - sin θ)·A³, because A⁴ =
    -A². The term 1 - cos θ is computed as 2·sin²(θ/2), which does not cancel. For ω = 0 the exponential is I
    + x·ξ.
    """
    matrices = np.zeros((*twists.shape[:-1], 4, 4))
    matrices[..., :3, :3], matrices[..., :3, 3] = se3.skew(twists[..., 3:]), twists[..., :3]
    size = np.sqrt(np.einsum("...j,...j->...", twists[..., 3:], twists[..., 3:]))
    unit = matrices / np.where(size > 0, size, 1.0)[..., None, None]
    angle, square = size * x, unit @ unit
    first, second = x[..., None, None] * matrices, (2 * np.sin(0.5 * angle) ** 2)[..., None, None] * square
    return _IDENTITY + first + second + (angle - np.sin(angle))[..., None, None] * (square @ unit)


def log_rotations(rotations: Array) -> Array:
    """Compute rotation vectors (3, m) [rad] of matrices (3, 3, m); see `se3.log3`."""
    return se3.log3(rotations.transpose(2, 0, 1)).T


def right_jacobian_inverse_batch(rotvecs: Array) -> Array:
    """Compute Jr⁻¹ (3, 3, m) of rotation vectors (3, m) [rad]; see `se3.right_jacobian_inverse`."""
    return se3.right_jacobian_inverse(rotvecs.T).transpose(1, 2, 0)


@lru_cache(maxsize=64)
def _equal_runs(counts: tuple[int, ...]) -> list[tuple[slice, slice, int]]:
    """Group adjacent bodies with equal numbers of twists: bodies, twists and number of twists per body."""
    out, body, row = [], 0, 0
    for count, run in itertools.groupby(counts):
        n_bodies = len(list(run))
        if count:
            out.append((slice(body, body + n_bodies), slice(row, row + n_bodies * count), count))
        body, row = body + n_bodies, row + n_bodies * count
    return out


def _fill_rotation_velocities(frames: Array, point: Array) -> None:
    """Fill columns 4 to 6 of frames (b, 7, 3, m) with a point's velocity by unit rotations about x, y, z."""
    count, _, _, m = frames.shape
    axes, velocities = frames[:, :3], frames[:, 4:]
    lever, product = work_array("lever", count, 1, 3, m), work_array("product", count, 3, m)
    np.subtract(point, frames[:, 3:4], out=lever)
    # Cross products axis × lever of all bodies, one component at a time.
    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        component = velocities[:, :, x]
        np.multiply(axes[:, :, y], lever[:, :, z], out=component)
        component -= np.multiply(axes[:, :, z], lever[:, :, y], out=product)
