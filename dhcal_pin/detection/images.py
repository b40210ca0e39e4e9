"""Boards in many images: the files, the detection in several threads, and the table of corners."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from .._frozen import frozen
from .._typing import PathLike
from ..cameras.boards import Board
from ..cameras.rig import Camera, Rig
from ..exceptions import FileFormatError, InvalidArgumentError
from .corners import NO_BOARD, DetectedImage, Layout, detect_corners, find_layout, read_image_of_size
from .opencv import silent_opencv_log

# Largest number of images in which the layouts of a board are compared.
N_LAYOUT_IMAGES = 8
# Endings of image files in a folder.
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm")


@frozen(eq=False)
class BoardDetection:
    """Corners of one board in all images."""

    board: Board  # Board of the rig
    layout: Layout  # Layout in which it was printed
    images: Sequence[DetectedImage]  # Result of each image, in the order of the files

    @property
    def used(self) -> list[DetectedImage]:
        """Images in which the board was found."""
        return [image for image in self.images if not image.problem]


def image_files(paths: Sequence[PathLike]) -> list[str]:
    """List image files, those of folders by name."""
    files: list[str] = []
    for path in [os.fspath(path) for path in paths]:
        if os.path.isdir(path):
            found = sorted(str(file) for file in Path(path).iterdir() if file.suffix.lower() in ENDINGS)
            if not found:
                raise InvalidArgumentError(f"{path}: no images in this folder; expected {', '.join(ENDINGS)}")
            files += found
        elif os.path.exists(path):
            files.append(path)
        else:
            raise InvalidArgumentError(
                f"{path}: no such file or folder; expected images, or a folder of images"
            )
    names = [os.path.basename(file) for file in files]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidArgumentError(f"{repeated[0]}: two images have this name; give each its own")
    return files


def detect_boards(
    rig: Rig,
    camera: Camera,
    paths: Sequence[str],
    on_progress: Callable[[int], None],
    jobs: int | None = None,
) -> list[BoardDetection]:
    """Find the corners of all boards of a rig in the images of one camera."""
    boards = [board for board in rig.boards.values() if board.type != "points"]
    if not boards:
        raise FileFormatError(
            f"{rig.source}: all boards are sets of points, which cannot be found in images; expected a "
            "printed board"
        )
    size, out, n_done = (camera.width, camera.height), [], 0
    step = -(-len(paths) // N_LAYOUT_IMAGES)
    some = [read_image_of_size(path, size) for path in paths[::step]]
    with silent_opencv_log(), ThreadPoolExecutor(jobs or os.cpu_count()) as threads:
        for board in boards:
            layout = find_layout(board, some)
            images = []
            # OpenCV works without the lock of the interpreter.
            for image in threads.map(lambda path: detect_corners(board, layout, path, size), paths):  # noqa: B023
                images.append(image)
                n_done += 1
                on_progress(n_done)
            out.append(BoardDetection(board, layout, images))
    if not any(detection.used for detection in out):
        raise FileFormatError(
            f"{paths[0]}: no board found in any of {len(paths)} images; check type, columns, rows, "
            f"dictionary and the ratio of marker and square of the boards in {rig.source}"
        )
    return out


def unused_images(detections: Sequence[BoardDetection]) -> list[tuple[str, str]]:
    """Find images that are not used, for one board or for all."""
    out = []
    for images in zip(*(detection.images for detection in detections), strict=True):
        problems = {
            detection.board.name: image.problem
            for detection, image in zip(detections, images, strict=True)
            if image.problem and image.problem != NO_BOARD
        }
        if problems:
            texts = [f"board {name}: {text}" for name, text in problems.items()]
            out.append((images[0].path, "; ".join(texts if len(detections) > 1 else problems.values())))
        elif all(image.problem for image in images):
            out.append((images[0].path, NO_BOARD))
    return out


def corner_columns(
    rig: Rig,
    camera: Camera,
    detections: Sequence[BoardDetection],
    joints: Mapping[str, Mapping[str, str]] | None,
) -> dict[str, list[Any]]:
    """Arrange corners as the columns of a measurement file, one row per corner."""
    rows = [
        (image, detection.board.name, number, pixels)
        for detection in detections
        for image in detection.used
        for number, pixels in zip(image.corner.tolist(), np.round(image.pixels, 4).tolist(), strict=True)
    ]
    order = {image.path: i for i, image in enumerate(detections[0].images)}
    rows.sort(key=lambda row: order[row[0].path])
    names = [os.path.basename(image.path) for image, *_ in rows]
    columns: dict[str, list[Any]] = {}
    if joints:
        headers = next(iter(joints.values()))
        columns = {header: [joints[name][header] for name in names] for header in headers}
    columns |= {
        "u[px]": [pixels[0] for *_, pixels in rows],
        "v[px]": [pixels[1] for *_, pixels in rows],
        "corner": [number for _, _, number, _ in rows],
    }
    if len(rig.cameras) > 1:
        columns["camera"] = [camera.name] * len(rows)
    if len(rig.boards) > 1:
        columns["board"] = [board for _, board, _, _ in rows]
    return columns | {"image": names}
