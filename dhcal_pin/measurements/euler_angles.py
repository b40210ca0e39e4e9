"""Euler angles: rotations by three angles a, b, c about the axes i, j, k of a notation.

About the rotated axes (intrinsic), R = R_i(a)·R_j(b)·R_k(c); about the fixed axes (extrinsic), R =
R_k(c)·R_j(b)·R_i(a), which are the angles c, b, a about the rotated axes k, j, i. A notation is written as
its axes, such as "zyx", with "fixed-" before axes that do not rotate. Roll, pitch and yaw, "rpy", are the
angles about the fixed axes x, y and z.

Shapes: m samples.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array

#: Notation of rotation vectors, which are three numbers, too.
ROTATION_VECTOR = "rotvec"
_FIXED = "fixed-"
_RPY = "rpy"
_ORDERS = [*("".join(axes) for axes in permutations("xyz")), *(a + b + a for a, b in permutations("xyz", 2))]


def euler_notation(axes: str, frame: str) -> str:
    """Return the notation of angles about axes such as "zyx", "intrinsic" or "extrinsic"."""
    if frame == "intrinsic":
        return axes
    return _RPY if axes == "xyz" else f"{_FIXED}{axes}"


def _describe(axes: str, frame: str) -> str:
    """Return the name of a notation for users."""
    if frame == "intrinsic":
        first, second, third = axes.upper()
        return f"Euler angles {first}, {second}', {third}''"
    if axes == "xyz":
        return "roll, pitch and yaw about fixed axes"
    return f"angles about the fixed axes {', '.join(axes[:2])} and {axes[2]}"


#: Description of each notation.
EULER_NOTATIONS: dict[str, str] = {
    euler_notation(axes, frame): _describe(axes, frame)
    for frame in ("intrinsic", "extrinsic")
    for axes in _ORDERS
}


@frozen(eq=False)
class EulerAngles:
    """Euler angles that a file has."""

    notation: str
    lines: Array  #: Line of each sample, (m,), ascending.
    angles: Array  #: Angles in the order of the notation's axes, (m, 3) [rad].


def angles_to_matrix(angles: Array, notation: str) -> Array:
    """Convert Euler angles (m, 3) [rad] to rotations (m, 3, 3)."""
    axes, step = _rotated_axes(notation)
    first, second, third = (
        se3.exp3(angles[:, [i]] * np.eye(3)["xyz".index(axis)])
        for i, axis in zip((0, 1, 2)[::step], axes, strict=True)
    )
    return first @ second @ third


def matrix_to_angles(rotations: Array, notation: str) -> Array:
    """Convert rotations (m, 3, 3) to Euler angles (m, 3) [rad]."""
    axes, step = _rotated_axes(notation)
    i, j, k = ("xyz".index(axis) for axis in axes)
    is_repeated = i == k
    if is_repeated:
        k = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    r = np.moveaxis(rotations, 0, -1)
    # The second angle is within ±pi/2, or from 0 to pi if the first axis and the third are the same.
    if is_repeated:
        angles = (
            np.arctan2(r[j, i], -sign * r[k, i]),
            np.arctan2(np.hypot(r[i, j], r[i, k]), r[i, i]),
            np.arctan2(r[i, j], sign * r[i, k]),
        )
    else:
        angles = (
            np.arctan2(-sign * r[j, k], r[k, k]),
            np.arctan2(sign * r[i, k], np.hypot(r[i, i], r[i, j])),
            np.arctan2(-sign * r[i, j], r[i, i]),
        )
    return np.stack(angles[::step], -1)


def _rotated_axes(notation: str) -> tuple[str, int]:
    """Return the axes of the same rotations about rotated axes, and 1, or -1 if their angles are reversed."""
    if notation in _ORDERS:
        return notation, 1
    return ("xyz" if notation == _RPY else notation.removeprefix(_FIXED))[::-1], -1
