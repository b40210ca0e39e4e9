"""Contacts: what their misses say about size and orientation of the robot, and the bias of least squares."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
