"""Visualization: plots with matplotlib, and three-dimensional scenes with MeshCat.

This package draws what other packages have computed. Which plots a report contains is decided in `report`.
matplotlib is imported by the first plot; `live`, which imports MeshCat's server, is imported by itself.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
