"""Corners of a board in images, by OpenCV.

Boards are printed in several layouts that look alike: with rows and columns exchanged, and ChArUco boards
with an even number of rows in the legacy pattern, too. A detector with the wrong layout finds nothing and
does not say why. `find_layout` therefore tries all of them. Corners keep the numbers of the board as the rig
states it: a board with exchanged rows and columns is the same set of points, turned by a quarter.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import Array, PathLike
from ..cameras.boards import Board
from ..cameras.pose_from_points import direct_linear_transform
from ..exceptions import FileFormatError, InvalidArgumentError, UnknownNameError
from ..native_output import discard_native_messages
from .crossings import refine_crossings
from .opencv import require_opencv
from .tag_edges import refine_by_edges

# Largest size of an image file [byte], and largest image [pixels].
MAX_IMAGE_BYTES, MAX_IMAGE_PIXELS = 64 << 20, 50_000_000
# What a message says of a file without an image.
_NO_IMAGE = "cannot be read as an image; expected PNG, JPEG or TIFF"
# Problem of an image without a board.
NO_BOARD = "no board found"
# Outlines of markers, and their numbers (t, 1); None without markers.
Markers = tuple[Sequence[Array], Array | None]
# Smallest number of corners of an image that is used.
MIN_CORNERS = 4
# Sharpness below which an image is blurred: standard deviation of the Laplacian over that of the brightness.
MIN_SHARPNESS = 0.05
# Share of white pixels around the board above which an image is saturated.
MAX_WHITE, WHITE = 0.5, 254


@frozen
class Layout:
    """Layout in which a board was printed."""

    is_exchanged: bool = False  # Whether rows and columns are exchanged
    is_legacy: bool = False  # Whether a ChArUco board has the legacy pattern

    def describe(self, board: Board) -> str:
        """Return what differs from the board of the rig; empty if nothing does."""
        parts = []
        if self.is_exchanged:
            parts.append(f"columns = {board.rows}, rows = {board.columns}")
        if self.is_legacy != board.is_legacy:
            parts.append(f"legacy = {str(self.is_legacy).lower()}")
        return ", ".join(parts)


@frozen(eq=False)
class DetectedImage:
    """Corners that were found in an image."""

    path: str
    corner: Array  # Numbers of the corners on the board of the rig, (c,)
    pixels: Array  # Image coordinates, (c, 2) [px]
    problem: str = ""  # Why the image is not used, such as "no board found"; empty if it is


def read_image(path: PathLike) -> Array:
    """Read an image as grey values."""
    cv2 = require_opencv()
    _require_few_pixels(path)
    image = None
    with discard_native_messages(), suppress(cv2.error):  # a damaged file may state an enormous size
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileFormatError(f"{os.fspath(path)}: {_NO_IMAGE}")
    return image


def read_image_of_size(path: PathLike, size: tuple[int, int]) -> Array:
    """Read an image as grey values; its width and height must be those of the rig file."""
    image = read_image(path)
    if image.shape[::-1] != size:
        raise FileFormatError(
            f"{os.fspath(path)}: has {image.shape[1]} x {image.shape[0]} px; the rig file states "
            f"{size[0]} x {size[1]} px"
        )
    return image


def _require_few_pixels(path: PathLike) -> None:
    """Require an image that fits into the memory. A small file can hold many pixels of one colour."""
    from PIL import Image  # lazy import: an optional extra

    source = os.fspath(path)
    if not os.path.exists(path):
        raise FileFormatError(f"{source}: no such file; give images, or a folder of images")
    size = os.path.getsize(path) if os.path.isfile(path) else 0
    if size > MAX_IMAGE_BYTES:
        raise FileFormatError(
            f"{source}: the file is larger than {MAX_IMAGE_BYTES >> 20} MiB; save the image as PNG or JPEG"
        )
    try:
        with warnings.catch_warnings():
            # Pillow warns about large images.
            warnings.simplefilter("ignore")
            # Only the header is read.
            with Image.open(path) as image:
                width, height = image.size
    except Image.DecompressionBombError:
        width = height = MAX_IMAGE_PIXELS
    # Damaged headers raise errors of many types, such as those of `struct`.
    except Exception as error:
        raise FileFormatError(f"{source}: {_NO_IMAGE}") from error
    if width * height > MAX_IMAGE_PIXELS:
        raise FileFormatError(
            f"{source}: has more than {MAX_IMAGE_PIXELS // 10**6} million pixels; reduce the images, and "
            "give the rig file their new size"
        )


def layouts_of(board: Board) -> list[Layout]:
    """Return all layouts in which a board may have been printed, that of the rig first."""
    exchanged = [False] if board.columns == board.rows else [False, True]
    legacy = [board.is_legacy, not board.is_legacy] if board.type == "charuco" else [False]
    return [Layout(turn, old) for turn in exchanged for old in legacy]


def find_layout(board: Board, images: Sequence[Array]) -> Layout:
    """Find the layout of a board that shows the most corners in some images."""
    layouts = layouts_of(board)
    if len(layouts) == 1:
        return layouts[0]
    seen = [(image, _find_markers(board, image)) for image in images]
    counts = [sum(len(_find(board, layout, *each)[0]) for each in seen) for layout in layouts]
    return layouts[int(np.argmax(counts))]


def detect_corners(board: Board, layout: Layout, path: str, size: tuple[int, int]) -> DetectedImage:
    """Find the corners of a board in an image file."""
    image = read_image_of_size(path, size)
    corner, pixels = _find(board, layout, image, _find_markers(board, image))
    problem = ""
    if not len(corner):
        problem = NO_BOARD
    elif len(corner) < MIN_CORNERS:
        problem = f"{len(corner)} corners found; at least {MIN_CORNERS} are needed"
    else:
        problem = _quality_problem(image, pixels)
    return DetectedImage(path, corner, pixels, problem)


def _quality_problem(image: Array, pixels: Array) -> str:
    """Return "blurred" or "saturated", or an empty text, for the part of an image around corners (c, 2)."""
    cv2 = require_opencv()
    low = np.maximum(np.floor(pixels.min(0)).astype(int), 0)
    high = np.ceil(pixels.max(0)).astype(int) + 1
    part = image[low[1] : high[1], low[0] : high[0]]
    if np.mean(part >= WHITE) > MAX_WHITE:
        return "saturated: more than half of the board is white; expose shorter"
    contrast = float(part.std())
    if contrast == 0 or float(cv2.Laplacian(part, cv2.CV_64F).std()) < MIN_SHARPNESS * contrast:
        return "blurred"
    return ""


def _find_markers(board: Board, image: Array) -> Markers:
    """Return outlines and numbers of the markers of a board in an image; none of a board without markers."""
    if board.type not in ("charuco", "aprilgrid"):
        return (), None
    return require_opencv().aruco.ArucoDetector(marker_dictionary(board)).detectMarkers(image)[:2]


def _find(board: Board, layout: Layout, image: Array, markers: Markers) -> tuple[Array, Array]:
    """Return numbers (c,) and image coordinates (c, 2) of corners; the markers are those of all layouts."""
    columns, rows = (board.columns, board.rows)
    if layout.is_exchanged:
        columns, rows = rows, columns
    finders = {"charuco": _find_charuco, "checkerboard": _find_checkerboard, "aprilgrid": _find_aprilgrid}
    if board.type not in finders:
        raise InvalidArgumentError(
            f"{board.where}: the type {board.type!r} cannot be detected; choose from {', '.join(finders)}"
        )
    printed = replace(board, columns=columns, rows=rows, is_legacy=layout.is_legacy)
    corner, pixels = finders[board.type](printed, image, markers)
    if layout.is_exchanged and len(corner):
        corner = _numbers_on_the_rig(board, printed, corner)
    return corner, pixels


def _numbers_on_the_rig(board: Board, printed: Board, corner: Array) -> Array:
    """Return the numbers of corners on the board of the rig, which is the printed one turned by a quarter."""
    if board.type == "aprilgrid":
        tag, number = np.divmod(corner, 4)
        y, x = np.divmod(tag, printed.columns)
        # The corners of a tag turn with it.
        return 4 * ((printed.columns - 1 - x) * board.columns + y) + (number + 3) % 4
    y, x = np.divmod(corner, printed.columns - 1)
    return (printed.columns - 2 - x) * (board.columns - 1) + y


def marker_dictionary(board: Board) -> Any:
    """Return the dictionary of a board's markers."""
    aruco = require_opencv().aruco
    known = [name for name in dir(aruco) if name.startswith("DICT_")]
    matches = {name.upper(): name for name in known}
    if board.dictionary.upper() not in matches:
        raise UnknownNameError(
            f"{board.where}: dictionary = {board.dictionary!r} is unknown; choose from {', '.join(known)}"
        )
    out = aruco.getPredefinedDictionary(getattr(aruco, matches[board.dictionary.upper()]))
    if board.n_markers > len(out.bytesList):
        raise InvalidArgumentError(
            f"{board.where}: {board.columns} x {board.rows} squares need {board.n_markers} markers, and "
            f"{board.dictionary} has {len(out.bytesList)}; expected a larger dictionary or fewer squares"
        )
    return out


