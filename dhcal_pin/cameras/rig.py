"""Rigs: the cameras and boards of a set-up and the links of the robot that carry them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from .._frozen import frozen
from .._typing import Array
from .boards import Board
from .lens import LENSES, Lens

# Links of a rig file that are not links of the robot.
WORLD, TIP = "world", "tip"
# How the intrinsics of a camera are treated.
INTRINSICS_CHOICES = ("fixed", "prior", "free")
# Prior standard deviations of focal lengths and image centre [px], and of distortion coefficients [1].
PIXEL_PRIORS = {"prior": 50.0, "free": 1e5}
DISTORTION_PRIORS = {"prior": 0.3, "free": 1e2}


@frozen(eq=False)
class Camera:
    """Camera of a rig."""

    name: str  # Name of the camera
    link: str  # Link that carries it, "world" or "tip"
    width: int  # Width of its images [px]
    height: int  # Height of its images [px]
    values: Array  # Values of the lens, shape (s,) [px and 1]; fx, fy, cx, cy are NaN if they are not known
    lens: Lens = field(default_factory=lambda: LENSES["pinhole"])  # Lens model
    intrinsics: str = "prior"  # "fixed", "prior" or "free"
    pose: Array | None = None  # First guess of its pose in the link, shape (4, 4) [m]; None without one

    @property
    def has_intrinsics(self) -> bool:
        """Whether focal lengths and image centre are known."""
        return bool(np.isfinite(self.values).all())

    @property
    def image_centre(self) -> Array:
        """Centre of the image, shape (2,) [px]."""
        return 0.5 * np.array([self.width - 1, self.height - 1])


@frozen(eq=False)
class Rig:
    """Cameras and boards of a set-up."""

    cameras: Mapping[str, Camera]  # Cameras by name
    boards: Mapping[str, Board]  # Boards by name
    source: str = ""  # Name of the file; empty for a rig from Python

    @property
    def is_complete(self) -> bool:
        """Whether the poses of all cameras and boards and the lenses of the cameras are known."""
        entries = [*self.cameras.values(), *self.boards.values()]
        return all(entry.pose is not None for entry in entries) and all(
            camera.has_intrinsics for camera in self.cameras.values()
        )
