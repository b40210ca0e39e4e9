"""Plausibility: whether measurements and corrections can be what they are said to be.

A `Hypothesis` (`hypotheses`) is one assumption about what was mixed up in measurements, such as the sign of a
joint, and the change that undoes it. The evidence of the measurements with and without that change
(`evidence`) decides between hypotheses (`mixups`). In the same way `signs` decides which joints of a low-cost
arm turn the other way. `displacement` compares the size of a correction with manufacturing errors.
`contradictions` compares the fit of one measurement with that of all. `rounding` compares the errors that a
fit leaves with those of joint values with few digits.

Not here: single implausible values, such as joints beyond their limits (`diagnostics`), and the judgement of
a calibration (`calibration.verdict`).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
