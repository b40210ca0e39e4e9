"""Boards to print at their true scale, as PDF."""

from __future__ import annotations

import zlib

import numpy as np

from .._typing import Array
from ..cameras.boards import RULER, Board
from ..exceptions import InvalidArgumentError
from .corners import charuco_board, marker_dictionary

# Points of a PDF per metre, and white margin around a board [m].
_POINTS_PER_METRE = 72 / 0.0254
MARGIN = 0.01
# Short and long side of a sheet of paper [m].
PAPERS = {"a4": (0.21, 0.297), "letter": (0.2159, 0.2794)}
# Height of the strip with the ruler at the lower edge of a sheet, and of the marks at its ends; width of its
# lines [m]; size of the text [points].
_STRIP, _MARK, _LINE_WIDTH, _FONT_SIZE = 0.02, 0.006, 3e-4, 9
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


def _sheet(board: Board, size: tuple[float, float], paper: str) -> tuple[float, float]:
    """Return the width and height of a sheet of paper [m] on which a board and a ruler fit."""
    if paper not in PAPERS:
        raise InvalidArgumentError(f"--paper {paper}: unknown paper; choose from {', '.join(PAPERS)}")
    short, long = PAPERS[paper]
    for sheet in ((short, long), (long, short)):
        if size[0] + 2 * MARGIN <= sheet[0] and size[1] + 2 * MARGIN + _STRIP <= sheet[1]:
            return sheet
    room = (long - 2 * MARGIN, short - 2 * MARGIN - _STRIP)
    raise InvalidArgumentError(
        f"{board.where}: {1e3 * size[0]:.0f} x {1e3 * size[1]:.0f} mm does not fit on {paper}; expected up "
        f"to {1e3 * room[0]:.0f} x {1e3 * room[1]:.0f} mm or {1e3 * (short - 2 * MARGIN):.0f} x "
        f"{1e3 * (long - 2 * MARGIN - _STRIP):.0f} mm"
    )


def _ruler(sheet_width: float) -> list[str]:
    """Return the drawing commands of the ruler line with its marks and text."""
    left, middle = (sheet_width - RULER) / 2, MARGIN + _MARK / 2
    bars = [
        (left, middle - _LINE_WIDTH / 2, RULER, _LINE_WIDTH),
        # The outer edges of both marks are the ends.
        (left, middle - _MARK / 2, _LINE_WIDTH, _MARK),
        (left + RULER - _LINE_WIDTH, middle - _MARK / 2, _LINE_WIDTH, _MARK),
    ]
    scale = _POINTS_PER_METRE
    lines = [" ".join(f"{scale * value:.5f}" for value in bar) + " re" for bar in bars]
    text = (
        f"Print at 100 %: this line is {1e3 * RULER:g} mm long. Measure it, and state its length as ruler_mm."
    )
    place = f"{scale * left:.5f} {scale * (MARGIN + _MARK + 0.002):.5f}"
    return [*lines, "f", f"BT /F1 {_FONT_SIZE} Tf {place} Td ({text}) Tj ET"]


def board_pdf(board: Board, paper: str | None = None) -> bytes:
    """Draw a board at its true scale, on a page of its size or with a ruler on a sheet of paper."""
    rectangles, (width, height) = black_rectangles(board.drawn)
    scale = _POINTS_PER_METRE
    sheet = _sheet(board, (width, height), paper) if paper else (width + 2 * MARGIN, height + 2 * MARGIN)
    page = [side * scale for side in sheet]
    margin = (sheet[0] - width) / 2
    lines = ["0 g"]
    for left, top, w, h in rectangles.tolist():
        x, y = (left + margin) * scale, page[1] - (top + h + MARGIN) * scale
        lines.append(f"{x:.5f} {y:.5f} {w * scale:.5f} {h * scale:.5f} re")
    lines.append("f")
    font = ""
    if paper:
        lines += _ruler(sheet[0])
        font = "/Font << /F1 << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> "
    content = zlib.compress("\n".join(lines).encode())
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page[0]:.5f} {page[1]:.5f}] /Contents 4 0 R "
        f"/Resources << {font}>> /ViewerPreferences << /PrintScaling /None >> >>".encode(),
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
