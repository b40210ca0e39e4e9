"""Sub-pixel corners of square tags from their edges.

The outer corner of a tag is rounded by the blur of the image, and methods that look at its neighbourhood
place it too far inside. Blur does not move a straight edge. The four edges are therefore measured along their
whole length, each by a straight line, and the corners are the intersections of these lines.

The position of an edge along a short profile across it follows from the mean of the profile: with the grey
values d on the dark side and b on the bright side, and the length 2h of the profile, the part
(mean - d)/(b - d) of it is bright.
"""

from __future__ import annotations

import numpy as np

from .._typing import Array
from .opencv import require_opencv

# Parts of an edge that are measured: corners are rounded.
_FIRST, _LAST = 0.12, 0.88
# Half the length of a profile as a fraction of the module of a tag, and its limits [px].
_REACH, _MIN_REACH, _MAX_REACH = 0.45, 1.5, 4.0
# Points of a profile per pixel, and repetitions with the improved corners.
_POINTS_PER_PIXEL, _N_ROUNDS = 4, 3
# Smallest difference of the grey values on both sides of an edge.
_MIN_CONTRAST = 10.0
# Largest RMS distance of an edge from a straight line [px]: something covers a part of a crooked edge.
_MAX_BEND = 0.5


def refine_by_edges(image: Array, corners: Array, n_modules: int) -> Array | None:
    """Improve the corners (4, 2) [px] of a tag; None if an edge is too short, too weak or hidden."""
    for _ in range(_N_ROUNDS):
        sides = np.roll(corners, -1, 0) - corners
        shortest = float(np.linalg.norm(sides, axis=1).min())
        reach = float(np.clip(_REACH * shortest / n_modules, _MIN_REACH, _MAX_REACH))
        lines: list[Array] = []
        for start, side in zip(corners, sides, strict=True):
            line = _edge_line(image, start, side, corners.mean(0), reach)
            if line is None:
                return None
            lines.append(line)
        crossings = np.array([np.cross(lines[i - 1], lines[i]) for i in range(4)])
        corners = crossings[:, :2] / crossings[:, 2:]
    return corners


def _edge_line(image: Array, start: Array, side: Array, centre: Array, reach: float) -> Array | None:
    """Return the line (3,), a·u + b·v + c = 0, of an edge from a start along a side; None without one."""
    length = float(np.linalg.norm(side))
    if length < 4 * reach:
        return None
    outward = np.array([side[1], -side[0]]) / length
    if outward @ (start + 0.5 * side - centre) < 0:
        outward = -outward
    along = np.linspace(_FIRST, _LAST, max(8, int(length)))
    n = int(2 * reach * _POINTS_PER_PIXEL)
    across = ((np.arange(n) + 0.5) / n - 0.5) * 2 * reach
    points = start + along[:, None, None] * side + across[None, :, None] * outward
    if points.min() < 0 or np.any(points.max((0, 1)) > [image.shape[1] - 1, image.shape[0] - 1]):
        return None
    grey = require_opencv().remap(image, points.astype(np.float32), None, 1).astype(float)
    end = max(1, n // 8)
    dark, bright = float(np.median(grey[:, :end])), float(np.median(grey[:, -end:]))
    if bright - dark < _MIN_CONTRAST:
        return None
    offset = reach * (1 - 2 * (grey.mean(1) - dark) / (bright - dark))
    found = start + along[:, None] * side + offset[:, None] * outward
    middle = found.mean(0)
    _, extent, axes = np.linalg.svd(found - middle, full_matrices=False)
    if extent[1] > _MAX_BEND * np.sqrt(len(found)):
        return None
    normal = axes[1]
    return np.append(normal, -normal @ middle)
