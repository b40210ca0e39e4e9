"""Stills of a video: one frame of each pause in which nothing moves.

The change of a frame is the mean difference of the grey values of small pictures of it and of the frame
before. Changes have two levels, noise and motion. A pause is a time of at least `MIN_PAUSE` without motion.
Its still is the frame in the middle. A still that shows the same as the one before belongs to the same pause.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._typing import Array, PathLike
from ..exceptions import FileFormatError
from ..native_output import discard_native_messages
from .opencv import require_opencv, silent_opencv_log

# Endings of videos.
VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
# Width of the small pictures [px], and shortest pause [s].
_WIDTH, MIN_PAUSE = 160, 0.4
# A frame moves if its change exceeds this multiple of the noise, the 10 % quantile, but at least the first
# and at most the second grey value.
_NOISE_RATIO, _MIN_CHANGE, _MAX_CHANGE = 3.0, 0.3, 3.0
# Stills that differ by less than this multiple of the limit show the same.
_SAME_RATIO = 2.0


def is_video(path: PathLike) -> bool:
    """Return whether the name of a file is that of a video."""
    return os.fspath(path).lower().endswith(VIDEO_ENDINGS)


def read_stills(path: PathLike) -> list[tuple[float, Array]]:
    """Read the stills of a video, each with its time [s] and its pixels."""
    small, rate = [], 0.0
    for frame, rate in _frames(path):  # noqa: B007
        small.append(_small(frame))
    if len(small) < 2:
        raise FileFormatError(f"{os.fspath(path)}: no frames can be read; expected a video")
    chosen = _middles_of_pauses(np.array(small), rate)
    stills = {i: frame for i, (frame, _) in enumerate(_frames(path)) if i in chosen}
    if not stills:
        raise FileFormatError(
            f"{os.fspath(path)}: something moves in all frames; expected pauses of at least {MIN_PAUSE:g} s, "
            "with the camera, the arm and the light at rest"
        )
    return [(i / rate, stills[i]) for i in sorted(stills)]


def save_stills(path: PathLike, folder: PathLike) -> list[tuple[str, float]]:
    """Write the stills of a video to a folder as PNG, numbered from 1; return their files and times [s]."""
    cv2 = require_opencv()
    name, out = Path(path).stem, []
    for number, (time, pixels) in enumerate(read_stills(path), 1):
        file = os.path.join(folder, f"{name}-{number:03d}.png")
        cv2.imwrite(file, pixels)
        out.append((file, time))
    return out


def _frames(path: PathLike) -> Iterator[tuple[Array, float]]:
    """Yield the frames of a video, each with the number of frames per second."""
    cv2 = require_opencv()
    with silent_opencv_log():
        with discard_native_messages():
            video = cv2.VideoCapture(os.fspath(path))
        rate = float(video.get(cv2.CAP_PROP_FPS)) or 30.0
        try:
            while True:
                with discard_native_messages():
                    is_read, frame = video.read()
                if not is_read:
                    return
                yield frame, rate
        finally:
            video.release()


def _small(frame: Array) -> Array:
    """Return a small grey picture of a frame."""
    cv2: Any = require_opencv()
    height = max(1, round(frame.shape[0] * _WIDTH / frame.shape[1]))
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    return cv2.resize(grey, (_WIDTH, height), interpolation=cv2.INTER_AREA).astype(np.float32)


def _middles_of_pauses(small: Array, rate: float) -> set[int]:
    """Return the numbers of the frames in the middle of the pauses of small pictures (f, h, w)."""
    changes = np.mean(np.abs(np.diff(small, axis=0)), (1, 2))
    limit = float(np.clip(_NOISE_RATIO * np.quantile(changes, 0.1), _MIN_CHANGE, _MAX_CHANGE))
    edges = np.flatnonzero(np.diff(np.pad((changes <= limit).astype(int), 1))).reshape(-1, 2)
    out: list[int] = []
    for start, end in edges.tolist():
        middle = (start + end) // 2
        is_long = end - start >= MIN_PAUSE * rate
        if is_long and not (out and np.mean(np.abs(small[middle] - small[out[-1]])) < _SAME_RATIO * limit):
            out.append(middle)
    return set(out)
