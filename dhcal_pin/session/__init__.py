"""What happened during a session: events, drift, lag and scale, found from the order of the samples."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
