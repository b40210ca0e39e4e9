"""Reports: a result as HTML, Markdown or JSON, with its provenance.

This package selects and words what a reader sees. Values are computed in `calibration` and `diagnostics`,
plots are drawn by `visualization`.
"""

from .context import ReportContext
from .document import Provenance, json_text, result_to_dict, validation_to_dict
from .html import report_files, write_report

__all__ = [
    "Provenance",
    "ReportContext",
    "json_text",
    "report_files",
    "result_to_dict",
    "validation_to_dict",
    "write_report",
]
