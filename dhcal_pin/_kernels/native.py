"""Compiled kernels: the functions of `kinematics.py` and `qr.py` by the module `_native`.

Importing this module raises ImportError if the build had no compiler. Shapes and formulas are documented in
`kinematics.py` and `qr.py`. Unlike the NumPy implementation, no function overwrites its inputs.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from . import _native, kinematics, qr
from .types import JointState, ObservationMatrix
from .work_arrays import work_array

# LAPACK is faster for matrices with more rows than this, in spite of the time of its import.
LARGE = 200


def cos_sin(angles: Array) -> tuple[Array, Array]:
    """Compute cosines and sines; see `kinematics.cos_sin`."""
    cosines, sines = np.empty_like(angles), np.empty_like(angles)
    _native.cos_sin(angles, cosines, sines)
    return cosines, sines


def propagate_frames(
    link_transforms: Array, prismatic: Array, joint_state: JointState, frames: Array
) -> None:
    """Compute the frames along a chain; see `kinematics.propagate_frames`."""
    _native.propagate_frames(
        link_transforms, prismatic, joint_state.positions, joint_state.cos, joint_state.sin, frames
    )


def point_jacobian(frames: Array, point: Array, bodies: Array, twists: Array, out: Array) -> None:
    """Compute the Jacobian of a point by body twists; see `kinematics.point_jacobian`."""
    _native.point_jacobian(frames, point, bodies, twists, out)


def apply_observation_matrix(jacobian: Array, observation: ObservationMatrix, out: Array) -> Array:
    """Multiply an observation matrix by a Jacobian; see `kinematics.apply_observation_matrix`."""
    _native.apply_observation_matrix(jacobian, *_contiguous_terms(observation), out)
    return out


def perturb_frames(
    body_from_urdf: Array, origins: Array, tool: Array, error_frames: Array, twists: Array, x: Array
) -> tuple[Array, Array]:
    """Displace the error frames of a chain; see `kinematics.perturb_frames`."""
    displacements = np.empty((len(x), 2 * len(body_from_urdf) + 2, 4, 4))
    body_twists = np.empty((len(x), *twists.shape[1:]))
    _native.perturb_frames(body_from_urdf, origins, tool, error_frames, twists, x, displacements, body_twists)
    return displacements, body_twists


def log_rotations(rotations: Array) -> Array:
    """Compute rotation vectors; see `kinematics.log_rotations`."""
    out = np.empty(rotations.shape[1:])
    n_near_half_turn = _native.log_rotations(rotations, out)
    # Near an angle of π the compiled formula loses digits.
    return kinematics.log_rotations(rotations) if n_near_half_turn else out


def right_jacobian_inverse_batch(rotvecs: Array) -> Array:
    """Compute inverse right Jacobians of SO(3); see `kinematics.right_jacobian_inverse_batch`."""
    out = np.empty((3, *rotvecs.shape))
    _native.right_jacobian_inverse_batch(rotvecs, out)
    return out


def r_factor(rows: Array) -> Array:
    """Compute the R factor of a matrix; see `qr.r_factor`."""
    return r_factors(rows[None])[0]


def r_factors(rows: Array) -> Array:
    """Compute the R factors of a batch of matrices; see `qr.r_factors`."""
    b, c, k, _ = rows.shape
    out = np.empty((b, c, c))
    _native.r_factors(rows, _work_array(c, k, 0), out)
    return out


def factor_jacobian(
    frames: Array, point: Array, bodies: Array, twists: Array, observation: ObservationMatrix, given: Array
) -> Array:
    """Compute R factors of whitened Jacobians without storing the rows; see `qr.factor_jacobian`."""
    (s, k, n), (b, p, _) = given.shape, twists.shape
    out = np.empty((b, p + s, p + s))
    work = _work_array(p + s, k, point.shape[1] // n if n else 1)
    _native.factor_jacobian(frames, point, bodies, twists, *_contiguous_terms(observation), given, work, out)
    return out


def append_diagonal(r: Array, diagonal: Array, target: Array) -> Array:
    """Append a diagonal block of rows to R factors; see `qr.append_diagonal`."""
    out = np.empty(r.shape)
    _native.append_diagonal(r, diagonal, target, _work_array(r.shape[1], 1, 0), out)
    return out


def invert_triangular(r: Array) -> Array:
    """Compute the inverse of a triangular matrix; see `qr.invert_triangular`."""
    if len(r) > LARGE:
        return qr.invert_triangular(r)
    out = np.empty(r.shape)
    _native.invert_triangular(r, out)
    return out


def reciprocal_condition(r: Array) -> float:
    """Compute the reciprocal condition number of a triangular matrix; see `qr.reciprocal_condition`."""
    if len(r) > LARGE:
        return qr.reciprocal_condition(r)
    return _native.invert_triangular(r, work_array("inverse", *r.shape))


def solve_triangular(r: Array, sides: Array) -> Array:
    """Solve upper triangular systems; see `qr.solve_triangular`."""
    out = np.empty(sides.shape)
    _native.solve_triangular(r, sides, out)
    return out


def _contiguous_terms(observation: ObservationMatrix) -> tuple[Array, Array, Array]:
    """Return rows, components and coefficients of an observation matrix as contiguous arrays."""
    rows, components, coefficients = map(
        np.ascontiguousarray, (observation.rows, observation.components, observation.coefficients)
    )
    return rows, components, coefficients


def _work_array(columns: int, residuals: int, ends: int) -> Array:
    """Return the work memory of a factorization."""
    return work_array("work", _native.work_size(columns, residuals, ends))
