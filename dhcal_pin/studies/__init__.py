"""Studies: grids of simulated calibrations."""

from .grid import Setting, StudyGrid, read_study
from .runner import run

__all__ = [
    "Setting",
    "StudyGrid",
    "read_study",
    "run",
]
