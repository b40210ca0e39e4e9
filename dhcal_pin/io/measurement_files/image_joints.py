"""Joint values of images: a table with a column of file names and one column per joint.

Directions of approach, `approach_JOINT`, and other conditions may stand beside them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import NamedTuple

from ..._typing import PathLike
from ...exceptions import FileFormatError
from ...units import UNITS
from ..tables import TextLayout, read_table
from .columns import is_in_order

IMAGE = "image"


class ImageJoints(NamedTuple):
    """Joint values of images."""

    joints: dict[str, dict[str, str]]  # Cells of the joint columns by header, for the name of each image
    notes: list[str]  # Sentences on rows without an image, or on images during which the robot moved
    is_ordered: bool = False  # Whether the images are in the order in which they were taken


def read_image_joints(path: PathLike, images: Sequence[str]) -> dict[str, dict[str, str]]:
    """Read the joint values that belong to images."""
    return read_joint_table(path, images).joints


def read_joint_table(path: PathLike, images: Sequence[str]) -> ImageJoints:
    """Read the joint values that belong to images, in the order of the table if it is that of measurement."""
    table = read_table(path, TextLayout(header_example=f"{IMAGE},joint_1[deg],…"))
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
    is_ordered = is_in_order(table) or any(
        column.name == "time" and column.unit in UNITS["time"] for column in table.columns.values()
    )
    if is_ordered:
        images = sorted(images, key=lambda image: rows[_stem(image)])
    joints = {
        os.path.basename(image): {
            header: table.cells[rows[_stem(image)]][i].strip()
            for i, header in enumerate(headers)
            if i != index
        }
        for image in images
    }
    shown = {_stem(image) for image in images}
    unused = [table.cells[row][index].strip() for stem, row in rows.items() if stem not in shown]
    notes = []
    if unused:
        count = "1 row has" if len(unused) == 1 else f"{len(unused)} rows have"
        notes = [
            f"{table.source}: {count} no image, such as {unused[0]!r}; check that each row has its own image"
        ]
    return ImageJoints(joints, notes, is_ordered)


def _stem(name: str) -> str:
    """Return the name of a file without folder and ending."""
    return os.path.splitext(os.path.basename(name.strip()))[0]
