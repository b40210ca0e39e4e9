"""Rigid motions as stacks of homogeneous matrices, and their exponential coordinates.

Everything broadcasts over leading axes. A twist is [v, ω]: three linear components in metres, then
three angular ones in radians. T_ab is the pose of frame b in frame a.
"""

from __future__ import annotations

import os
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


PathLike = str | os.PathLike[str]
