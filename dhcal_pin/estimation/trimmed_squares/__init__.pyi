"""Public names of dhcal_pin.estimation.trimmed_squares; `__init__.py` loads each on first use."""

from .initial_outliers import find_initial_outliers as find_initial_outliers
from .search import MIN_SCALE as MIN_SCALE
from .search import LinearizedRows as LinearizedRows
from .search import linearize_rows as linearize_rows
from .search import search_majorities as search_majorities
