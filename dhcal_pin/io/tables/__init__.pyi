"""Public names of dhcal_pin.io.tables; `__init__.py` loads each on first use."""

from .sources import FORMATS as FORMATS
from .sources import WORKBOOK_ENDINGS as WORKBOOK_ENDINGS
from .sources import TableFormat as TableFormat
from .sources import read_table as read_table
from .table import Column as Column
from .table import DataTable as DataTable
from .text import SEPARATORS as SEPARATORS
from .text import TextLayout as TextLayout
from .text import parse_lines as parse_lines
