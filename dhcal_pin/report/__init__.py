"""Reports: a result as HTML, Markdown or JSON, with its provenance.

This package selects and words what a reader sees. Values are computed in `calibration` and `diagnostics`,
plots are drawn by `visualization`.

The public names are listed in `__init__.pyi`. Each is loaded on first use, so that a calibration without a
report does not load the modules that draw it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
