"""Run the `dhcal` command by `python -m dhcal_pin.cli`."""

import sys

from .main import main

sys.exit(main())