def charuco_board(board: Board) -> Any:
    """Return a ChArUco board as OpenCV describes it."""
    aruco = require_opencv().aruco
    out = aruco.CharucoBoard(
        (board.columns, board.rows), board.square, board.marker, marker_dictionary(board)
    )
    out.setLegacyPattern(board.is_legacy)
    return out


def _found(corner: Any, pixels: Any) -> tuple[Array, Array]:
    """Return detected corners as arrays (c,) and (c, 2); empty if there are none."""
    if corner is None or len(corner) == 0:
        return np.empty(0, int), np.empty((0, 2))
    return np.asarray(corner, int).ravel(), np.asarray(pixels, float).reshape(-1, 2)


def _find_charuco(board: Board, image: Array, markers: Markers) -> tuple[Array, Array]:
    """Find the inner corners of a ChArUco board."""
    outlines, tags = markers
    if tags is None:
        return _found(None, None)
    detector = require_opencv().aruco.CharucoDetector(charuco_board(board))
    found, numbers, _, _ = detector.detectBoard(image, markerCorners=outlines, markerIds=tags)
    corner, pixels = _found(numbers, found)
    # Corners are placed between the markers, also where something covers them.
    gap = 0.5 * (board.square - board.marker) / board.square
    pixels, is_visible = refine_crossings(image, board.points[corner, :2] / board.square, pixels, gap)
    return corner[is_visible], pixels[is_visible]


