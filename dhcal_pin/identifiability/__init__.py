"""Identifiability: which parameters the measurements determine, and why not the others.

Numbers (rank, observability indices, directions) are in `observability`, the causes of unobservable
directions in `null_space`, their geometry in `propagation`, and the sentences for users in `explanations`.
All of them analyze a linearized problem; what solves problems belongs to `estimation`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
