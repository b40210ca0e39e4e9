"""Files: robots, measurements, column maps, sidecars and settings.

This package reads and writes files, and converts their units; everywhere else, lengths are metres and angles
radians. Errors in the content of a file are `FileFormatError` and name the file, the line or key, and what is
expected. What the content means belongs to `robot`, `measurements` and `estimation`.

To add a robot file format, add a module with its functions, and one row to `robot.FORMATS`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
