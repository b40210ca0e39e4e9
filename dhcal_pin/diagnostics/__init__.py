"""Checks of measurement files before a fit, of residuals and accuracy after it, and of the installation.

Diagnostics read a robot, measurements and a calibration, and return findings; they change nothing and leave
no files. Their presentation belongs to the packages `report` and `cli`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
