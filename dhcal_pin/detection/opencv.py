"""OpenCV, which the extra `camera` installs."""

from __future__ import annotations

from types import ModuleType

from ..exceptions import InvalidArgumentError


def require_opencv() -> ModuleType:
    """Return the module of OpenCV.

    Raises:
        InvalidArgumentError: It is not installed.
    """
    try:
        import cv2  # lazy import: an optional extra
    except ImportError:
        raise InvalidArgumentError(
            "boards in images need OpenCV, which is not installed; run: pip install 'dhcal-pin[camera]'"
        ) from None
    return cv2
