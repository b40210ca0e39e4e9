"""Least trimmed squares: fits to the majority of samples that agree best, whatever the other samples are.

`search` works on linearized rows of any kind of measurement. `initial_outliers` uses it before the first fit
of the robot, where gross mistakes ruin base, tool and instruments.
"""

from .initial_outliers import find_initial_outliers
from .search import MIN_SCALE, LinearizedRows, linearize_rows, search_majorities

__all__ = [
    "MIN_SCALE",
    "LinearizedRows",
    "find_initial_outliers",
    "linearize_rows",
    "search_majorities",
]
