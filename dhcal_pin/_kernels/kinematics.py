"""Frames and velocities of a serial arm over many samples, components first: samples are contiguous."""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

from .. import se3
from .._typing import Array
from .types import JointState, ObservationMatrix
from .work_arrays import UnbufferedRows, work_array

_IDENTITY = np.eye(4)


# So many samples of all bodies stay in a processor's cache.
BLOCK_SIZE = 2048


# Of columns x, y, z, p, the same and y, -x.
_ROTATION_MIX = np.vstack([np.eye(4), [[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]]])


def cos_sin(angles: Array) -> tuple[Array, Array]:
    """Of angles (k, m), rad."""
    # One tangent of half the angle costs a fifth of a cosine and a sine.
    half = np.tan(0.5 * angles)
    square = half * half
    return (1 - square) / (1 + square), 2 * half / (1 + square)


@UnbufferedRows()
def propagate_frames(links: Array, prismatic: Array, motion: JointState, frames: Array) -> None:
    """Fills the columns x, y, z, p of frames (k+2, 7, 3, m), whose first is the base's, to the tool's.

    Args:
        links: (k+1, 4, 4) constant transforms between the motions; the last one leads to the tool.
        prismatic: (k,) True where a joint slides along its z; the others turn about it.
        motion: of the joints.
        frames: columns x, y, z, p of each frame, and three that are overwritten.
    """
    # The columns of F·L are the columns of F mixed by L: one small product for all samples. A turn by q
    # makes of x and y their cos q-fold, and to that adds the sin q-fold of y and -x.
    mixing, columns = _ROTATION_MIX @ np.swapaxes(links, 1, 2), frames.reshape(*frames.shape[:2], -1)
    steps = zip(mixing, columns[:, :4], columns[1:, :6], frames[1:], prismatic.tolist(), strict=False)
    for j, (mix, before, mixed, after, slides) in enumerate(steps):
        if slides:
            np.matmul(mix[:4], before, out=mixed[:4])
            np.multiply(after[2], motion.positions[j], out=after[4])
            after[3] += after[4]
        else:
            np.matmul(mix, before, out=mixed)
            turned, across = after[:2], after[4:6]
            turned *= motion.cos[j]
            across *= motion.sin[j]
            turned += across
    np.matmul(mixing[-1, :4], columns[-2, :4], out=columns[-1, :4])


@UnbufferedRows()
def point_jacobian(frames: Array, point: Array, at: Array, twists: Array, out: Array) -> None:
    """Fills in a point's velocity (p, 6, m) per unit of each twist of a body, axes of the measuring frame.

    Args:
        frames: (b, 7, 3, m) columns x, y, z, p of each body's frame, and three that are overwritten.
        point: (3, m).
        at: (p,) body numbers, ascending.
        twists: (p, 6) twists in those bodies' frames.
        out: (p, 6, m), written in place.
    """
    # A twist mixes what its body's axes do, one small product for all samples and components.
    move = np.zeros((len(at), 7))
    move[:, :3], move[:, 4:] = twists[:, :3], twists[:, 3:]
    runs = _equal_runs(tuple(np.bincount(at).tolist()))
    for start in range(0, point.shape[-1], BLOCK_SIZE):
        some = np.s_[..., start : start + BLOCK_SIZE]
        for bodies, rows, count in runs:
            part = frames[bodies][some]
            _turn_about_axes(part, point[some])
            n, _, _, m = part.shape
            part = part.swapaxes(1, 2)
            velocity = out[rows][some].reshape(n, count, 6, m).swapaxes(1, 2)
            np.matmul(move[rows].reshape(n, 1, count, 7), part, out=velocity[:, :3])
            np.matmul(move[rows, 4:].reshape(n, 1, count, 3), part[:, :, :3], out=velocity[:, 3:])


def batch_point_jacobian(
    frames: Array, point: Array, at: Array, twists: Array, ends: int, out: Array
) -> None:
    """As `point_velocities`, by twists (b, p, 6) of members, whose samples follow each other at each end."""
    shape = ends, len(twists), point.shape[1] // max(ends * len(twists), 1)
    starts = np.searchsorted(at, np.arange(len(frames) + 1)).tolist()
    for start, end, frame in zip(starts, starts[1:], frames, strict=False):
        if start == end:
            continue
        axes, lever = frame[:3].reshape(3, 3, *shape), (point - frame[3]).reshape(3, *shape)
        of = twists[:, start:end].transpose(2, 1, 0)[:, :, None, None, :, None]
        block = out[start:end].reshape(end - start, 6, *shape)
        for part, first in ((block[:, :3], 0), (block[:, 3:], 3)):
            np.multiply(of[first], axes[0], out=part)
            part += of[first + 1] * axes[1]
            part += of[first + 2] * axes[2]
        for i, (u, v) in enumerate(((1, 2), (2, 0), (0, 1))):
            block[:, i] += block[:, 3 + u] * lever[v] - block[:, 3 + v] * lever[u]


