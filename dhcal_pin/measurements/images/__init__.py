"""Images of boards: the unknowns of cameras and boards, their first values, and which boards are in view.

The measurement kind itself is `measurements.camera`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
