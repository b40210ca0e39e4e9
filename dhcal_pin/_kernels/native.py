"""The inner loops in C; importing them fails where the installation had no compiler. See `loops`."""

from __future__ import annotations

import numpy as np

from .._typing import Array
from . import _native, kinematics
from .types import Mixture, Motion
from .work_arrays import scratch


def cosines_and_sines(angles: Array) -> tuple[Array, Array]:
    """As `kinematics.cosines_and_sines`."""
    cosines, sines = np.empty_like(angles), np.empty_like(angles)
    _native.cosines_and_sines(angles, cosines, sines)
    return cosines, sines


def carry_frames(links: Array, prismatic: Array, motion: Motion, frames: Array) -> None:
    """As `kinematics.carry_frames`."""
    _native.carry_frames(links, prismatic, motion.values, motion.cos, motion.sin, frames)


def point_velocities(frames: Array, point: Array, at: Array, twists: Array, out: Array) -> None:
    """As `kinematics.point_velocities`."""
    _native.point_velocities(frames, point, at, twists, out)


def mix_velocities(velocities: Array, mixture: Mixture, out: Array) -> Array:
    """As `kinematics.mix_velocities`."""
    _native.mix_velocities(velocities, *_terms(mixture), out)
    return out


def move_stations(
    into: Array, origins: Array, tool: Array, stations: Array, twists: Array, x: Array
) -> tuple[Array, Array]:
    """As `kinematics.move_stations`."""
    motions, carried = np.empty((2 * len(into) + 2, 4, 4)), np.empty(twists.shape)
    _native.move_stations(into, origins, tool, stations, twists, x, motions, carried)
    return motions, carried


def log_rotations(turns: Array) -> Array:
    """As `kinematics.log_rotations`."""
    out = np.empty(turns.shape[1:])
    # Near a half turn it takes more care.
    return kinematics.log_rotations(turns) if _native.log_rotations(turns, out) else out


def right_jacobian_inverses(rotvecs: Array) -> Array:
    """As `kinematics.right_jacobian_inverses`."""
    out = np.empty((3, *rotvecs.shape))
    _native.right_jacobian_inverses(rotvecs, out)
    return out


def triangle_of(rows: Array) -> Array:
    """As `reduction.triangle_of`; the rows stay."""
    return triangles_of(rows[None])[0]


def triangles_of(rows: Array) -> Array:
    """As `reduction.triangles_of`; the rows stay."""
    b, c, k, _ = rows.shape
    out = np.empty((b, c, c))
    _native.triangles(rows, _room(c, k, 0), out)
    return out


def error_triangles(
    frames: Array, point: Array, at: Array, twists: Array, mixture: Mixture, given: Array
) -> Array:
    """As `reduction.error_triangles`; the rows stay."""
    (s, k, n), (b, p, _) = given.shape, twists.shape
    out = np.empty((b, p + s, p + s))
    room = _room(p + s, k, point.shape[1] // n if n else 1)
    _native.error_triangles(frames, point, at, twists, *_terms(mixture), given, room, out)
    return out


def with_diagonal(triangle: Array, diagonal: Array, right: Array) -> Array:
    """As `reduction.with_diagonal`."""
    out = np.empty(triangle.shape)
    _native.with_diagonal(triangle, diagonal, right, _room(len(triangle), 1, 0), out)
    return out


def _terms(mixture: Mixture) -> tuple[Array, Array, Array]:
    """Rows, components and shares, whatever their strides were."""
    rows, components, shares = map(np.ascontiguousarray, (mixture.rows, mixture.components, mixture.shares))
    return rows, components, shares


def _room(columns: int, readings: int, ends: int) -> Array:
    """Memory to reduce rows in; fresh pages for every triangle would cost as much as a part of the work."""
    return scratch("room", _native.room(columns, readings, ends))
