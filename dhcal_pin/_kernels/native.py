"""The inner loops in C; importing them fails where the installation had no compiler. See `loops`."""

from __future__ import annotations

import numpy as np

from .._typing import Array
from . import _native, kinematics
from .types import JointState, ObservationMatrix
from .work_arrays import work_array


def cos_sin(angles: Array) -> tuple[Array, Array]:
    """As `kinematics.cosines_and_sines`."""
    cosines, sines = np.empty_like(angles), np.empty_like(angles)
    _native.cos_sin(angles, cosines, sines)
    return cosines, sines


def propagate_frames(links: Array, prismatic: Array, motion: JointState, frames: Array) -> None:
    """As `kinematics.carry_frames`."""
    _native.propagate_frames(links, prismatic, motion.positions, motion.cos, motion.sin, frames)


def point_jacobian(frames: Array, point: Array, at: Array, twists: Array, out: Array) -> None:
    """As `kinematics.point_velocities`."""
    _native.point_jacobian(frames, point, at, twists, out)


def apply_observation_matrix(velocities: Array, mixture: ObservationMatrix, out: Array) -> Array:
    """As `kinematics.mix_velocities`."""
    _native.apply_observation_matrix(velocities, *_contiguous_terms(mixture), out)
    return out


def perturb_frames(
    body_from_urdf: Array, origins: Array, tool: Array, error_frames: Array, twists: Array, x: Array
) -> tuple[Array, Array]:
    """As `kinematics.move_stations`."""
    motions, carried = np.empty((2 * len(body_from_urdf) + 2, 4, 4)), np.empty(twists.shape)
    _native.perturb_frames(body_from_urdf, origins, tool, error_frames, twists, x, motions, carried)
    return motions, carried


def log_rotations(turns: Array) -> Array:
    """As `kinematics.log_rotations`."""
    out = np.empty(turns.shape[1:])
    # Near a half turn it takes more care.
    return kinematics.log_rotations(turns) if _native.log_rotations(turns, out) else out


def right_jacobian_inverse_batch(rotvecs: Array) -> Array:
    """As `kinematics.right_jacobian_inverses`."""
    out = np.empty((3, *rotvecs.shape))
    _native.right_jacobian_inverse_batch(rotvecs, out)
    return out


def r_factor(rows: Array) -> Array:
    """As `reduction.triangle_of`; the rows stay."""
    return r_factors(rows[None])[0]


def r_factors(rows: Array) -> Array:
    """As `reduction.triangles_of`; the rows stay."""
    b, c, k, _ = rows.shape
    out = np.empty((b, c, c))
    _native.r_factors(rows, _work_array(c, k, 0), out)
    return out


def factor_jacobian(
    frames: Array, point: Array, at: Array, twists: Array, mixture: ObservationMatrix, given: Array
) -> Array:
    """As `reduction.error_triangles`; the rows stay."""
    (s, k, n), (b, p, _) = given.shape, twists.shape
    out = np.empty((b, p + s, p + s))
    room = _work_array(p + s, k, point.shape[1] // n if n else 1)
    _native.factor_jacobian(frames, point, at, twists, *_contiguous_terms(mixture), given, room, out)
    return out


def append_diagonal(triangle: Array, diagonal: Array, right: Array) -> Array:
    """As `reduction.with_diagonal`."""
    out = np.empty(triangle.shape)
    _native.append_diagonal(triangle, diagonal, right, _work_array(len(triangle), 1, 0), out)
    return out


def _contiguous_terms(mixture: ObservationMatrix) -> tuple[Array, Array, Array]:
    """Rows, components and shares, whatever their strides were."""
    rows, components, shares = map(
        np.ascontiguousarray, (mixture.rows, mixture.components, mixture.coefficients)
    )
    return rows, components, shares


def _work_array(columns: int, readings: int, ends: int) -> Array:
    """Memory to reduce rows in; fresh pages for every triangle would cost as much as a part of the work."""
    return work_array("room", _native.work_size(columns, readings, ends))
