"""Checks of the arrays that measurements are constructed from.

Messages have the form `<kind>: <argument> <what is wrong>; <what is expected>`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._typing import Array
from ..exceptions import InvalidArgumentError

# Largest deviation of RRᵀ from the identity that rounding in a file may cause.
MAX_ROTATION_DEVIATION = 1e-6


def _as_numbers(value: Any, where: str, expected: str) -> Array:
    """Return a value as an array of floats of any shape."""
    try:
        if np.iscomplexobj(value):
            raise TypeError  # NumPy drops imaginary parts with a warning only
        return np.asarray(value, float)
    except (TypeError, ValueError):
        problem = f"{where} of type {type(value).__name__} is not an array of numbers"
        raise InvalidArgumentError(f"{problem}; expected {expected}") from None


def _require_finite(value: Array, where: str) -> None:
    """Raise an error that names the first row with a value that is not finite."""
    if not (is_finite := np.isfinite(value)).all():
        row = int(np.argwhere(~is_finite)[0][0]) + 1
        raise InvalidArgumentError(f"{where} is not finite in row {row}; expected finite numbers")


def validated_joint_positions(value: Any, kind: str) -> Array:
    """Return joint positions as an array of shape (m, n)."""
    where, expected = f"{kind}: q", "shape (m, n), one row of n joint positions per sample"
    q = _as_numbers(value, where, expected)
    if q.ndim != 2:
        hint = ""
        if q.ndim == 1:
            hint = "; write q[None] for a single sample"
        elif q.shape[1:] == (4, 4):
            hint = "; these are poses, which come after q"
        raise InvalidArgumentError(f"{where} has shape {q.shape}; expected {expected}{hint}")
    _require_finite(q, where)
    return q


def validated_array(
    value: Any, shape: tuple[int | None, ...], where: str, each: str = "row", per: str = "sample"
) -> Array:
    """Return an array of finite numbers of a given shape."""
    sizes = ", ".join("k" if size is None else str(size) for size in shape)
    expected = f"shape ({sizes}{',' if len(shape) == 1 else ''}), one {each} per {per}"
    out = _as_numbers(value, where, expected)
    if out.ndim != len(shape) or any(
        a not in (None, b) for a, b in zip(shape[1:], out.shape[1:], strict=True)
    ):
        raise InvalidArgumentError(f"{where} has shape {out.shape}; expected {expected}")
    if shape[0] not in (None, len(out)):
        raise InvalidArgumentError(
            f"{where} has {len(out)} entries for {shape[0]} {per}s; expected {expected}"
        )
    _require_finite(out, where)
    return out


def validated_sigma(value: Any, shape: tuple[int, int], where: str) -> Array:
    """Return positive, finite standard deviations as an array of a given shape (m, k)."""
    # The value is one number, one per column, or an array; for a single column also one per sample, (m,).
    expected = f"one number or shape {shape}"
    out = _as_numbers(value, where, expected)
    if shape[1] == 1 and out.shape == shape[:1]:
        out = out[:, None]
    try:
        out = np.array(np.broadcast_to(out, shape))
    except ValueError:
        raise InvalidArgumentError(f"{where} has shape {out.shape}; expected {expected}") from None
    if not (np.isfinite(out).all() and (out > 0).all()):
        raise InvalidArgumentError(
            f"{where} has a value that is not positive and finite; expected standard deviations above zero"
        )
    return out


def validated_poses(value: Any, m: int, kind: str) -> Array:
    """Return homogeneous matrices as an array of shape (m, 4, 4)."""
    where = f"{kind}: poses"
    poses = validated_array(value, (m, 4, 4), where, "homogeneous 4 x 4 matrix")
    rotation = poses[:, :3, :3]
    deviation = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((deviation > MAX_ROTATION_DEVIATION) | (np.linalg.det(rotation) < 0))
    if bad.size:
        raise InvalidArgumentError(
            f"{where}: the rotation part R of sample {bad[0] + 1} is not a rotation (RRᵀ differs from I by "
            f"{deviation[bad[0]]:.2g}, det R is {np.linalg.det(rotation[bad[0]]):.3g}); "
            "expected orthonormal right-handed axes"
        )
    return poses


def encode_labels(labels: Sequence[str], m: int, where: str) -> tuple[tuple[str, ...], Array]:
    """Number the distinct labels of the samples in order of first appearance."""
    if isinstance(labels, str) or not hasattr(labels, "__len__"):
        raise InvalidArgumentError(f"{where} is {labels!r:.40}; expected a sequence of {m} names")
    if len(labels) != m:
        raise InvalidArgumentError(
            f"{where} has {len(labels)} names for {m} samples; expected one per sample"
        )
    texts = [str(label) for label in labels]
    names = tuple(dict.fromkeys(texts))
    index = {name: i for i, name in enumerate(names)}
    return names, np.array([index[text] for text in texts], int)
