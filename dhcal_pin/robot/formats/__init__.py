"""Robot files in XML: their tags with byte offsets, edits of attributes, and MJCF, the format of MuJoCo.

URDF, which all other modules of `robot` use, is in `robot.urdf`. An MJCF is a `Urdf` with its own bytes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
