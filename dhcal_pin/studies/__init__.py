"""Studies: simulated calibrations over a grid of settings.

This package holds the grid with its file, the simulation of its settings, and the journal of an unfinished
study. The command line and the plots of a study belong to `cli` and `visualization`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
