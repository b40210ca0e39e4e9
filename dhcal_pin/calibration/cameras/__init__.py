"""Calibration from images: parameter sets of cameras and boards, jitter, and stages that protect the arm.

A calibration from images estimates cameras, boards and lenses together with the robot. This package says
which of these parameters are unknown, and in which order they are freed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
