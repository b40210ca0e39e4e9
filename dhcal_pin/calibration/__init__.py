"""Calibration: from a nominal chain and measurements to a result with evidence of its accuracy.

The stages of `calibrate` (`procedure`) have one module each: `reweighting`, `shrinkage` and the `result`.
`evaluation` computes errors, `partition` and `cross_validation` hold out
samples, `model_selection` adds families of joint errors, `streaming` reads samples part by part.
`estimates` and `summary` present a result.

Not here: the least-squares solver (`estimation`), explanations of what the data cannot determine
(`identifiability`), checks of input data (`diagnostics`), and files (`io`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
