"""What `_native.c` offers; arrays are of doubles, components first, and as `loops` describes them."""

from .._typing import Array

def cos_sin(angles: Array, cosines: Array, sines: Array, /) -> None: ...
def propagate_frames(
    links: Array, prismatic: Array, values: Array, cos: Array, sin: Array, frames: Array, /
) -> None: ...
def point_jacobian(frames: Array, point: Array, at: Array, twists: Array, out: Array, /) -> None: ...
def apply_observation_matrix(
    velocities: Array, rows: Array, components: Array, shares: Array, out: Array, /
) -> None: ...
def perturb_frames(
    into: Array,
    origins: Array,
    tool: Array,
    stations: Array,
    twists: Array,
    x: Array,
    motions: Array,
    carried: Array,
    /,
) -> None: ...
def log_rotations(turns: Array, out: Array, /) -> int: ...
def right_jacobian_inverse_batch(vectors: Array, out: Array, /) -> None: ...
def work_size(columns: int, readings: int, ends: int, /) -> int: ...
def r_factors(rows: Array, work: Array, out: Array, /) -> None: ...
def append_diagonal(triangle: Array, diagonal: Array, right: Array, work: Array, out: Array, /) -> None: ...
def factor_jacobian(
    frames: Array,
    point: Array,
    at: Array,
    twists: Array,
    rows: Array,
    components: Array,
    shares: Array,
    given: Array,
    work: Array,
    out: Array,
    /,
) -> None: ...
