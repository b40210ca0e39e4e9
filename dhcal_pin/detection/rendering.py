"""Rendered images of boards, for tests and for trying out a set-up without a camera.

Every pixel is the mean of its area. A pixel that an edge of the print crosses is the mean of a grid of points
within it: the line of sight of each point meets the plane of the board, whose edges are exact there. Pixel
centres are whole numbers, as in OpenCV. Blur and noise of a real camera are added last.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..cameras.boards import Board
from ..cameras.rig import Camera
from .opencv import require_opencv
from .printing import MARGIN, black_rectangles

# Grey values of print, paper and background.
BLACK, WHITE, BACKGROUND = 25.0, 230.0, 120.0
# Smallest cosine between a line of sight and the plane of a board, measured from its normal.
_MIN_COSINE = 1e-3


@frozen
class ImageQuality:
    """How a rendered image differs from an ideal one."""

    blur_std: float = 0.7  # Standard deviation of the blur [px]
    noise_std: float = 2.0  # Standard deviation of the noise of the grey values, which go from 0 to 255
    n_points: int = 6  # Number of points per pixel along each axis


@frozen(eq=False)
class _Print:
    """Print of a flat board as a table of grey values between edges."""

    x: Array  # Edges along x, increasing [m]
    y: Array  # Edges along y, increasing [m]
    grey: Array  # Grey values between them, shape (len(y) + 1, len(x) + 1); NaN outside the paper

    def cells(self, x: Array, y: Array) -> Array:
        """Return the numbers of the cells, in the order of `grey`, of points of the board's plane [m]."""
        return np.searchsorted(self.y, y) * self.grey.shape[1] + np.searchsorted(self.x, x)


def _print_of(board: Board) -> _Print:
    """Return the print of a board."""
    rectangles, size = black_rectangles(board)
    left, top, width, height = rectangles.T
    low = [np.round(edge, 9) for edge in (left, top)]
    high = [np.round(edge, 9) for edge in (left + width, top + height)]
    x, y = (
        np.unique(np.concatenate([[-MARGIN, side + MARGIN], a, b]))
        for a, b, side in zip(low, high, size, strict=True)
    )
    grey = np.full((len(y) + 1, len(x) + 1), np.nan)
    grey[1:-1, 1:-1] = WHITE
    columns = [np.searchsorted(x, edge) + 1 for edge in (low[0], high[0])]
    rows = [np.searchsorted(y, edge) + 1 for edge in (low[1], high[1])]
    for i in range(len(rectangles)):
        grey[rows[0][i] : rows[1][i], columns[0][i] : columns[1][i]] = BLACK
    return _Print(x, y, grey)


def render_images(
    camera: Camera,
    views: Iterable[Sequence[tuple[Board, Array]]],
    rng: np.random.Generator,
    quality: ImageQuality | None = None,
) -> Iterator[Array]:
    """Render images of boards by one camera."""
    quality = quality or ImageQuality()
    sight, print_of = _sight_of_pixel_corners(camera), cache(_print_of)
    for boards in views:
        sheets = [(print_of(board), se3.inverse(pose)) for board, pose in boards]
        image = _ideal_image(sight, sheets, quality.n_points)
        if quality.blur_std:
            image = require_opencv().GaussianBlur(image, (0, 0), quality.blur_std)
        image = image + quality.noise_std * rng.standard_normal(image.shape)
        yield np.clip(np.round(image), 0, 255).astype(np.uint8)


def _sight_of_pixel_corners(camera: Camera) -> Array:
    """Return the lines of sight X/Z, Y/Z of the corners of all pixels, (2, height + 1, width + 1)."""
    v, u = np.mgrid[: camera.height + 1, : camera.width + 1] - 0.5
    plane = camera.lens.normalize(np.stack([u.ravel(), v.ravel()]), camera.values)
    return plane.reshape(2, *u.shape)


def _ideal_image(sight: Array, sheets: Sequence[tuple[_Print, Array]], n: int) -> Array:
    """Return mean grey values (height, width) of prints, each with the pose of the camera in its board."""
    # Pixels at edges are the mean of n·n points.
    grey, found = _grey_values(sight.reshape(2, -1), sheets)
    image = grey.reshape(sight.shape[1:])[:-1, :-1].copy()
    cells = np.array(found).reshape(-1, *sight.shape[1:])
    first = cells[:, :-1, :-1]
    changes = (cells[:, 1:, :-1] != first) | (cells[:, :-1, 1:] != first) | (cells[:, 1:, 1:] != first)
    rows, columns = np.nonzero(changes.any(0))
    quads = np.array([sight[:, rows + i, columns + j] for i in (0, 1) for j in (0, 1)])
    offsets = (np.arange(n) + 0.5) / n
    total = np.zeros(len(rows))
    for b in offsets:
        for a in offsets:
            weights = ((1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a)
            total += _grey_values(np.einsum("q,qip->ip", weights, quads), sheets)[0]
    image[rows, columns] = total / n**2
    return image


def _hits(sight: Array, inverse: Array) -> tuple[Array, Array]:
    """Return points (2, m) [m] of a board on lines of sight X/Z, Y/Z, and depths, infinite without a hit."""
    direction = inverse[:3, :2] @ sight + inverse[:3, 2:3]
    is_hit = (direction[2] > _MIN_COSINE) & (inverse[2, 3] < 0)
    depth = np.where(is_hit, -inverse[2, 3] / np.where(is_hit, direction[2], 1.0), np.inf)
    points = inverse[:2, 3:4] + np.where(is_hit, depth, 0.0) * direction[:2]
    return depth, points


def _grey_values(sight: Array, sheets: Sequence[tuple[_Print, Array]]) -> tuple[Array, list[Array]]:
    """Return the grey values (m,) along lines of sight (2, m), and the cells (m,) of each print on them."""
    # The nearest board hides the others.
    out, nearest = np.full(sight.shape[1], BACKGROUND), np.full(sight.shape[1], np.inf)
    cells = []
    for sheet, inverse in sheets:
        depth, points = _hits(sight, inverse)
        cells.append(np.where(np.isfinite(depth), sheet.cells(*points), 0))
        grey = sheet.grey.ravel()[cells[-1]]
        is_seen = np.isfinite(grey) & (depth < nearest)
        out[is_seen], nearest[is_seen] = grey[is_seen], depth[is_seen]
    return out, cells
