"""Inner corners of a checkerboard, where the edges of four squares cross: position and visibility.

Patches around the corners are resampled along the sides of the squares, so that a board that is seen at an
angle looks like one from the front.

- Position: every point d of an edge satisfies g·(d - c) = 0 with the gradient g of the grey values and the
  crossing c. The least-squares solution is Σ g·gᵀ·c = Σ g·gᵀ·d (Förstner and Gülch 1987). Points near the two
  edges are used, and none within the markers of a ChArUco board.
- Visibility: a patch is the same after half a turn about the corner, as black meets black across it. What
  covers a part of it breaks this symmetry, and would move the corner.

Reference: W. Förstner and E. Gülch, A Fast Operator for Detection and Precise Location of Distinct Points,
Corners and Centres of Circular Features, ISPRS Intercommission Conference 1987.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from ..cameras.pose_from_points import determines_homography, direct_linear_transform
from .opencv import require_opencv

# Half the length of the edges that are used, in squares.
_EDGE_LENGTH = 0.4
# Width by which blur spreads the markers, and limits of half the width of the band along an edge [px].
_BLUR, _BAND = 2.5, (1.5, 3.5)
# Smallest and largest number of points along a side of a patch: about one per pixel.
_MIN_POINTS, _MAX_POINTS = 11, 61
# Repetitions of the solution, and largest move of a corner [px]: it converges in two or three.
_N_ROUNDS, _MAX_MOVE = 5, 2.0
# Smallest correlation of a patch with itself after half a turn.
_MIN_CORRELATION = 0.8


def refine_crossings(image: Array, points: Array, pixels: Array, width: float) -> tuple[Array, Array]:
    """Improve corners (c, 2) of a board, and judge whether each is visible; all stay without a homography."""
    # Within `width` squares from the edges there is nothing but the four squares.
    if not determines_homography(points):
        return pixels, np.ones(len(points), bool)
    sides = _sides(points, pixels)
    lengths = np.linalg.norm(sides, axis=1)
    n = int(np.clip(2 * _EDGE_LENGTH * np.median(lengths.max(1)), _MIN_POINTS, _MAX_POINTS)) | 1
    grid = np.linspace(-_EDGE_LENGTH, _EDGE_LENGTH, n)
    offsets = np.stack([np.tile(grid, n), np.repeat(grid, n)])
    # Half the width of the band along each edge, in squares: the distance of the sides of a foreshortened
    # square is its area over the other side.
    area = np.abs(np.linalg.det(sides))[:, None]
    across = area / np.maximum(lengths[:, ::-1], 1e-9)
    band = np.clip(width * across - _BLUR, *_BAND) / np.maximum(across, 1e-9)
    is_used = (np.abs(offsets[0]) <= band[:, :1]) | (np.abs(offsets[1]) <= band[:, 1:])
    found = pixels.copy()
    for _ in range(_N_ROUNDS):
        grey = _patches(image, found, sides, offsets)
        squares = grey.reshape(-1, n, n)
        slopes = [np.gradient(squares, grid, axis=axis).reshape(len(found), -1) for axis in (2, 1)]
        gradient = np.stack(slopes, 1)
        weighted = gradient * is_used[:, None]
        normal = weighted @ gradient.swapaxes(1, 2)
        right = np.einsum("cig,cg->ci", weighted, np.einsum("cig,ig->cg", gradient, offsets))
        trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
        step = np.linalg.solve(normal + 1e-9 * np.maximum(trace, 1.0) * np.eye(2), right[:, :, None])
        found = found + (sides @ step)[..., 0]
    is_near = np.linalg.norm(found - pixels, axis=1) < _MAX_MOVE
    found = np.where(is_near[:, None], found, pixels)
    return found, is_near & _are_symmetric(_patches(image, found, sides, offsets), is_used)


def _sides(points: Array, pixels: Array) -> Array:
    """Return the sides of a square at each corner in the image as columns, (c, 2, 2) [px]."""
    homography = direct_linear_transform(points, pixels)
    columns = []
    for axis in np.eye(2):
        ends = np.concatenate([points + 0.5 * axis, points - 0.5 * axis])
        mapped = np.column_stack([ends, np.ones(len(ends))]) @ homography.T
        first, second = np.split(mapped[:, :2] / mapped[:, 2:], 2)
        columns.append(first - second)
    return np.stack(columns, 2)


def _patches(image: Array, centres: Array, sides: Array, offsets: Array) -> Array:
    """Return the grey values (c, g) at offsets (2, g) in squares from each centre (c, 2) [px]."""
    u, v = (centres[:, :, None] + sides @ offsets).astype(np.float32).swapaxes(0, 1)
    return require_opencv().remap(image.astype(np.float32), u, v, 1, borderMode=1).astype(float)


def _are_symmetric(grey: Array, is_used: Array) -> Array:
    """Return which patches (c, g) are the same after half a turn, at the points that are used (c, g)."""
    count = is_used.sum(1, keepdims=True)
    deviation = np.where(is_used, grey - np.sum(grey * is_used, 1, keepdims=True) / count, 0.0)
    squares = np.sum(deviation**2, 1)
    return np.sum(deviation * deviation[:, ::-1], 1) > _MIN_CORRELATION * np.maximum(squares, 1e-9)
