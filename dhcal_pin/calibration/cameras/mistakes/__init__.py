"""Mistakes in a rig or in the names of images, which are looked for before cameras and boards are fitted.

`rig` corrects all of them. Each module finds one sort: values in the order of other axes (`axis_order`), and
poses that are stated the other way round (`inverse_poses`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
