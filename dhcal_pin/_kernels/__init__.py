"""The inner loops of every calibration: compiled where the installation could, else by NumPy and LAPACK.

Both ways give the same sums, in another order; what each does stands in `kinematics` and `reduction`.
"""

from __future__ import annotations

try:
    from .native import (
        append_diagonal,
        apply_observation_matrix,
        cos_sin,
        factor_jacobian,
        log_rotations,
        perturb_frames,
        point_jacobian,
        propagate_frames,
        r_factor,
        r_factors,
        right_jacobian_inverse_batch,
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
    from .qr import append_diagonal, factor_jacobian, r_factor, r_factors

__all__ = [
    "append_diagonal",
    "apply_observation_matrix",
    "cos_sin",
    "factor_jacobian",
    "log_rotations",
    "perturb_frames",
    "point_jacobian",
    "propagate_frames",
    "r_factor",
    "r_factors",
    "right_jacobian_inverse_batch",
]
