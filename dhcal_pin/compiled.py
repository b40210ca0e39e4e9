"""The inner loops in C; importing them fails where the installation had no compiler. See `loops`."""

from __future__ import annotations

import numpy as np

from . import _kernel, kinematics
from .kinematics import Motion
from .se3 import Array


def carry_frames(links: Array, prismatic: Array, motion: Motion, frames: Array) -> None:
    """As `kinematics.carry_frames`."""
    _kernel.carry_frames(links, prismatic, motion.values, motion.cos, motion.sin, frames)


def point_velocities(frames: Array, point: Array, at: Array, twists: Array, out: Array) -> None:
    """As `kinematics.point_velocities`."""
    _kernel.point_velocities(frames, point, at, twists, out)


def mix_samples(vectors: Array, matrices: Array, out: Array) -> Array:
    """As `kinematics.mix_samples`."""
    _kernel.mix_samples(vectors, matrices, out)
    return out


def carry_twists(frames: Array, twists: Array) -> Array:
    """As `kinematics.carry_twists`."""
    out = np.empty(twists.shape)
    _kernel.carry_twists(frames, twists, out)
    return out


def log_rotations(turns: Array) -> Array:
    """As `kinematics.log_rotations`."""
    out = np.empty(turns.shape[1:])
    # Near a half turn it takes more care.
    return kinematics.log_rotations(turns) if _kernel.log_rotations(turns, out) else out


def right_jacobian_inverses(rotvecs: Array) -> Array:
    """As `kinematics.right_jacobian_inverses`."""
    out = np.empty((3, *rotvecs.shape))
    _kernel.right_jacobian_inverses(rotvecs, out)
    return out


def triangle_of(rows: Array) -> Array:
    """As `reduction.triangle_of`; the rows stay."""
    return triangles_of(rows[None])[0]


def triangles_of(rows: Array) -> Array:
    """As `reduction.triangles_of`; the rows stay."""
    b, c = rows.shape[:2]
    out = np.empty((b, c, c))
    _kernel.triangles(rows, out)
    return out
