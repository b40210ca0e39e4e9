"""Reports: a result as HTML, Markdown or JSON, with its provenance."""

from .document import Provenance, json_text, result_to_dict, validation_to_dict
from .html import report_files, write_report

__all__ = [
    "Provenance",
    "json_text",
    "report_files",
    "result_to_dict",
    "validation_to_dict",
    "write_report",
]
