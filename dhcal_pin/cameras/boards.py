"""Boards: flat targets with corners at known positions, or any rigid set of points.

The frame of a flat board has its origin at the outer corner of the first square or tag, x along a row, y
along a column, and z = 0. Corners are numbered row by row, as OpenCV does:

- `checkerboard` and `charuco`: the (columns - 1)·(rows - 1) inner corners of the squares; x grows first;
- `aprilgrid`: four corners per tag, tag by tag, each in the order of OpenCV: top left, top right, bottom
  right, bottom left;
- `points`: the points as they are listed.
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import cached_property

import numpy as np

from .._frozen import frozen
from .._typing import Array

# Kinds of boards in rig files.
BOARD_TYPES = ("checkerboard", "charuco", "aprilgrid", "points")
# Length of the ruler line on a printed page [m].
RULER = 0.15


@frozen(eq=False)
class Board:
    """Board of a rig."""

    name: str  # Name of the board
    link: str  # Link that carries it, "world" or "tip"
    type: str  # One of `BOARD_TYPES`
    columns: int = 0  # Number of squares or tags along x; 0 for points
    rows: int = 0  # Number of squares or tags along y; 0 for points
    square: float = 0.0  # Side of a square [m]; for an aprilgrid, of a tag
    marker: float = 0.0  # Side of a marker of a ChArUco board [m]
    spacing: float = 0.0  # Gap between two tags of an aprilgrid [m]
    dictionary: str = ""  # Name of the dictionary of the markers
    # Whether a ChArUco board begins with a black square although it has an even number of rows.
    is_legacy: bool = False
    # Points of the type "points", shape (c, 3) [m].
    listed_points: Array = field(default_factory=lambda: np.empty((0, 3)))
    has_free_points: bool = False  # Whether the positions of the corners are estimated
    has_exact_points: bool = False  # Whether they are exact, so that it is not tried to estimate them
    pose: Array | None = None  # First guess of its pose in the link, shape (4, 4) [m]; None without one
    source: str = ""  # File and table that describe it, for messages; empty for a board from Python
    # Size of the print relative to the drawn board; all lengths here are those of the print.
    print_scale: float = 1.0

    @property
    def where(self) -> str:
        """Begin of messages about this board."""
        return self.source or f"board {self.name!r}"

    @property
    def drawn(self) -> Board:
        """Board as it is drawn, with the lengths before the printer changed them."""
        lengths = {name: getattr(self, name) / self.print_scale for name in ("square", "marker", "spacing")}
        return replace(self, **lengths, print_scale=1.0)

    @property
    def n_markers(self) -> int:
        """Number of markers or tags of a printed board."""
        n_squares = self.columns * self.rows
        return {"charuco": n_squares // 2, "aprilgrid": n_squares}.get(self.type, 0)

    @cached_property
    def points(self) -> Array:
        """Positions of the corners in the frame of the board, shape (c, 3) [m]."""
        if self.type == "points":
            return self.listed_points
        if self.type == "aprilgrid":
            pitch = self.square + self.spacing
            corners = self.square * np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1]])
            origins = pitch * _grid(self.columns, self.rows)
            return _flat((origins[:, None] + corners).reshape(-1, 2))
        return _flat(self.square * (1 + _grid(self.columns - 1, self.rows - 1)))


def _grid(columns: int, rows: int) -> Array:
    """Return the whole-numbered points of a grid row by row, (rows·columns, 2)."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel(), y.ravel()], -1).astype(float)


def _flat(points: Array) -> Array:
    """Append z = 0 to points (c, 2)."""
    return np.pad(points, ((0, 0), (0, 1)))
