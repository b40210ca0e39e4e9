"""Measurement files: reading from any table, column maps for files of other makers, targets, writing.

`read_measurement_file` reads a table with the package `tables`, finds the measurement kind from the columns
and converts the values to metres and radians.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
