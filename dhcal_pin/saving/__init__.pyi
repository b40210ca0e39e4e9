"""Public names of dhcal_pin.saving; `__init__.py` loads each on first use."""

from .commit_record import complete_interrupted_save as complete_interrupted_save
from .signals import defer_signals as defer_signals
from .targets import is_stream as is_stream
from .targets import require_writable as require_writable
from .transaction import write_files as write_files
