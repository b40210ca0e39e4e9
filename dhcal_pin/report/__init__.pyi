"""Public names of dhcal_pin.report; `__init__.py` loads each on first use."""

from .calibration_report import report_files as report_files
from .calibration_report import write_report as write_report
from .certificate import certificate_page as certificate_page
from .certificate import parse_meta as parse_meta
from .certificate import write_certificate as write_certificate
from .changes import difference_page as difference_page
from .changes import history_page as history_page
from .context import ReportContext as ReportContext
from .json_document import json_text as json_text
from .json_document import main_statistics as main_statistics
from .json_document import result_to_dict as result_to_dict
from .json_document import validation_to_dict as validation_to_dict
from .plan import PlanReport as PlanReport
from .plan import plan_page as plan_page
from .provenance import Provenance as Provenance
from .provenance import file_digests as file_digests
from .validation import Validation as Validation
from .validation import validation_page as validation_page
from .workspace_map import map_content as map_content
