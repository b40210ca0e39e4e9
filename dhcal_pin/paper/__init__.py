"""The paper: its error factors, its simulations and its experiment (Cho, Ha, Lee and Park).

Everything here reproduces or checks the paper "Positioning Accuracy Improvement of Robots by Link Parameter
Calibration". Methods that other packages use do not belong here.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
