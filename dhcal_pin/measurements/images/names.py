"""Names of images: the files of their photographs, as the column `image` of a measurement file states them.

All photographs of one configuration and one camera are one image, which then has several names. An image
without a name has the empty text.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..._typing import Array
from ...exceptions import InvalidArgumentError
from ...messages import MAX_QUOTED_CHARS, escape_control_characters

# Largest number of images that a sentence names, and of photographs that the label of an image names.
MAX_NAMED = 3


def name_array(names: Sequence[str] | None, m: int) -> Array:
    """Return the name of the photograph of each sample, (m,); empty texts for no names."""
    out = np.full(m, "", object)
    if names is not None:
        if len(names) != m:
            raise InvalidArgumentError(f"CameraCorners: image_names has {len(names)} names for {m} samples")
        out[:] = [str(name) for name in names]
    return out


def label_images(image: Array, names: Array) -> tuple[str, ...]:
    """Return one label per image, safe to be shown: its name, or its first names joined with a plus sign."""
    found: list[list[str]] = [[] for _ in range(int(image.max(initial=-1)) + 1)]
    for number, name in dict.fromkeys(zip(image.tolist(), names.tolist(), strict=True)):
        if name:
            found[number].append(_shorten(escape_control_characters(name)))
    return tuple(" + ".join(each[:MAX_NAMED]) + (" + …" if len(each) > MAX_NAMED else "") for each in found)


def whole_images(image: Array, is_chosen: Array) -> list[int]:
    """Return the images all of whose samples are chosen, in the order of their first samples."""
    first = np.unique(image, return_index=True)[1]
    n_others = np.bincount(image, ~is_chosen, len(first))
    return [int(number) for number in np.argsort(first) if not n_others[number]]


def list_images(labels: Sequence[str]) -> str:
    """Name the first of some images in parentheses, to be read after their number; empty without names."""
    named = [label for label in labels if label][:MAX_NAMED]
    n_others = len(labels) - len(named)
    more = f" and {n_others} more" if n_others else ""
    return f" ({', '.join(named)}{more})" if named else ""


def _shorten(name: str) -> str:
    """Return a name, or the end of a long one, which distinguishes files."""
    return name if len(name) <= MAX_QUOTED_CHARS else f"…{name[1 - MAX_QUOTED_CHARS :]}"
