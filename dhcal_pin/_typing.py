"""Type aliases that all packages share."""

from __future__ import annotations

import os
from typing import Any

from numpy.typing import NDArray

# NumPy array; docstrings give its shape and unit.
Array = NDArray[Any]
# Path of a file, as `open` accepts it.
PathLike = str | os.PathLike[str]
