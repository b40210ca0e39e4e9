"""What `_native.c` offers; arrays are of doubles, components first, and as `loops` describes them."""

from .._typing import Array

def cosines_and_sines(angles: Array, cosines: Array, sines: Array, /) -> None: ...
def carry_frames(
    links: Array, prismatic: Array, values: Array, cos: Array, sin: Array, frames: Array, /
) -> None: ...
def point_velocities(frames: Array, point: Array, at: Array, twists: Array, out: Array, /) -> None: ...
def mix_velocities(
    velocities: Array, rows: Array, components: Array, shares: Array, out: Array, /
) -> None: ...
def move_stations(
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
def right_jacobian_inverses(vectors: Array, out: Array, /) -> None: ...
def room(columns: int, readings: int, ends: int, /) -> int: ...
def triangles(rows: Array, room: Array, out: Array, /) -> None: ...
def with_diagonal(triangle: Array, diagonal: Array, right: Array, room: Array, out: Array, /) -> None: ...
def error_triangles(
    frames: Array,
    point: Array,
    at: Array,
    twists: Array,
    rows: Array,
    components: Array,
    shares: Array,
    given: Array,
    room: Array,
    out: Array,
    /,
) -> None: ...
