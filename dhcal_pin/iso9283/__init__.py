"""Tests of a robot according to ISO 9283: where to measure, and what follows from the measurements.

The test cube with its points and the characteristics of poses belong here. Errors of a model belong to
`calibration`, poses for a calibration to `planning`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
