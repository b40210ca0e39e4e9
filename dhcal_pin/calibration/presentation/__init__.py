"""Presentation of results: plots, joint correction curves and predicted accuracy.

`fit_plots` has the methods of `Result` that draw or tabulate it. What they draw is computed in `curves` and
`workspace`, and drawn with the functions of `dhcal_pin.plots`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
