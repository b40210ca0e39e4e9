"""Joint values of images from a recording, by the times in the names of the images."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

import numpy as np

from ..._typing import Array, PathLike
from ...exceptions import FileFormatError
from ...formatting import list_first
from .bag import read_bag_joints
from .image_joints import ImageJoints

# Time around an image within which the robot should stand still [s], and largest change of a joint [rad].
STILL_TIME, MAX_CHANGE = 0.1, 1e-3
# Smallest number for which a time without fraction counts milli-, micro- or nanoseconds, and their seconds.
_SUBDIVISIONS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
# A time in a name: seconds with a fraction behind a point or with nanoseconds behind an underscore, or a
# whole number.
_TIME = re.compile(r"(\d{9,})(?:\.(\d+)|_(\d{9}))?(?!.*\d{9})")


def image_time(name: str) -> float | None:
    """Return the time in the name of an image [s].

    >>> image_time("left_1700000000_250000000.png")
    1700000000.25
    """
    stem = os.path.splitext(os.path.basename(name))[0]
    match = _TIME.search(stem)
    if match is None:
        return None
    whole, fraction, nanoseconds = match.groups()
    if fraction or nanoseconds:
        return float(f"{whole}.{fraction or nanoseconds}")
    value = float(whole)
    return value * next((factor for least, factor in _SUBDIVISIONS if value >= least), 1.0)


def read_recorded_joints(path: PathLike, images: Sequence[str], joint_topic: str | None) -> ImageJoints:
    """Read the joint values at the times of images from a recording."""
    source, times = os.fspath(path), np.empty(len(images))
    for i, image in enumerate(images):
        time = image_time(image)
        if time is None:
            raise FileFormatError(
                f"{image}: no time in the name; expected seconds or nanoseconds such as 1700000000.25.png to "
                f"find the joint values in {source}"
            )
        times[i] = time
    recorded = read_bag_joints(path, joint_topic)
    # The clock of the headers or of the recording: that in which more of the images were taken.
    inside = (times[:, None] >= recorded.times.min(0)) & (times[:, None] <= recorded.times.max(0))
    clock = int(np.argmax(inside.sum(0)))
    if not inside[:, clock].all():
        first = int(np.flatnonzero(~inside[:, clock])[0])
        low, high = recorded.times[:, clock].min(), recorded.times[:, clock].max()
        raise FileFormatError(
            f"{images[first]}: time {times[first]:.3f} s is not in {source}, whose joint values are from "
            f"{low:.3f} to {high:.3f} s"
        )
    order = np.argsort(recorded.times[:, clock], kind="stable")
    when, q = recorded.times[order, clock], recorded.q[order]
    joints, moving = {}, []
    for image, time in zip(images, times.tolist(), strict=True):
        values = np.array([np.interp(time, when, column) for column in q.T])
        if _change(when, q, time) > MAX_CHANGE:
            moving.append(os.path.basename(image))
        joints[os.path.basename(image)] = {
            f"{name}[rad]": repr(value) for name, value in zip(recorded.names, values.tolist(), strict=True)
        }
    notes = []
    if moving:
        first = list_first(moving, 1, "image")
        notes.append(f"the robot moved at the time of {first}; take images while it stands still")
    return ImageJoints(joints, notes)


def _change(when: Array, q: Array, time: float) -> float:
    """Return the largest change of a joint around a time [rad]."""
    near = q[np.abs(when - time) <= STILL_TIME]
    return float(np.ptp(near, axis=0).max()) if len(near) else 0.0
