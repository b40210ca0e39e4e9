"""Type stub of the compiled module built from `_native.c`.

Arrays hold doubles unless stated otherwise, components first and samples last; the last axis must be
contiguous. Arguments named `out` and all arguments after the inputs are written in place. The functions of
`native.py` allocate them; `kinematics.py` and `qr.py` document shapes and formulas.
"""

from .._typing import Array

def cos_sin(angles: Array, cosines: Array, sines: Array, /) -> None: ...
def propagate_frames(
    link_transforms: Array, prismatic: Array, values: Array, cosines: Array, sines: Array, frames: Array, /
) -> None: ...
def point_jacobian(frames: Array, point: Array, bodies: Array, twists: Array, out: Array, /) -> None: ...
def apply_observation_matrix(
    jacobian: Array, rows: Array, components: Array, coefficients: Array, out: Array, /
) -> None: ...
def perturb_frames(
    body_from_urdf: Array,
    origins: Array,
    tool: Array,
    error_frames: Array,
    twists: Array,
    x: Array,
    displacements: Array,
    body_twists: Array,
    /,
) -> None: ...
def log_rotations(rotations: Array, out: Array, /) -> int: ...
def right_jacobian_inverse_batch(rotvecs: Array, out: Array, /) -> None: ...
def work_size(columns: int, residuals: int, ends: int, /) -> int: ...
def r_factors(rows: Array, work: Array, out: Array, /) -> None: ...
def append_diagonal(r_factors: Array, diagonal: Array, target: Array, work: Array, out: Array, /) -> None: ...
def invert_triangular(r: Array, out: Array, /) -> float: ...
def solve_triangular(r_factors: Array, sides: Array, out: Array, /) -> None: ...
def factor_jacobian(
    frames: Array,
    point: Array,
    bodies: Array,
    twists: Array,
    rows: Array,
    components: Array,
    coefficients: Array,
    given: Array,
    work: Array,
    out: Array,
    /,
) -> None: ...
