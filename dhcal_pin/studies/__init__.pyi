"""Public names of dhcal_pin.studies; `__init__.py` loads each on first use."""

from .grid import Case as Case
from .grid import Setting as Setting
from .grid import StudyGrid as StudyGrid
from .grid import read_study as read_study
from .journal import StudyJournal as StudyJournal
from .journal import open_journal as open_journal
from .runner import MEASURE_UNITS as MEASURE_UNITS
from .runner import plot_study as plot_study
from .runner import result_table as result_table
from .runner import run as run
