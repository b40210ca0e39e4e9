"""Visibility of the inner corners of a checkerboard.

The image around such a corner is the same after half a turn about it: black meets black across the corner.
What covers a part of it breaks this symmetry, and would move the corner.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..cameras.pose_from_points import direct_linear_transform
from .opencv import require_opencv

# Half the side of the patch that is compared, as a fraction of the undisturbed width, and its smallest size
# [px]: blur needs some pixels.
_SHARE, _MIN_PIXELS = 0.9, 2.0
# Points along each side of a patch.
_N_POINTS = 12
# Smallest correlation of a patch with itself after half a turn.
_MIN_CORRELATION = 0.8


def are_symmetric(image: Array, points: Array, pixels: Array, width: float) -> Array:
    """Return which corners look the same after half a turn.

    Args:
        image: Grey values, shape (height, width).
        points: Corners on the board, in squares, shape (c, 2).
        pixels: Image coordinates, shape (c, 2) [px].
        width: Distance from a corner within which there is nothing but the four squares, in squares.

    Returns:
        Whether each corner is symmetric, shape (c,); all of them if there are fewer than four.
    """
    if len(points) < 4:
        return np.ones(len(points), bool)
    homography = direct_linear_transform(points, pixels)
    ends = np.concatenate([points + np.array(axis) for axis in ([1, 0], [0, 1])])
    mapped = np.column_stack([ends, np.ones(len(ends))]) @ homography.T
    x, y = np.split(mapped[:, :2] / mapped[:, 2:], 2)
    # Sides of a square at each corner.
    sides = np.stack([x - pixels, y - pixels], 2)
    size = np.linalg.norm(sides, axis=1).min(1)
    half = np.clip(np.maximum(_SHARE * width, _MIN_PIXELS / np.maximum(size, 1e-9)), None, 0.5)
    a, b = np.meshgrid(*[np.linspace(-1, 1, _N_POINTS)] * 2)
    offsets = half[:, None, None] * np.stack([a.ravel(), b.ravel()])  # (c, 2, g)
    where = pixels[:, :, None] + sides @ offsets
    grey = require_opencv().remap(
        image, where[:, 0].astype(np.float32), where[:, 1].astype(np.float32), 1, borderMode=1
    )
    grey = grey.astype(float) - grey.mean(1, keepdims=True)
    turned = grey[:, ::-1]
    squares = np.sum(grey**2, 1)
    return np.sum(grey * turned, 1) > _MIN_CORRELATION * np.maximum(squares, 1e-9)
