"""Boards to print at their true scale, as PDF."""

from __future__ import annotations

import zlib

import numpy as np

from .._typing import Array
from ..cameras.boards import Board
from ..exceptions import InvalidArgumentError
from .corners import charuco_board, marker_dictionary

# Points of a PDF per metre, and white margin around a board [m].
_POINTS_PER_METRE = 72 / 0.0254
MARGIN = 0.01
# Black modules around the bits of a marker.
_BORDER_BITS = 1


def black_rectangles(board: Board) -> tuple[Array, tuple[float, float]]:
    """Return the black rectangles of a flat board."""
    if board.type == "points":
        raise InvalidArgumentError(f"{board.where}: a set of points cannot be printed; expected another type")
    if board.type == "aprilgrid":
        pitch = board.square + board.spacing
        cells = [(pitch * x, pitch * y) for y in range(board.rows) for x in range(board.columns)]
        marker = [_marker(board, i, *cell, board.square) for i, cell in enumerate(cells)]
        size = pitch * board.columns - board.spacing, pitch * board.rows - board.spacing
        return np.concatenate(marker), size
    # The first square is black, except in the legacy pattern with an even number of rows.
    first_black = 1 if board.is_legacy and board.rows % 2 == 0 else 0
    side = board.square
    black = [
        [side * x, side * y, side, side]
        for y in range(board.rows)
        for x in range(board.columns)
        if (x + y) % 2 == first_black
    ]
    parts = [np.array(black)]
    if board.type == "charuco":
        numbers = np.asarray(charuco_board(board).getIds()).ravel().tolist()
        white = [
            (x, y) for y in range(board.rows) for x in range(board.columns) if (x + y) % 2 != first_black
        ]
        inset = (side - board.marker) / 2
        parts += [
            _marker(board, number, side * x + inset, side * y + inset, board.marker)
            for number, (x, y) in zip(numbers, white, strict=True)
        ]
    return np.concatenate(parts), (side * board.columns, side * board.rows)


def _marker(board: Board, number: int, left: float, top: float, size: float) -> Array:
    """Return the black rectangles (r, 4) of a marker: one per run of black modules in a row."""
    dictionary = marker_dictionary(board)
    n = dictionary.markerSize + 2 * _BORDER_BITS
    modules = np.asarray(dictionary.generateImageMarker(number, n, borderBits=_BORDER_BITS)) == 0
    side, out = size / n, []
    for row, line in enumerate(modules):
        edges = np.flatnonzero(np.diff(np.pad(line.astype(int), 1)))
        out += [
            [left + side * start, top + side * row, side * (end - start), side]
            for start, end in edges.reshape(-1, 2)
        ]
    return np.array(out)


def board_pdf(board: Board) -> bytes:
    """Draw a board at its true scale."""
    rectangles, (width, height) = black_rectangles(board)
    scale = _POINTS_PER_METRE
    page = [(side + 2 * MARGIN) * scale for side in (width, height)]
    lines = ["0 g"]
    for left, top, w, h in rectangles.tolist():
        x, y = (left + MARGIN) * scale, page[1] - (top + h + MARGIN) * scale
        lines.append(f"{x:.5f} {y:.5f} {w * scale:.5f} {h * scale:.5f} re")
    content = zlib.compress("\n".join([*lines, "f"]).encode())
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page[0]:.5f} {page[1]:.5f}] /Contents 4 0 R "
        "/Resources << >> /ViewerPreferences << /PrintScaling /None >> >>".encode(),
        f"<< /Length {len(content)} /Filter /FlateDecode >>\nstream\n".encode() + content + b"\nendstream",
    ]
    out, starts = b"%PDF-1.6\n", []
    for number, text in enumerate(objects, 1):
        starts.append(len(out))
        out += f"{number} 0 obj\n".encode() + text + b"\nendobj\n"
    table = "".join(f"{start:010d} 00000 n \n" for start in starts)
    trailer = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
    trailer += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(out)}\n%%EOF\n"
    return out + trailer.encode()
