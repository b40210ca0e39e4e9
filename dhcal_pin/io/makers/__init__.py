"""Files in which makers deliver the calibration of an arm: one module per maker.

A file holds a whole robot, or corrections to a nominal one. Each module has one row of `io.robot.FORMATS`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
