"""Console output: the structure of a screen, the screens of the commands, and printing with rich.

Screens are built from results and contain text only. Computation of results does not belong here. The names
that commands use are listed in `__init__.pyi` and loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
