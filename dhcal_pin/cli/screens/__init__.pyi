"""Public names of dhcal_pin.cli.screens; `__init__.py` loads each on first use."""

from .console import open_page as open_page
from .console import open_url as open_url
from .console import print_lines as print_lines
from .console import print_progress as print_progress
from .console import progress_bar as progress_bar
from .console import show as show
from .console import show_progress as show_progress
from .result_screens import bundle_screen as bundle_screen
from .result_screens import compensation_screen as compensation_screen
from .result_screens import crosscheck_screen as crosscheck_screen
from .result_screens import detection_screen as detection_screen
from .result_screens import difference_screen as difference_screen
from .result_screens import files_screen as files_screen
from .result_screens import inspection_screen as inspection_screen
from .result_screens import plan_screen as plan_screen
from .result_screens import recheck_screen as recheck_screen
from .result_screens import robot_screen as robot_screen
from .result_screens import simulation_screen as simulation_screen
from .result_screens import study_screen as study_screen
from .result_screens import validation_screen as validation_screen
from .screen import robot_line as robot_line
