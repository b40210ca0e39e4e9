"""Batches: many problems with the same unknowns and numbers of samples, solved at once by array operations.

`solver` states the problems and solves them. `chains` has the robots of a batch, and `qr` the triangular
systems.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
