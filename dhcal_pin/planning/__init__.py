"""Planning of measurements: which poses to measure, and which accuracy to expect.

Optimality criteria, knowledge before a measurement, and the search for good poses belong here. Random
configurations, workspace constraints and collision checks belong to `robot`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
