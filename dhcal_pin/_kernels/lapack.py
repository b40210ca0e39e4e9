"""BLAS and LAPACK functions of SciPy, imported when the first of them is used.

The import of `scipy.linalg` takes a sixth of the time of `dhcal calibrate` with 1,000 poses, which needs none
of them.
"""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """Return a function of `scipy.linalg.lapack` or `scipy.linalg.blas`."""
    if name.startswith("__"):
        raise AttributeError(name)
    from scipy.linalg import blas, lapack  # lazy import: slow

    function = globals()[name] = getattr(lapack if hasattr(lapack, name) else blas, name)
    return function
