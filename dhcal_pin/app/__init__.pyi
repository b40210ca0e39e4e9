"""Public names of dhcal_pin.app; `__init__.py` loads each on first use."""

from .server import DEFAULT_LIMIT as DEFAULT_LIMIT
from .server import serve as serve
from .upload import Upload as Upload
