"""Studies: simulated calibrations over a grid of settings.

This package holds the grid with its file, and the simulation of its settings. The command line, the journal
and the plots of a study belong to `cli` and `visualization`.
"""

from .grid import Case, Setting, StudyGrid, read_study
from .runner import MEASURE_UNITS, result_table, run

__all__ = [
    "MEASURE_UNITS",
    "Case",
    "Setting",
    "StudyGrid",
    "read_study",
    "result_table",
    "run",
]
