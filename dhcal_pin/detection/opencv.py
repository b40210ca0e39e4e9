"""OpenCV, which the extra `camera` installs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from ..exceptions import InvalidArgumentError


def require_opencv() -> ModuleType:
    """Return the module of OpenCV."""
    try:
        import cv2  # lazy import: an optional extra
    except ImportError:
        raise InvalidArgumentError(
            "boards in images need OpenCV, which is not installed; run: pip install 'dhcal-pin[camera]'"
        ) from None
    return cv2


@contextmanager
def silent_opencv_log() -> Iterator[None]:
    """Silence the log of OpenCV in the `with` block, in all threads: it does not name the image."""
    logging = require_opencv().utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)