def _find_checkerboard(board: Board, image: Array, _: Markers) -> tuple[Array, Array]:
    """Find all inner corners of a checkerboard."""
    cv2 = require_opencv()
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, pixels = cv2.findChessboardCornersSB(image, (board.columns - 1, board.rows - 1), flags=flags)
    if not found:
        return _found(None, None)
    corners = pixels.reshape(-1, 2).astype(float)
    if _first_square_is_white(board, image, corners):
        corners = corners[::-1]
    return _found(np.arange(len(corners)), corners)


def _first_square_is_white(board: Board, image: Array, corners: Array) -> bool:
    """Return whether corners (c, 2) are numbered from the wrong end: the first square of a board is black."""
    # The board looks the same from both ends if the sum of its columns and rows is even.
    homography = direct_linear_transform(board.points[:, :2] / board.square, corners)
    y, x = np.mgrid[1 : board.rows - 1, 1 : board.columns - 1].reshape(2, -1)
    centres = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ homography.T
    u, v = np.round(centres[:, :2] / centres[:, 2:]).astype(int).T
    grey = image[np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)]
    is_black = (x + y) % 2 == 0
    return bool(grey[is_black].mean() > grey[~is_black].mean())


def _find_aprilgrid(board: Board, image: Array, markers: Markers) -> tuple[Array, Array]:
    """Find the four corners of each tag of an AprilGrid that is wholly visible."""
    outlines, tags = markers
    if tags is None:
        return _found(None, None)
    size = marker_dictionary(board).markerSize + 2
    corner, pixels = [], []
    for tag, outline in zip(tags.ravel().tolist(), outlines, strict=True):
        if tag >= board.columns * board.rows:
            continue
        refined = refine_by_edges(image, outline.reshape(4, 2).astype(float), size)
        if refined is not None:
            corner += range(4 * tag, 4 * tag + 4)
            pixels.append(refined)
    return _found(corner, pixels)
