"""Inner loops of every calibration: compiled C kernels, or NumPy and LAPACK if the build had no compiler.

Both implementations evaluate the same formulas; results differ only by rounding, because the order of sums
differs. `kinematics.py` and `qr.py` are the NumPy implementation and document shapes and formulas.
`native.py` has the same functions and calls the compiled module `_native`.

Only functions that treat many samples at once belong here. Letters in shapes: m samples, n independent
joints, k moving joints or residuals per sample, p errors, b bodies or batch members, c columns. Arrays have
the samples on the last axis, so that the samples of one component are contiguous in memory.
"""

from __future__ import annotations

try:
    from .native import (
        append_diagonal,
        apply_observation_matrix,
        cos_sin,
        factor_jacobian,
        invert_triangular,
        log_rotations,
        perturb_frames,
        point_jacobian,
        propagate_frames,
        r_factor,
        r_factors,
        reciprocal_condition,
        right_jacobian_inverse_batch,
        solve_triangular,
    )
except ImportError:
    from .kinematics import (
        apply_observation_matrix,
        cos_sin,
        log_rotations,
        perturb_frames,
        point_jacobian,
        propagate_frames,
        right_jacobian_inverse_batch,
    )
    from .qr import (
        append_diagonal,
        factor_jacobian,
        invert_triangular,
        r_factor,
        r_factors,
        reciprocal_condition,
        solve_triangular,
    )

__all__ = [
    "append_diagonal",
    "apply_observation_matrix",
    "cos_sin",
    "factor_jacobian",
    "invert_triangular",
    "log_rotations",
    "perturb_frames",
    "point_jacobian",
    "propagate_frames",
    "r_factor",
    "r_factors",
    "reciprocal_condition",
    "right_jacobian_inverse_batch",
    "solve_triangular",
]
