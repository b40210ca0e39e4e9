"""Cameras and boards: lens models, corners of boards, and first estimates of poses from images.

A rig lists the cameras and boards of a set-up. Lens models map points in front of a camera to pixels. Poses
from images, the poses of cameras and boards on the robot, and focal lengths are found in closed form here, as
a start for the calibration. Files and the detection of boards in images are the concern of other packages.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
