"""The inner loops of every calibration: compiled where the installation could, else by NumPy and LAPACK.

Both ways give the same sums, in another order; what each does stands in `kinematics` and `reduction`.
"""

from __future__ import annotations

try:
    from .native import (
        carry_frames,
        cosines_and_sines,
        error_triangles,
        log_rotations,
        mix_velocities,
        move_stations,
        point_velocities,
        right_jacobian_inverses,
        triangle_of,
        triangles_of,
        with_diagonal,
    )
except ImportError:
    from .kinematics import (
        carry_frames,
        cosines_and_sines,
        log_rotations,
        mix_velocities,
        move_stations,
        point_velocities,
        right_jacobian_inverses,
    )
    from .qr import error_triangles, triangle_of, triangles_of, with_diagonal

__all__ = [
    "carry_frames",
    "cosines_and_sines",
    "error_triangles",
    "log_rotations",
    "mix_velocities",
    "move_stations",
    "point_velocities",
    "right_jacobian_inverses",
    "triangle_of",
    "triangles_of",
    "with_diagonal",
]
