"""Public names of dhcal_pin.session; `__init__.py` loads each on first use."""

from .check import Recheck as Recheck
from .check import find_excess_error as find_excess_error
from .check import recheck as recheck
from .facts import History as History
from .facts import Session as Session
from .facts import histories as histories
from .refinement import refine_changes as refine_changes
from .scale import find_scale as find_scale
from .search import can_have_session as can_have_session
from .search import find_session as find_session
