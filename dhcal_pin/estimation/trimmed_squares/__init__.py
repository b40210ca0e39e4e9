"""Least trimmed squares: fits to the majority of samples that agree best, whatever the other samples are.

`search` works on linearized rows of any kind of measurement. `initial_outliers` uses it before the first fit
of the robot, where gross mistakes ruin base, tool and instruments.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
