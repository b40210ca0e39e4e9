"""Studies: grids of simulated calibrations."""

from .grid import Setting, Study, read_study
from .runner import run

__all__ = [
    "Setting",
    "Study",
    "read_study",
    "run",
]
