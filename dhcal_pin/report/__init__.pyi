"""Public names of dhcal_pin.report; `__init__.py` loads each on first use."""

from .calibration_report import report_files as report_files
from .calibration_report import write_report as write_report
from .certificate import write_certificate as write_certificate
from .context import ReportContext as ReportContext
from .json_document import json_text as json_text
from .json_document import result_to_dict as result_to_dict
from .json_document import validation_to_dict as validation_to_dict
from .plan import PlanReport as PlanReport
from .plan import plan_page as plan_page
from .provenance import Provenance as Provenance
from .validation import Validation as Validation
from .validation import validation_page as validation_page
