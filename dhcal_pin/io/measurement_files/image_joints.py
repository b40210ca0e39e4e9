"""Joint values of images: a table with a column of file names and one column per joint."""

from __future__ import annotations

import os
from collections.abc import Sequence

from ..._typing import PathLike
from ...exceptions import FileFormatError
from ..tables import read_table

IMAGE = "image"


def read_image_joints(path: PathLike, images: Sequence[str]) -> dict[str, dict[str, str]]:
    """Read the joint values that belong to images."""
    table = read_table(path)
    headers = [header.strip() for header in table.headers]
    if IMAGE not in headers:
        raise FileFormatError(
            f"{table.header_location}: no column `{IMAGE}`; expected the file names of the images"
        )
    index = headers.index(IMAGE)
    rows: dict[str, int] = {}
    for row, cells in enumerate(table.cells):
        stem = _stem(cells[index])
        if stem in rows:
            raise FileFormatError(
                f"{table.source}:{table.lines[row]}: image {cells[index]!r} has a row already, line "
                f"{table.lines[rows[stem]]}"
            )
        rows[stem] = row
    missing = [image for image in images if _stem(image) not in rows]
    if missing:
        more = f" and of {len(missing) - 1} more images" if len(missing) > 1 else ""
        known = f", such as {table.cells[0][index].strip()!r}" if rows else ""
        raise FileFormatError(
            f"{table.source}: no joint values of {os.path.basename(missing[0])}{more}; expected a row for "
            f"each image, with its file name in the column `{IMAGE}`{known}"
        )
    return {
        os.path.basename(image): {
            header: table.cells[rows[_stem(image)]][i].strip()
            for i, header in enumerate(headers)
            if i != index
        }
        for image in images
    }


def _stem(name: str) -> str:
    """Return the name of a file without folder and ending."""
    return os.path.splitext(os.path.basename(name.strip()))[0]
