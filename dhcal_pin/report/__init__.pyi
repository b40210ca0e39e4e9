"""Public names of dhcal_pin.report; `__init__.py` loads each on first use."""

from .certificate import write_certificate as write_certificate
from .context import ReportContext as ReportContext
from .document import Provenance as Provenance
from .document import json_text as json_text
from .document import result_to_dict as result_to_dict
from .document import validation_to_dict as validation_to_dict
from .html import report_files as report_files
from .html import write_report as write_report
from .plan import PlanReport as PlanReport
from .plan import plan_page as plan_page
from .validation import Validation as Validation
from .validation import validation_page as validation_page