def apply_observation_matrix(velocities: Array, mixture: ObservationMatrix, out: Array) -> Array:
    """Fills in what a mixture makes (p, k, m) of velocities (p, 6, c·m)."""
    out[:] = 0.0
    p, _, m = out.shape
    ends = velocities.reshape(p, 6, velocities.shape[2] // max(m, 1), m)
    product = work_array("product", p, m)
    for row, component, share in zip(mixture.rows, mixture.components, mixture.coefficients, strict=True):
        out[:, row] += np.multiply(ends[:, component % 6, component // 6], share, out=product)
    return out


def error_frame_poses(body_from_urdf: Array, origins: Array, tool: Array, motions: Array) -> Array:
    """Each station's frame (2k+4, 4, 4) in its body, before its own motion.

    Args:
        body_from_urdf: (k+1, 4, 4) each body's URDF frame in its body frame.
        origins: (k+1, 4, 4) of the joints and the tip, without the motions.
        tool: (4, 4), likewise.
        motions: (2k+4, 4, 4) of the stations.
    """
    frames = np.empty(motions.shape)
    # Body 0 is behind the base's motion.
    frames[0] = se3.inverse(motions[0])
    frames[1:-1:2] = body_from_urdf
    np.matmul(body_from_urdf @ motions[1:-1:2], origins, out=frames[2::2])
    frames[-1] = frames[-2] @ motions[-2] @ tool
    return frames


def perturb_frames(
    body_from_urdf: Array, origins: Array, tool: Array, error_frames: Array, twists: Array, x: Array
) -> tuple[Array, Array]:
    """Motions of all stations (2k+4, 4, 4) by errors, and the errors' twists (p, 6) as those of bodies.

    An error at a station turns with those before it, seen from the station as it was before all of them.

    Args:
        body_from_urdf: (k+1, 4, 4), as `station_frames` takes it, and so are
        origins: (k+1, 4, 4), and
        tool: (4, 4).
        error_frames: (p,) where the errors are, ascending.
        twists: (p, 6) in the stations' frames.
        x: (p,) how far they go.
    """
    motions, before = np.empty((2 * len(body_from_urdf) + 2, 4, 4)), np.empty((len(x), 4, 4))
    motions[:] = _IDENTITY
    for i, (station, step) in enumerate(zip(error_frames.tolist(), _exponentials(twists, x), strict=True)):
        before[i] = motions[station]
        np.matmul(before[i], step, out=motions[station])
    frames = error_frame_poses(body_from_urdf, origins, tool, motions)[error_frames] @ before
    return motions, (se3.adjoint(frames) @ twists[..., None])[..., 0]


def _exponentials(twists: Array, x: Array) -> Array:
    """Motions (p, 4, 4) of shares x (p,) of twists (p, 6), in a third of the time of `se3.exp6`."""
    matrices = np.zeros((len(x), 4, 4))
    matrices[:, :3, :3], matrices[:, :3, 3] = se3.skew(twists[:, 3:]), twists[:, :3]
    size = np.sqrt(np.einsum("ij,ij->i", twists[:, 3:], twists[:, 3:]))
    unit = matrices / np.where(size > 0, size, 1.0)[:, None, None]
    angle, square = size * x, unit @ unit
    first, second = x[:, None, None] * matrices, (2 * np.sin(0.5 * angle) ** 2)[:, None, None] * square
    return _IDENTITY + first + second + (angle - np.sin(angle))[:, None, None] * (square @ unit)


def log_rotations(turns: Array) -> Array:
    """Rotation vectors (3, m) of rotations (3, 3, m)."""
    return se3.log3(turns.transpose(2, 0, 1)).T


def right_jacobian_inverse_batch(rotvecs: Array) -> Array:
    """Jr⁻¹ (3, 3, m) of rotation vectors (3, m); see `se3.right_jacobian_inverse`."""
    return se3.right_jacobian_inverse(rotvecs.T).transpose(1, 2, 0)


@lru_cache(maxsize=64)
def _equal_runs(counts: tuple[int, ...]) -> list[tuple[slice, slice, int]]:
    """Neighbouring bodies with as many twists each: which bodies, which twists, how many a body."""
    out, body, row = [], 0, 0
    for count, alike in itertools.groupby(counts):
        bodies = len(list(alike))
        if count:
            out.append((slice(body, body + bodies), slice(row, row + bodies * count), count))
        body, row = body + bodies, row + bodies * count
    return out


def _turn_about_axes(frames: Array, point: Array) -> None:
    """Fills the last columns of frames (b, 7, 3, m): how a point (3, m) moves that turns about x, y, z."""
    count, _, _, m = frames.shape
    axes, turns = frames[:, :3], frames[:, 4:]
    lever, product = work_array("lever", count, 1, 3, m), work_array("product", count, 3, m)
    np.subtract(point, frames[:, 3:4], out=lever)
    # The cross products of all bodies at once, a component at a time.
    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turned = turns[:, :, x]
        np.multiply(axes[:, :, y], lever[:, :, z], out=turned)
        turned -= np.multiply(axes[:, :, z], lever[:, :, y], out=product)
